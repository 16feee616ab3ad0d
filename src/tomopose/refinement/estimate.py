"""The estimate of volume and poses, coarse to fine, with the prior's sizes by the evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from tomopose.refinement.joint_fit.fit import Fit, State, blank
from tomopose.refinement.joint_fit.measured import Measured, crossed_edges, crossed_faces, rays_through
from tomopose.refinement.joint_fit.motions import pixel_jacobian
from tomopose.refinement.joint_fit.pyramid import finer, level_of
from tomopose.refinement.prior import Prior
from tomopose.refinement.settings import LEAST_PIXELS, MOST_SAMPLES, RefineSettings
from tomopose.refinement.stated import points_of
from tomopose.refinement.uncertainty import VOLUME_UNKNOWN
from tomopose.volume import VoxelGrid

NOTHING_LEFT_PX = 0.02
"""Rms errors of the views, px, by the evidence, below which finer levels are left out: what images of 100 px reach with
the object known."""
LATER_LOOK = 2.0
"""Factor by which a look at the evidence after the first one may change the prior's sizes."""
Progress = Callable[[int, int], None] | None


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """state, prior: with the sizes of the evidence; faces, edges: of the grid and of the images that the object
    crosses; data: without the rays that meet what lies beyond the faces; judged: the binning at which the held-out
    pixels are compared."""

    state: State
    prior: Prior
    faces: tuple[str, ...]
    edges: tuple[str, ...]
    data: Measured
    judged: int


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
    data: Measured, factors: tuple[int, ...], prior: Prior, s: RefineSettings, threads: int, steps: Steps
) -> Estimate:
    """Volume and poses, coarse to fine."""
    state: State | None = None
    coarse: VoxelGrid | None = None
    faces: tuple[str, ...] = ()
    edges = crossed_edges(data)
    points, centre, looked = points_of(data.grid), np.asarray(data.grid.centre), False
    for factor in factors:
        level = level_of(data, factor)
        if state is None or coarse is None:
            held = Fit(precision=None, steps=1, turns=s.turns, threads=threads)
            state = held(level, blank(level))
            faces = crossed_faces(state.volume)
            if faces:
                data = without_rays(data, faces)
                level = without_rays(level, faces)
                state = blank(level)
        else:
            # the volume first: poses would follow what a coarse one lacks
            held = Fit(precision=None, steps=1, turns=s.turns, threads=threads)
            state = held(level, replace(state, volume=finer(state.volume, coarse, level.grid)))
        for _ in range(1 if looked else 2):
            first_look = Fit(precision=prior.precision, steps=s.steps, turns=s.turns, threads=threads)
            later = replace(first_look, steps=max(1, s.steps // 2))
            state = (later if looked else first_look)(level, state)
            if state.information is not None:
                information = scipy.linalg.block_diag(*state.information) / VOLUME_UNKNOWN
                prior = prior.by_evidence(state.q, information, most=LATER_LOOK if looked else np.inf)
                prior = prior.with_jumps(state.q)
                looked = True
            steps.done()
        coarse, judged = level.grid, max(factor, min(2, factors[0]))
        if faces or edges or prior.size_px(pixel_jacobian(data.matrices.P, points, centre)) < NOTHING_LEFT_PX:
            break  # finer levels would not change what is said
    assert state is not None
    return Estimate(state=state, prior=prior, faces=faces, edges=edges, data=data, judged=judged)


def without_rays(data: Measured, faces: tuple[str, ...]) -> Measured:
    """The data with the rays left out that cross one of the grid's faces."""
    through = rays_through(data, faces)
    zero = np.float32(0)
    return replace(data, weight=np.where(through, zero, data.weight), judge=np.where(through, zero, data.judge))


def levels_of(data: Measured, s: RefineSettings) -> tuple[int, ...]:
    """Binnings, coarse to fine, that leave enough pixels and whose work is affordable."""
    m, grid = data.matrices, data.grid
    if s.levels is not None:
        return tuple(sorted({int(f) for f in s.levels}, reverse=True))

    def samples(f: int) -> float:
        return len(m) * (m.n_u / f) * (m.n_v / f) * max(grid.shape) / f

    finest = next((f for f in (1, 2, 4, 8, 16) if samples(f) <= MOST_SAMPLES), 16)
    return tuple(f for f in (4 * finest, 2 * finest) if min(m.n_u, m.n_v) // f >= LEAST_PIXELS) + (finest,)
