"""What a calibration is made of: observed centres paired with poses by name, one or several runs, in plain arrays."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

import numpy as np

from tomopose.calibration.model.ball_projection import poses_of, scanner_vector, whiteners
from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import rotation_angle_between, rotation_from_convention
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PIVOT_TOLERANCE_MM, PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array
from tomopose.values import value

FEWEST_POSES = 5
POSITION_UNITS = (("centimetres", "cm", 10.0), ("inches", "inch", 25.4), ("metres", "m", 1000.0))
"""Units in which positions are written under columns that say mm: name, symbol, millimetres."""
SAME_ROTATION_RAD = 1e-6
"""Ten digits of a file leave 2e-9 rad; corrected poses differ by more."""


STILL_MM, STILL_RAD = 1e-6, 1e-9
"""Travel up to which a manipulator stands still: what rounding in a table leaves."""


def travel(R: Array, t: Array) -> tuple[float, float]:
    """(mm, rad): farthest that poses R (n, 3, 3), t (n, 3) are from the first of them."""
    return float(np.abs(t - t[0]).max()), float(rotation_angle_between(R[0], R).max())


@value
class Problem:
    """n observed centres with the poses they belong to, in the poses' order.

    scanners: one per run;  run (n,): index of the run;  index (n,): row in the run's pose table.
    R_MH (n, 3, 3), t_MH (n, 3), alpha (n,): the poses.  ball (n,): index into ball_ids.
    x_D (n, 2) px, covariance (n, 2, 2) px^2, W (n, 2, 2) its whitener.
    not_seen: ids of poses whose ball was not measured, with the reason.
    orientations (n, 3 or 4): the orientation columns as written, in the convention's unit, or None.
    units_confirmed: the user says that unusual magnitudes of the poses are right.
    convention_confirmed: the user says that the orientation columns are in the declared convention.
    outline (n,): product of the semi axes of the silhouettes, px^2, NaN where unknown;  ball_diameter: mm; or None.
    """

    scanners: tuple[Scanner, ...]
    R_MH: Array
    t_MH: Array
    alpha: Array
    run: Any
    index: Any
    ball: Any
    ball_ids: tuple[int, ...]
    x_D: Array
    covariance: Array
    W: Array
    pose_id: tuple[str, ...]
    not_seen: dict[str, str]
    time_utc: tuple[str, ...] | None = None
    pivot: Array | None = None
    convention: str = "pi-hexapod"
    orientations: Array | None = None
    units_confirmed: bool = False
    convention_confirmed: bool = True
    outline: Array | None = None
    ball_diameter: float | None = None

    def __len__(self) -> int:
        return len(self.pose_id)

    @property
    def scanner(self) -> Scanner:
        return self.scanners[0]

    @functools.cached_property
    def s_0(self) -> Array:
        """(runs, 13) scanner vectors at nominal values."""
        return np.array([scanner_vector(s) for s in self.scanners])

    @functools.cached_property
    def poses(self) -> Array:
        """(n, 14): the poses as compiled code takes them."""
        return poses_of(self.R_MH, self.t_MH, self.alpha)

    @functools.cached_property
    def T_MH(self) -> RigidTransform:
        """The poses."""
        return RigidTransform(R=self.R_MH, t=self.t_MH, source=Frame.M, target=Frame.H)

    def select(self, keep: Any) -> Problem:
        """The observations with those indices (or that mask)."""
        keep = np.asarray(keep)
        if keep.dtype == bool and keep.all():
            return self
        k = np.arange(len(self))[keep]
        rows: dict[str, Any] = {
            name: np.ascontiguousarray(getattr(self, name)[k])
            for name in ("R_MH", "t_MH", "alpha", "run", "index", "ball", "x_D", "covariance", "W")
        }
        return replace(
            self,
            **rows,
            pose_id=tuple(self.pose_id[i] for i in k),
            time_utc=None if self.time_utc is None else tuple(self.time_utc[i] for i in k),
            orientations=None if self.orientations is None else self.orientations[k],
            outline=None if self.outline is None else self.outline[k],
        )

    def with_covariance(self, covariance: Array) -> Problem:
        """The same centres with other covariances (n, 2, 2)."""
        other = replace(self, covariance=covariance, W=whiteners(covariance))
        for name in ("s_0", "poses", "T_MH"):  # what was calculated of the poses is theirs too
            if name in vars(self):
                vars(other)[name] = vars(self)[name]
        return other


def elapsed(problem: Problem) -> Array:
    """(n,) time since the first image, s; the place in the sequence where no times are known."""
    if problem.time_utc is not None:
        try:
            t = np.array([datetime.fromisoformat(s).timestamp() for s in problem.time_utc])
        except ValueError:
            t = np.zeros(0)
        if t.size and np.ptp(t) > 0:
            return np.asarray(t - t.min())
    return np.arange(len(problem), dtype=np.float64)


def rotated(problem: Problem, R: Array) -> Problem:
    """The same centres and translations under the rotations R (n, 3, 3)."""
    return replace(problem, R_MH=np.ascontiguousarray(R))


def _written_orientations(runs: Sequence[PoseSequence], rows: Sequence[Array]) -> Array | None:
    """(n, 3 or 4) orientation columns where every run still holds those of its own poses, in one convention.

    Poses that were replaced since they were read, by corrected ones for example, no longer belong to the columns; an
    inverse table (the scanner moves) does.
    """
    parts = []
    for poses, k in zip(runs, rows, strict=True):
        if poses.orientations is None or poses.convention != runs[0].convention:
            return None
        R = rotation_from_convention(np.array(poses.orientations), poses.convention)
        either = (poses.T_MH.R, np.swapaxes(poses.T_MH.R, 1, 2))
        if not any(rotation_angle_between(R, T).max() <= SAME_ROTATION_RAD for T in either):
            return None
        parts.append(poses.orientations[k])
    return np.concatenate(parts)


def _one_diameter(runs: Sequence[BallObservations]) -> float | None:
    """The diameter that all runs state; None where one states none or another."""
    stated = {o.ball_diameter for o in runs}
    return stated.pop() if len(stated) == 1 else None


def _as_runs(value: Any, kind: type) -> list[Any]:
    return [value] if isinstance(value, kind) else list(value)


def _balls(poses: PoseSequence, observations: BallObservations, rows: np.ndarray, k: np.ndarray) -> Array:
    """(len(rows),) which ball each observed row is of; k: the rows' poses.

    A pose table without ball ids has one ball, 0; the observations then say which. InputError where both name balls
    and differ.
    """
    named = np.asarray(poses.ball_id)
    if observations.ball_id is None:
        return np.asarray(named[k])
    seen = np.asarray(observations.ball_id)[rows]
    if not named.any():
        return np.asarray(seen)
    off = np.flatnonzero(seen != named[k])
    if off.size:
        i = int(off[0])
        raise InputError(
            f"pose {poses.pose_id[k[i]]!r}: the pose table says ball {named[k[i]]}, the observations ball {seen[i]} "
            f"({off.size} of {len(rows)} rows differ); correct one of the two ball_id columns"
        )
    return np.asarray(seen)


def _common_pivot(
    poses: Sequence[PoseSequence], observations: Sequence[BallObservations], scanners: Sequence[Scanner]
) -> Array | None:
    """The pivot of all runs, (3,) mm, or None where none is stated; InputError where the runs do not fit together."""
    if len(poses) != len(observations):
        raise InputError(f"{len(poses)} pose tables but {len(observations)} sets of observations; each run needs both")
    if len(scanners) != len(poses):
        raise InputError(f"{len(scanners)} scanners for {len(poses)} runs; give one, or one for each run")
    pivots = [p.pivot for p in poses if p.pivot is not None]
    for other in pivots[1:]:
        if np.abs(other - pivots[0]).max() > PIVOT_TOLERANCE_MM:
            raise InputError(f"the runs have different pivots, {pivots[0]} and {other} mm; H differs between them")
    return pivots[0] if pivots else None


def pair(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
) -> Problem:
    """Pair observations with poses by pose_id, whatever their order; several runs where sequences are given.

    Runs share the mount T_HT and, under one ball_id, the ball.  One scanner serves all runs or each has its own
    (magnifications differ in d_SR).  In several runs ids are written RUN:ID.

    Raises InputError for ids without a pose, fewer than five observed poses, ball ids that contradict each other, and
    pivots that differ between runs.
    """
    runs_p, runs_o = _as_runs(poses, PoseSequence), _as_runs(observations, BallObservations)
    scanners = _as_runs(scanner, Scanner)
    if len(scanners) == 1:
        scanners = scanners * len(runs_p)
    pivot = _common_pivot(runs_p, runs_o, scanners)
    several = len(runs_p) > 1
    parts: dict[str, list[Any]] = {k: [] for k in ("R", "t", "alpha", "run", "index", "ball", "x", "C", "outline")}
    ids: list[str] = []
    times: list[str] = []
    not_seen: dict[str, str] = {}
    for r, (p, o) in enumerate(zip(runs_p, runs_o, strict=True)):
        where = p.index_of(o.pose_id)
        prefix = f"{r}:" if several else ""
        seen = np.asarray(o.seen)
        words = o.status or ("not seen",) * len(o)
        not_seen |= {prefix + o.pose_id[k]: words[k] for k in np.flatnonzero(~seen)}
        rows = np.flatnonzero(seen)
        rows = rows[np.argsort(where[rows], kind="stable")]
        k = where[rows]
        parts["R"].append(p.T_MH.R[k])
        parts["t"].append(p.T_MH.t[k])
        parts["alpha"].append(np.asarray(p.alpha)[k])
        parts["run"].append(np.full(len(k), r))
        parts["index"].append(k)
        parts["ball"].append(_balls(p, o, rows, k))
        parts["x"].append(o.x_D[rows])
        parts["C"].append(o.covariance[rows])
        parts["outline"].append(np.full(len(rows), np.nan) if o.outline is None else o.outline[rows])
        ids += [prefix + p.pose_id[i] for i in k]
        if p.time_utc is not None:
            times += [p.time_utc[i] for i in k]
    n = len(ids)
    if n < FEWEST_POSES:
        raise InputError(
            f"only {n} poses have an observed ball{f' ({len(not_seen)} were not seen)' if not_seen else ''}; at least "
            f"{FEWEST_POSES} are needed for the nine parameters of eq. (7), and some tens for a sound uncertainty"
        )
    balls = np.concatenate(parts["ball"])
    ball_ids, ball = np.unique(balls, return_inverse=True)
    if 2 * n <= 6 + 3 * len(ball_ids):
        raise InputError(f"{n} poses give {2 * n} equations for {6 + 3 * len(ball_ids)} unknowns; image more poses")
    C = np.ascontiguousarray(np.concatenate(parts["C"]))
    return Problem(
        scanners=tuple(scanners),
        R_MH=np.ascontiguousarray(np.concatenate(parts["R"])),
        t_MH=np.ascontiguousarray(np.concatenate(parts["t"])),
        alpha=np.ascontiguousarray(np.concatenate(parts["alpha"])),
        run=np.concatenate(parts["run"]).astype(np.int64),
        index=np.concatenate(parts["index"]).astype(np.int64),
        ball=ball.reshape(-1).astype(np.int64),
        ball_ids=tuple(int(b) for b in ball_ids),
        x_D=np.ascontiguousarray(np.concatenate(parts["x"])),
        covariance=C,
        W=np.ascontiguousarray(whiteners(C)),
        pose_id=tuple(ids),
        not_seen=not_seen,
        time_utc=tuple(times) if len(times) == n else None,
        pivot=pivot,
        convention=runs_p[0].convention,
        orientations=_written_orientations(runs_p, parts["index"]),
        units_confirmed=all(p.units_confirmed for p in runs_p),
        convention_confirmed=all(p.convention_confirmed for p in runs_p),
        outline=np.concatenate(parts["outline"]),
        ball_diameter=_one_diameter(runs_o),
    )
