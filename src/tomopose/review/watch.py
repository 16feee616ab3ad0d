"""Images as they arrive: what they cover, what is known so far, and which pose would help most."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import calibrate
from tomopose.detection import detect
from tomopose.errors import TomoposeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.io.images import open_images
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.planning.commands import command_list
from tomopose.planning.design import BALL_MM, nominal_mount
from tomopose.planning.limits import PlanLimits
from tomopose.planning.next_pose import next_pose
from tomopose.report.words import small_unit

CELLS = 4
"""The panel in CELLS x CELLS parts, of which coverage counts those that hold a ball."""
FEWEST = 8
"""Poses from which a calibration is tried."""
SUFFIXES = (".tif", ".tiff")


@dataclass(frozen=True, kw_only=True)
class Arrived:
    """One image: its pose, and what was found in it.  x: (u, v) px, None where no ball was measured."""

    pose_id: str
    image: str
    x: tuple[float, float] | None
    covariance: tuple[tuple[float, float], tuple[float, float]] | None
    status: str


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What a run is taken with.  language: of the machine's commands, as `plan poses --commands`."""

    scanner: Scanner
    poses: PoseSequence
    folder: Path
    ball_diameter: float
    limits: PlanLimits
    language: str = "pi-gcs"


def expected_names(poses: PoseSequence) -> dict[str, str]:
    """File name -> pose id of a run: by the column image, or POSE_ID.tif."""
    if poses.image is not None:
        return dict(zip(poses.image, poses.pose_id, strict=True))
    return {f"{p}{suffix}": p for p in poses.pose_id for suffix in SUFFIXES}


def measure(setup: Setup, path: Path, pose_id: str) -> Arrived:
    """The ball in a file that has just arrived.  A file that cannot be read yet raises FileError: look again later."""
    images = open_images(path, setup.scanner)
    try:
        found = detect(images, setup.scanner, ball_diameter=setup.ball_diameter, pose_id=[pose_id])
    except TomoposeError as error:
        return Arrived(pose_id=pose_id, image=path.name, x=None, covariance=None, status=str(error))
    if not found.seen[0]:
        status = "not found" if found.status is None else found.status[0]
        return Arrived(pose_id=pose_id, image=path.name, x=None, covariance=None, status=status)
    (u, v), C = found.x_D[0].tolist(), found.covariance[0].tolist()
    status = "ok" if found.status is None else found.status[0]
    return Arrived(pose_id=pose_id, image=path.name, x=(u, v), covariance=(tuple(C[0]), tuple(C[1])), status=status)


def observations_of(arrived: list[Arrived]) -> BallObservations | None:
    """What was measured so far, as observations; None where nothing was."""
    good = [a for a in arrived if a.x is not None]
    if not good:
        return None
    return BallObservations(
        x_D=np.array([a.x for a in good]),
        covariance=np.array([a.covariance for a in good]),
        pose_id=tuple(a.pose_id for a in good),
    )


def coverage(scanner: Scanner, taken: PoseSequence, x: np.ndarray) -> dict[str, Any]:
    """Of the panel (parts that hold a ball), and of the pose space: span of each axis, and table angles in degrees."""
    parts = np.floor(CELLS * (x + 0.5) / [scanner.n_u, scanner.n_v]).astype(int).clip(0, CELLS - 1)
    spans = {f"{n} / mm": np.ptp(taken.T_MH.t[:, k]) for k, n in enumerate("xyz")}
    spans |= {f"about {n} / °": np.degrees(np.ptp(taken.rotation_vectors()[:, k])) for k, n in enumerate("xyz")}
    alpha = np.zeros(len(taken)) if taken.alpha is None else np.degrees(taken.alpha)
    return {
        "panel": len({tuple(p) for p in parts.tolist()}) / CELLS**2,
        "spans": spans,
        "table_angles": sorted({round(float(a), 2) for a in alpha}),
    }


def progress(setup: Setup, arrived: list[Arrived]) -> dict[str, Any]:
    """What the page shows: arrived and missing images, coverage, sigma so far, what is indistinguishable, what next."""
    there = {a.pose_id for a in arrived}
    state: dict[str, Any] = {
        "arrived": [{"pose": a.pose_id, "image": a.image, "x": a.x, "status": a.status} for a in arrived],
        "expected": len(setup.poses),
        "missing": [p for p in setup.poses.pose_id if p not in there],
        "n_u": setup.scanner.n_u,
        "n_v": setup.scanner.n_v,
    }
    observations = observations_of(arrived)
    if observations is None:
        return {**state, "words": "No ball was measured yet."}
    taken = setup.poses.select(setup.poses.index_of(observations.pose_id))
    state["coverage"] = coverage(setup.scanner, taken, observations.x_D)
    found = _so_far(setup, taken, observations, state)
    T_HT, ball = (nominal_mount(), np.asarray(BALL_MM)) if found is None else (found.T_HT, found.t)
    return {**state, **_next(setup, taken, T_HT, ball)}


def _so_far(
    setup: Setup, taken: PoseSequence, observations: BallObservations, state: dict[str, object]
) -> Calibration | None:
    """The calibration of what is there, its words put into the state; None where there is none yet."""
    if len(observations) < FEWEST:
        state["words"] = f"{FEWEST - len(observations)} more measured poses until a first calibration."
        return None
    try:
        found = calibrate(setup.scanner, taken, observations)
    except TomoposeError as error:
        state["words"] = f"No calibration yet: {error}"
        return None
    state["verdict"], state["words"] = found.verdict, found.reasons[0] if found.reasons else found.status
    state["sigma"] = [{"name": p.name, "u": small_unit(p.u, p.unit)} for p in found.parameters]
    state["scan_px"] = None if found.budget is None else found.budget.total
    alike = [h.words for h in found.hypotheses if h.outcome == "same"]
    state["indistinguishable"] = [*found.observability.unobservable, *alike]
    return found


def _next(setup: Setup, taken: PoseSequence, T_HT: RigidTransform, ball: np.ndarray) -> dict[str, Any]:
    try:
        best = next_pose(setup.scanner, taken, T_HT=T_HT.require(Frame.H, Frame.T), t=ball, limits=setup.limits)
    except TomoposeError as error:
        return {"next": None, "next_words": str(error)}
    pose = best.pose
    axes = [*pose.T_MH.t[0].tolist(), *np.degrees(pose.T_MH.angles[0]).tolist()]
    alpha = 0.0 if pose.alpha is None else float(np.degrees(pose.alpha[0]))
    return {
        "next": {"axes": axes, "alpha_deg": alpha, "before": best.before, "after": best.after},
        "undetermined": best.undetermined,
        "command": command_list(pose, setup.language),
        "language": setup.language,
    }


@dataclass
class Watcher:
    """Looks into the folder again and again; the one place that changes.

    A file counts when its size has settled; one whose size changes later is measured again.

    measured: file name -> its size when it was measured, and what was found;  sizes: when last looked at.
    """

    setup: Setup
    measured: dict[str, tuple[int, Arrived]] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)
    state: dict[str, Any] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.state = progress(self.setup, [])

    @property
    def arrived(self) -> list[Arrived]:
        """In the order in which they were measured."""
        return [found for _, found in self.measured.values()]

    def look(self) -> bool:
        """Take in what is new and whole; whether anything was.  Files without a pose in the table are left alone."""
        names = expected_names(self.setup.poses)
        settled = self._settled(names)
        for path, size in settled:
            try:
                found = measure(self.setup, path, names[path.name])
            except TomoposeError as error:  # damaged, or not yet whole: measured again when its size changes
                found = Arrived(pose_id=names[path.name], image=path.name, x=None, covariance=None, status=str(error))
            self.measured.pop(path.name, None)
            self.measured[path.name] = (size, found)
        if settled:
            self._show(progress(self.setup, self.arrived))
        return bool(settled)

    def _settled(self, names: dict[str, str]) -> list[tuple[Path, int]]:
        """Files of the run that have kept their size since the last look, and were not measured at it."""
        found = []
        try:
            there = sorted(p for p in self.setup.folder.iterdir() if p.name in names)
        except OSError:  # a share that is gone for a moment
            return []
        for path in there:
            try:
                size = path.stat().st_size
            except OSError:  # moved away since it was listed
                continue
            known = self.sizes.get(path.name) == size and size > 0
            self.sizes[path.name] = size
            if known and self.measured.get(path.name, (-1, None))[0] != size:
                found.append((path, size))
        return found

    def _show(self, state: dict[str, object]) -> None:
        with self.lock:
            self.state = state

    def run(self, stop: threading.Event, seconds: float = 1.0, said: Callable[[str], None] = lambda text: None) -> None:
        """Look until it is told to stop.  Should that fail, the page says so: it never goes on showing an old state."""
        try:
            while not stop.is_set():
                if self.look():
                    said(f"{len(self.measured)} of {len(self.setup.poses)} images")
                stop.wait(seconds)
        except Exception as error:
            words = f"The run is not being watched any more ({type(error).__name__}: {error}); start the review again."
            self._show({**self.state, "words": words, "verdict": None, "failed": True})
            raise
