r"""The uncertainty of lengths from drawn scans: the noise itself goes forward through SART, surface and fits.

The expected images are those of the part alone, of one attenuation or, where the beam is known, of all its energies.
Each draw has Poisson numbers of quanta and normal readout noise of its own seed, the steps of SART on the box that
`--sweeps` and `--room-mm` describe, and the measurement plan as `measure` carries it out.  Nothing is taken as linear:
edges, plateaus and points without an edge vary from draw to draw as they will from scan to scan.  The standard
deviation s of K values is itself uncertain by s / sqrt(2 (K - 1)).
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from tomopose.engines.cpu import CpuEngine, processors
from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.measurement.bench import Bench
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.measure import evaluate
from tomopose.measurement.plan import MeasurandPlan, MeasurementPlan
from tomopose.measurement.surface.edges import EdgeSettings, search_edges
from tomopose.planning.part.sart_steps import planned_scan, relaxed_per_length, sart
from tomopose.planning.part.targets import Target
from tomopose.planning.part.worth import Goal
from tomopose.units import Array
from tomopose.volume import Volume

NOISE = 21
"""Stream of the seed that the noise takes: no other random numbers share it."""
ENOUGH = 0.5
"""Share of the draws that have to measure a value, below which nothing is predicted."""
LEAST_QUANTA = 0.5
"""Of a pixel whose logarithm is taken: Poisson numbers may be 0."""
POINTS_OWN = EdgeSettings(plateau_radius=0.0)
"""Of single points: plateaus of their own, as a measurement plan's points have them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnScans:
    """Values of K scans, nan where one could not be measured.

    points:  target -> (K, k) mm, its place along each direction that it has, or of single points along their normals.
    radii:   target -> (K,) mm, of those that have a radius;  lengths: measurand -> (K,) mm.
    """

    points: Mapping[str, Array]
    radii: Mapping[str, Array]
    lengths: Mapping[str, Array]


def scatter(values: Array) -> float:
    """Standard deviation of values (K,), inf where fewer than ENOUGH of them are there."""
    kept = values[np.isfinite(values)]
    return float(np.std(kept, ddof=1)) if len(kept) >= max(ENOUGH * len(values), 2) else math.inf


def scatter_of_place(target: Target, x: Array) -> float:
    """mm, of places x (K, k): along the direction of the largest, or of single points on average."""
    if _single(target):
        found = np.array([scatter(column) for column in x.T])
        known = found[np.isfinite(found)]
        return float(np.sqrt(np.mean(known**2))) if len(known) >= ENOUGH * len(found) else math.inf
    kept = x[np.isfinite(x).all(axis=1)]
    if len(kept) < max(ENOUGH * len(x), 2):
        return math.inf
    return float(np.sqrt(np.linalg.eigvalsh(np.atleast_2d(np.cov(kept, rowvar=False)))[-1]))


def drawn_scans(
    goal: Goal,
    scanner: Scanner,
    P: Array,
    *,
    plan: MeasurementPlan | None,
    progress: Callable[[str], None],
) -> DrawnScans:
    """Of views with matrices P (n, 3, 4), part at home -> pixels, as often as the settings say.

    plan: what is measured, single points of the surface without;  progress: is given a line at every tenth.
    """
    K, targets = goal.settings.draws, goal.targets
    directions = {t.name: _directions(t) for t in targets}
    points = {t.name: np.full((K, len(t.x) if _single(t) else len(directions[t.name])), np.nan) for t in targets}
    radii = {t.name: np.full(K, np.nan) for t in targets if t.shape is not None}
    values = {m.name: np.full(K, np.nan) for m in (() if plan is None else plan.measurands)}
    start = time.monotonic()
    for k, volume in enumerate(_volumes(goal, scanner, P)):
        for t in targets if plan is None else ():
            points[t.name][k] = _offsets(volume, t)
        features, found = ({}, {}) if plan is None else measured(volume, plan)
        for name, f in features.items():
            points[name][k] = directions[name] @ f.point
            if name in radii:
                radii[name][k] = f.radius
        for name, value in found.items():
            values[name][k] = value
        if 10 * (k + 1) // K > 10 * k // K:
            left = (time.monotonic() - start) * (K - k - 1) / (k + 1)
            progress(f"drawn scans: {k + 1} of {K}" + (f", {left:.0f} s left" if k + 1 < K else ""))
    return DrawnScans(points=points, radii=radii, lengths=values)


def _volumes(goal: Goal, scanner: Scanner, P: Array) -> Iterator[Volume]:
    """One draw after the other, reconstructed on all processors; few are in memory at once."""
    settings = goal.settings
    found, matrices, box = planned_scan(goal.part, scanner, P, settings)
    engine = CpuEngine(matrices, box, threads=1)
    per_mm, open_beam = relaxed_per_length(engine), settings.quanta * found.size**2

    def reconstructed(k: int) -> Volume:
        p = line_integrals(found.tau, open_beam, settings.readout * found.size, seed=settings.seed, draw=k)
        return Volume(sart(engine, per_mm, p, settings.sweeps), box)

    with ThreadPoolExecutor(processors()) as pool:
        coming: deque[Future[Volume]] = deque()
        try:
            for k in range(settings.draws):
                coming.append(pool.submit(partial(reconstructed, k)))
                if len(coming) > processors():
                    yield coming.popleft().result()
            while coming:
                yield coming.popleft().result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def line_integrals(tau: Array, quanta: float, readout: float, *, seed: int, draw: int) -> Array:
    """(n, n_v, n_u) of one scan, from transmissions tau, quanta of an open pixel and readout noise in quanta."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, NOISE, draw]))
    counted = rng.poisson(quanta * tau).astype(np.float64)
    if readout > 0:
        counted += readout * rng.standard_normal(tau.shape)
    return np.asarray(-np.log(np.maximum(counted, LEAST_QUANTA) / quanta))


def measured(volume: Volume, plan: MeasurementPlan) -> tuple[dict[str, Feature], dict[str, float]]:
    """(features, values) of all that can be measured: one after the other where not all can be."""
    try:
        return _measured(volume, plan)
    except InputError:
        pass
    features: dict[str, Feature] = {}
    values: dict[str, float] = {}
    for name in plan.features:
        features |= _alone(volume, plan, (name,), ())[0]
    for m in plan.measurands:
        values |= _alone(volume, plan, m.of, (m,))[1]
    return features, values


def _measured(volume: Volume, plan: MeasurementPlan) -> tuple[dict[str, Feature], dict[str, float]]:
    """As `measure` does, without the uncertainty that it finds in each fit."""
    bench = Bench(volume, plan, reach=0.0)
    alignment = bench.alignment()
    features = bench.features(alignment)
    return features, {r.name: r.value for r in evaluate(plan, features, alignment)}


def _alone(
    volume: Volume, plan: MeasurementPlan, of: tuple[str, ...], measurands: tuple[MeasurandPlan, ...]
) -> tuple[dict[str, Feature], dict[str, float]]:
    """Of some features, beside those that the alignment needs, and some measurands; nothing where that fails."""
    kept = {k: v for k, v in plan.features.items() if k in (*of, *plan.alignment.datums)}
    try:
        return _measured(volume, plan.model_copy(update={"features": kept, "measurands": measurands}))
    except InputError:
        return {}, {}


def _single(target: Target) -> bool:
    """Whether it has no shape: its uncertainty is that of single points."""
    return target.shape is None and target.kind not in ("plane", "line")


def _directions(target: Target) -> Array:
    """(k, 3) along which its place is looked at: a normal, across an axis, in a circle's plane, or all of space."""
    if target.shape is None:
        return target.n[:1]
    return np.asarray(np.eye(3) if target.shape.kind == "sphere" else target.shape.frame[:2])


def _offsets(volume: Volume, target: Target) -> Array:
    """(m,) mm along the normals, nan where no edge is found."""
    try:
        return search_edges(volume, target.x, target.n, POINTS_OWN).offset
    except InputError:
        return np.full(len(target.x), np.nan)
