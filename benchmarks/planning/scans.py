"""Virtual scans along a planned path and the circular one: noise, blur, scatter, beam hardening; SART; lengths.

Coarse on purpose: a panel read out in blocks (the box's walls need its pixels), voxels of a pixel's size at the part,
few views.  The projections of a path are simulated once; each draw adds noise of its own, reconstructs, and measures by
the plan.  Mean and scatter of the draws separate what is systematic (few views, cone beam, hardening, scatter,
sampling) from what is random, and it is the random part that the prediction states: by filters; through SART's own
steps ("exact"); these with the profiles and pixels of the scan with hardening and scatter in place of those of a part
of one attenuation ("volume"); by scans drawn for the prediction ("drawn"), which share neither projector nor random
numbers with the virtual scans, know the tube's spectrum and nothing of scatter.  The scatter of few draws is itself
uncertain; with --draws 0 the predictions alone.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from parts import Case
from scipy.stats import chi2

import tomopose as tp
from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.measurement.surface.splines import spline_coefficients
from tomopose.planning.part.material_paths import material_paths
from tomopose.planning.part.predict import predicted
from tomopose.planning.part.sart_steps import SartSteps
from tomopose.planning.part.worth import table
from tomopose.planning.part_scan.paths import usual_paths
from tomopose.planning.part_scan.plan import plan_part_scan
from tomopose.planning.part_scan.setting import Setting
from tomopose.reconstruction.line_integrals import Correction
from tomopose.reconstruction.settings import SART
from tomopose.simulation.detector.detector import Detector, expose
from tomopose.simulation.detector.scatter_glare_mtf import Scatter
from tomopose.simulation.objects.mesh import MeshSolid, TriangleMesh
from tomopose.simulation.physics.spectrum import condense, tube_spectrum
from tomopose.simulation.run import SimulatedRun, signal
from tomopose.units import Array

ROOM = 14
"""ROOM: voxels about the part, so that profiles along the normals stay in the grid."""
SWEEPS, SCATTER = 4, Scatter(amount=0.2, sigma=20.0)
HALF_DRAWS = 2
"""Of the plan with half as many views, whose error is looked at and not its scatter."""
HOLDS = (0.8, 1.25)
WAYS = ("filters", "exact", "drawn", "volume")
"""Predicted by filters, through SART's own steps, from drawn scans, and through the steps with the profiles and the
noise of the actual scan."""
PREDICTION_DRAWS = 100
TUBE_KV, FILTER, MATERIAL = 120.0, ("Cu", 0.5), "Al"
PATHS = ("plan", "half", "circular")
"""half: planned with half as many views."""


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """Of one path: length -> values of the draws minus the nominal one, mm;  predicted: way -> length -> u, mm."""

    errors: dict[str, list[float]]
    predicted: dict[str, dict[str, float]]

    @property
    def rms(self) -> float:
        return math.sqrt(np.mean([np.square(v).mean() for v in self.errors.values()]))

    def scatter(self, name: str) -> float:
        return float(np.std(self.errors[name], ddof=1)) if len(self.errors[name]) > HALF_DRAWS else math.nan


def nominal(plan: tp.MeasurementPlan) -> dict[str, float]:
    """The nominal value of each length, mm, from the plan's own geometry."""
    found = {}
    for m in plan.measurands:
        a = plan.features[m.of[0]]
        if m.kind == "diameter":
            found[m.name] = 2 * float(a.radius_mm or 0)
        else:
            b = plan.features[m.of[1]]
            n = np.array(b.direction) / np.linalg.norm(b.direction or (1.0,))
            found[m.name] = float(abs((np.array(a.point) - b.point) @ n))
    return found


def spacing(task: Setting) -> float:
    """A pixel's size at the rotation axis, mm."""
    return task.scanner.p_u * task.scanner.d_SR / task.scanner.d_SD


def grid(case: Case, task: Setting) -> tp.VoxelGrid:
    n = np.ceil(np.ptp(case.part.mesh.points, axis=0) / spacing(task)).astype(int) + 2 * ROOM
    return tp.VoxelGrid((int(n[2]), int(n[1]), int(n[0])), spacing(task), case.part.centre)


def virtual_run(case: Case, task: Setting, q: Array) -> SimulatedRun:
    mesh = TriangleMesh(vertices=case.part.mesh.points, faces=case.part.mesh.faces)
    poses, machine, s = task.machine.poses(q), task.machine, task.settings
    home = (machine.scanner.T_TW(0.0) @ machine.T_HT).inv
    return SimulatedRun(
        scanner=task.scanner,
        poses=poses,
        T_HT=machine.T_HT,
        T_MH=poses.T_MH,
        solids=(),
        meshes=(MeshSolid(mesh=mesh.placed(R=home.R, t=home.t), material=MATERIAL, frame=Frame.M),),
        spectrum=tube_spectrum(TUBE_KV).filtered(*FILTER),
        detector=Detector(snr=math.sqrt(s.quanta), blur_sigma=s.blur, scatter=SCATTER),
        seed=1,
    )


def apparent_mu(case: Case, P: Array, signals: list[Array]) -> float:
    """The part's attenuation as radiographs show it, with hardening and scatter, 1/mm: line integrals over lengths."""
    top = bottom = 0.0
    for p, image in zip(P, signals, strict=True):
        u, v = np.meshgrid(*(np.arange(k, dtype=float) for k in image.shape[::-1]))
        rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
        x = (float(p[2, 3]) * rays - p[:, 3]) @ np.linalg.inv(p[:, :3]).T
        L = material_paths(p[None], case.part.mesh.points, case.part.mesh.faces, x)[0][0]
        top += float(-np.log(image).ravel() @ L)
        bottom += float(L @ L)
    return top / bottom


@dataclass(frozen=True, kw_only=True, eq=False)
class VirtualScan:
    """The projections of a path, simulated once: signals (n_v, n_u) of each view as a share of the empty beam."""

    run: SimulatedRun
    signals: list[Array]
    matrices: ProjectionMatrices
    box: tp.VoxelGrid

    @classmethod
    def along(cls, case: Case, task: Setting, q: Array) -> VirtualScan:
        run, s = virtual_run(case, task, q), task.scanner
        names, P = run.poses.pose_id, task.machine.matrices(q)
        matrices = ProjectionMatrices(P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=names, scanner=s)
        signals = [np.asarray(signal(run, i)) for i in range(len(run))]
        return cls(run=run, signals=signals, matrices=matrices, box=grid(case, task))

    def volume(self, images: list[Array]) -> tp.Volume:
        levels = Correction(images_are="counts", white=self.run.detector.white, dark=0.0)
        how = SART(iterations=SWEEPS)
        return tp.reconstruct(images, self.matrices, self.box, algorithm=how, correction=levels, consistency="off")

    def drawn(self, k: int) -> tp.Volume:
        """With the detector's noise of seed k."""
        shown = enumerate(self.signals)
        return self.volume([expose(x, self.run.detector, self.run.scanner, seed=k, frame=i) for i, x in shown])


def achieved(case: Case, scan: VirtualScan, draws: int, kept: Path | None) -> dict[str, list[float]]:
    """Length -> measured minus nominal, mm, of each draw; draws are kept in a file, and taken from it, if asked for."""
    true, box = nominal(case.lengths), scan.box
    said = f"{SWEEPS} {box.shape} {box.spacing} {case.lengths.model_dump_json()}".encode()
    key = hashlib.sha256(scan.matrices.P.tobytes() + np.stack(scan.signals).tobytes() + said).hexdigest()[:16]
    file = None if kept is None else kept / f"{key}.jsonl"
    lines = file.read_text("utf-8").splitlines() if file is not None and file.exists() else []
    found = {row["seed"]: row["errors"] for row in map(json.loads, lines)}
    for k in (k for k in range(draws) if k not in found):
        found[k] = {r.name: r.value - true[r.name] for r in tp.measure(scan.drawn(k), case.lengths).results}
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            with file.open("a", encoding="utf-8") as out:
                out.write(json.dumps({"seed": k, "errors": found[k]}) + "\n")
    return {name: [found[k][name] for k in range(draws)] for name in true}


def predictions(case: Case, task: Setting, scan: VirtualScan, ways: Sequence[str]) -> dict[str, dict[str, float]]:
    """Way -> length -> predicted u, mm."""
    P, few = scan.matrices.P, slice(None, None, max(len(scan.signals) // 8, 1))
    mu = apparent_mu(case, P[few], scan.signals[few])
    shown = replace(task.settings, mu=mu, sweeps=SWEEPS, room=ROOM * spacing(task))
    goal = replace(task, features=case.lengths).goal(judged=True)
    out = {}
    for way in ways:
        start, how, response = time.process_time(), shown, None
        if way == "volume":
            coefficients = spline_coefficients(scan.volume([x * scan.run.detector.white for x in scan.signals]).values)
            variance = 1 / (shown.quanta * np.stack(scan.signals))
            response = SartSteps(
                matrices=scan.matrices, variance=variance, box=scan.box, coefficients=coefficients, sweeps=SWEEPS
            )
        else:
            how = replace(shown, uncertainty=way, draws=PREDICTION_DRAWS, beam=beam(case) if way == "drawn" else ())
        known = replace(goal, settings=how)
        out[way] = predicted(known, task.scanner, P, table(known, P), plan=case.lengths, response=response).lengths
        print(f"  {way}: {time.process_time() - start:.0f} s CPU", flush=True)
    return out


def beam(case: Case) -> tuple[tuple[float, float], ...]:
    """Share and attenuation of the energies of the tube that the scan is planned for; no scatter."""
    tube = tube_spectrum(TUBE_KV).filtered(*FILTER)
    return condense(tube, (MATERIAL,), [case.part.mesh.size]).of_first_material


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """draws: virtual scans of each path;  kept: folder that keeps what they measured."""

    draws: int
    paths: Sequence[str] = PATHS
    ways: Sequence[str] = WAYS
    kept: Path | None = None


def planned(task: Setting, path: str) -> Array:
    """(n, 7) axes of a path."""
    N = task.views // 2 if path == "half" else task.views
    return usual_paths(task.machine, N)[path] if path == "circular" else plan_part_scan(replace(task, views=N)).chosen.q


def compare(name: str, case: Case, task: Setting, wanted: Wanted) -> list[tuple[float, ...]]:
    """Prints errors and scatter of every length along the wanted paths; returns (scatter, u by each way)."""
    task = replace(task, scanner=task.scanner.binned(case.binning), features=case.lengths)
    coarse = replace(task.settings, alpha_step=math.radians(6.0), tilt_step=math.radians(5.0))
    task = replace(task, settings=coarse)
    rows: list[tuple[float, ...]] = []
    for path in wanted.paths:
        start, half = time.process_time(), path == "half"
        q = planned(task, path)
        scan = VirtualScan.along(case, task, q)
        try:
            errors = achieved(case, scan, HALF_DRAWS if half else wanted.draws, wanted.kept)
            u = {} if half else predictions(case, task, scan, wanted.ways)
        except InputError as error:
            print(f"{name:<9} {path:<9}{len(q):>3}  not measurable: {error}", flush=True)
            continue
        found = Lengths(errors=errors, predicted=u)
        for length, values in found.errors.items():
            mean = f"{1000 * np.mean(values):9.1f}" if values else " " * 9
            row = found.scatter(length), *(found.predicted.get(way, {}).get(length, math.nan) for way in WAYS)
            text = "" if half else "".join(" " * 8 if math.isnan(x) else f"{1000 * x:8.2f}" for x in row)
            print(f"{name:<9} {path:<9}{len(q):>3}  {length:<18}{mean}{text}", flush=True)
            rows += [] if half else [row]
        rms = f"rms error {1000 * found.rms:.0f} um, " if all(found.errors.values()) else ""
        print(f"{name:<9} {path:<9}{len(q):>3}  {rms}{time.process_time() - start:.0f} s CPU", flush=True)
    return rows


def _held(words: str, ratios: np.ndarray) -> None:
    ratios = ratios[np.isfinite(ratios) & (ratios > 0)]
    if len(ratios):
        held = (ratios >= HOLDS[0]) & (ratios <= HOLDS[1])
        low, middle, high = np.percentile(ratios, [5, 50, 95])
        print(
            f"{words}: {held.sum()} of {len(ratios)} within {HOLDS[0]} to {HOLDS[1]}; median {middle:.2f}, 5 and 95 % "
            f"{low:.2f}, {high:.2f}"
        )


def perfect(draws: int) -> float:
    """Share of the standard deviations of so many draws that are within HOLDS of the true one."""
    n = draws - 1
    return float(chi2.cdf(n / HOLDS[0] ** 2, n) - chi2.cdf(n / HOLDS[1] ** 2, n))


def compare_all(cases: dict[str, tuple[Case, Setting]], wanted: Wanted) -> None:
    """All parts: mean error, scatter, u by each way in um; how many hold."""
    draws = wanted.draws
    print(f"{draws} draws, {SWEEPS} sweeps of SART; mean error; scatter of the draws; u by {', by '.join(WAYS)}, um")
    rows = [r for name, (case, task) in cases.items() for r in compare(name, case, task, wanted)]
    scatter, *u = np.array(rows).reshape(-1, 1 + len(WAYS)).T
    with np.errstate(invalid="ignore"):
        for way, found in zip(WAYS, u, strict=True):
            _held(f"{way} / volume", found / u[WAYS.index("volume")])
            _held(f"{way} / draws", found / scatter)
    if draws > HALF_DRAWS:
        print(f"a perfect prediction would hold in {100 * perfect(draws):.0f} % of the cases with {draws} draws")
