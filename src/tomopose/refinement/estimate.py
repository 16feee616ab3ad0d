"""The estimate of volume and poses, coarse to fine, with the prior's sizes by the evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from tomopose.reconstruction.memory import BASE, memory_limit, padded_bytes
from tomopose.refinement.checkpoint import Checkpoint, Reached
from tomopose.refinement.joint_fit.balls import Balls
from tomopose.refinement.joint_fit.fit import Fit, State, blank
from tomopose.refinement.joint_fit.measured import Measured, crossed_edges, crossed_faces, rays_through
from tomopose.refinement.joint_fit.motions import pixel_jacobian
from tomopose.refinement.joint_fit.projector import Workers
from tomopose.refinement.joint_fit.pyramid import binned, finer, level_of
from tomopose.refinement.prior import Prior
from tomopose.refinement.settings import IMAGE_COPIES, LEAST_PIXELS, MOST_SAMPLES, VOLUME_COPIES, RefineSettings
from tomopose.refinement.stated import points_of
from tomopose.refinement.uncertainty import VOLUME_UNKNOWN
from tomopose.units import Array

NOTHING_LEFT_PX = 0.02
"""Rms errors of the views, px, by the evidence, below which finer levels are left out: what images of 100 px reach with
the object known."""
FEWEST_RAYS = 0.2
"""Share of the rays below which those that are left determine no volume: all are fitted, and the verdict says so."""
LATER_LOOK = 2.0
"""Factor by which a look at the evidence after the first one may change the prior's sizes."""
Progress = Callable[[int, int], None] | None


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """state, prior: with the sizes of the evidence; faces, edges: of the grid and of the images that the object
    crosses; data: without the rays that meet what lies beyond the faces; judged: the binning at which the held-out
    pixels are compared; K: (n, m, 2, 6), px per motion, of `points_of` the grid."""

    state: State
    prior: Prior
    faces: tuple[str, ...]
    edges: tuple[str, ...]
    data: Measured
    judged: int
    K: Array


class Steps:
    """Counts the stages for `progress`."""

    def __init__(self, total: int, progress: Progress) -> None:
        self._total, self._progress, self._done = total, progress, 0

    def done(self) -> None:
        self._done = min(self._done + 1, self._total)
        if self._progress:
            self._progress(self._done, self._total)

    def finish(self) -> None:
        self._done = self._total - 1
        self.done()


def estimate(
    data: Measured,
    factors: tuple[int, ...],
    prior: Prior,
    s: RefineSettings,
    workers: Workers,
    steps: Steps,
    checkpoint: Checkpoint | None = None,
    balls: Balls | None = None,
) -> Estimate:
    """Volume and poses, coarse to fine; what a level reached is kept in the checkpoint, and continued from there."""
    edges = crossed_edges(data)
    K = pixel_jacobian(data.matrices.P, points_of(data.grid), np.asarray(data.grid.centre))
    reached = None if checkpoint is None else checkpoint.resume(prior)
    while reached is None or not (reached.levels == len(factors) or said_already(reached, edges, K)):
        reached = next_level(data, factors, prior, s, workers, steps, reached, balls)
        if checkpoint is not None:
            checkpoint.keep(reached)
    return Estimate(
        state=reached.state,
        prior=reached.prior,
        faces=reached.faces,
        edges=edges,
        data=without_rays(data, reached.faces),
        judged=judged_at(data, factors, factors[reached.levels - 1]),
        K=K,
    )


def judged_at(data: Measured, factors: tuple[int, ...], finest: int) -> int:
    """The binning at which the held-out pixels, the draws and the halves are taken: twice the finest that was fitted,
    an eighth of its work, where enough pixels remain and no coarser than the coarsest."""
    twice = min(2 * finest, factors[0])
    return twice if min(data.matrices.n_u, data.matrices.n_v) // twice >= LEAST_PIXELS else finest


def said_already(reached: Reached, edges: tuple[str, ...], K: Array) -> bool:
    """Whether finer levels would not change what is said: the object is cut, or hardly any errors are left."""
    return bool(reached.faces or edges) or reached.prior.size_px(K) < NOTHING_LEFT_PX


def next_level(
    data: Measured,
    factors: tuple[int, ...],
    prior: Prior,
    s: RefineSettings,
    workers: Workers,
    steps: Steps,
    reached: Reached | None,
    balls: Balls | None = None,
) -> Reached:
    """The first level, from nothing, or the one after what was reached."""
    held = Fit(precision=None, steps=1, turns=s.turns, workers=workers)
    if reached is None:
        level = level_of(data, factors[0])
        state = held(level, blank(level))
        faces = crossed_faces(state.volume)
        if faces:
            level = without_rays(level, faces)
            state = blank(level)
        fit = Fit(precision=prior.precision, steps=s.steps, turns=s.turns, workers=workers, balls=balls)
        state = fit(level, state)
        prior = by_evidence(prior, state, balls, most=np.inf)
        steps.done()
    else:
        prior, faces = reached.prior, reached.faces
        level = without_rays(level_of(data, factors[reached.levels]), faces)
        coarse = binned(data, factors[reached.levels - 1]).grid
        # the volume first: poses would follow what a coarse one lacks
        state = held(level, replace(reached.state, volume=finer(reached.state.volume, coarse, level.grid)))
    later = max(1, s.steps // 2)
    fit = Fit(precision=prior.precision, steps=later, turns=s.turns, workers=workers, balls=balls)
    state = fit(level, state)
    steps.done()
    levels = 1 if reached is None else reached.levels + 1
    prior = by_evidence(prior, state, balls, most=LATER_LOOK)
    return Reached(levels=levels, state=state, prior=prior, faces=faces)


def by_evidence(prior: Prior, state: State, balls: Balls | None, *, most: float) -> Prior:
    """The prior with the sizes that the state's motions show, and wider where a view jumps."""
    if state.information is None:
        return prior
    information = scipy.linalg.block_diag(*state.information) / VOLUME_UNKNOWN
    if balls is not None:
        information += balls.reduced(state.q)[0]
    return prior.by_evidence(state.q, information, most=most).with_jumps(state.q)


def without_rays(data: Measured, faces: tuple[str, ...]) -> Measured:
    """The data with the rays left out that cross one of the grid's faces, where enough of them remain."""
    if not faces:
        return data
    through = rays_through(data, faces)
    if float(through.mean()) > 1 - FEWEST_RAYS:
        return data
    zero = np.float32(0)
    return replace(data, weight=np.where(through, zero, data.weight), judge=np.where(through, zero, data.judge))


def levels_of(data: Measured, s: RefineSettings) -> tuple[int, ...]:
    """Binnings, coarse to fine, that leave enough pixels and whose work and memory are affordable."""
    m, grid = data.matrices, data.grid
    if s.levels is not None:
        return tuple(sorted({int(f) for f in s.levels}, reverse=True))
    limit = memory_limit(s.memory_gib)

    def affordable(f: int) -> bool:
        pixels = len(m) * (m.n_u / f) * (m.n_v / f)
        needed = BASE + 4 * IMAGE_COPIES * pixels + VOLUME_COPIES * padded_bytes(grid) / f**3
        return pixels * max(grid.shape) / f <= MOST_SAMPLES and (limit is None or needed <= limit)

    finest = next((f for f in (1, 2, 4, 8, 16) if affordable(f)), 16)
    return tuple(f for f in (4 * finest, 2 * finest) if min(m.n_u, m.n_v) // f >= LEAST_PIXELS) + (finest,)
