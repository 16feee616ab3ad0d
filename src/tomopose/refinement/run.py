"""`refine`: each view's geometry corrected from the scan's own images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from tomopose.calibration.result import Calibration
from tomopose.coverage import MAD_TO_SIGMA
from tomopose.engines.cpu import processors
from tomopose.engines.geometry import require_usable
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.provenance import provenance
from tomopose.reconstruction.line_integrals import Correction, ImagesAre, require_contrast
from tomopose.reconstruction.run import line_integrals_of
from tomopose.refinement.halves import difference_of_halves
from tomopose.refinement.joint_fit.fit import Fit, State, blank, linearised
from tomopose.refinement.joint_fit.linear import normal_blocks
from tomopose.refinement.joint_fit.measured import Measured, crossed_edges, crossed_faces, measured, rays_through
from tomopose.refinement.joint_fit.motions import pixel_jacobian, transforms
from tomopose.refinement.joint_fit.pyramid import finer, level_of
from tomopose.refinement.judge import Evidence, Verdict, decide, trial
from tomopose.refinement.prior import Prior, scatter
from tomopose.refinement.result import Refinement
from tomopose.refinement.settings import DEFAULT_SIGMA_PX, LEAST_PIXELS, MOST_SAMPLES, RefineSettings
from tomopose.refinement.uncertainty import (
    VOLUME_UNKNOWN,
    drawn_errors,
    open_directions,
    spread_of,
    widening_of,
)
from tomopose.units import Array
from tomopose.values import Images, require_types
from tomopose.volume import Volume, VoxelGrid

FEWEST_VIEWS = 8
"""Views below which the volume explains any motion of them."""
NOTHING_LEFT_PX = 0.02
"""Rms errors of the views, px, by the evidence, below which finer levels are left out: what images of 100 px reach with
the object known."""
LATER_LOOK = 2.0
"""Factor by which a look at the evidence after the first one may change the prior's sizes."""
GAUGE = (
    "A rigid motion of the whole object, common to all views, is not observable: the object keeps its mean pose.",
    "The size of the object (a depth common to all views) is not observable in its images: scale comes from the "
    "calibration alone and is unchanged.",
)
Progress = Callable[[int, int], None] | None


@require_types
def refine(
    images: Images,
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    calibration: Calibration | None = None,
    *,
    images_are: ImagesAre | None = None,
    correction: Correction | None = None,
    settings: RefineSettings | None = None,
    progress: Progress = None,
) -> Refinement:
    """Correct each view's geometry from the scan's own images: volume and poses are estimated together.

    Parameters
    ----------
    images:      n images [v, u] in any lazy sequence with a length; array row index = v (row 0 is the bottom).
    matrices:    n projection matrices of eq. (5), as calibrated.  Their `points_sigma` is the prior of each view.
    grid:        voxels, mm in W, that hold the whole object.
    calibration: where the matrices state no uncertainty, its residual is the prior; its scale is kept in any case.
    images_are:  "transmission", "line-integrals" or "counts"; never guessed.
    correction:  how images become line integrals (white level, bad pixels, beam hardening ...), as for `reconstruct`.
    settings:    levels, steps, held-out share, seed.
    progress:    called with (steps done, steps in all).

    Returns
    -------
    Refinement.  `matrices` holds the corrected ones where pixels kept out of the fit confirm a gain, else the input's;
    `trustworthy` is False where the images do not determine the correction.

    Raises
    ------
    InputError, ShapeError, ConventionError   for images that cannot be used, or fewer than 8 views.
    OutOfViewError                            where the grid lies outside the field of view.
    """
    s = settings or RefineSettings()
    if len(matrices) < FEWEST_VIEWS:
        raise InputError(f"{len(matrices)} views are too few to refine; at least {FEWEST_VIEWS} are needed")
    require_usable(matrices, grid)
    scan = line_integrals_of(images, matrices, images_are, correction)
    require_contrast(scan, sorted({0, len(scan) // 3, len(scan) // 2, len(scan) - 1}))
    data = measured(scan, grid, held_out=s.held_out, seed=s.seed)
    threads = s.threads or processors()
    prior, stated = prior_of(matrices, grid, s, calibration)
    factors = levels_of(data, s)
    steps = Steps(2 * len(factors) + 4, progress)
    found = estimate(data, factors, prior, s, threads, steps)
    result = assessed(found, matrices, s, threads, steps)
    steps.finish()
    made = provenance(arguments={"prior_px": stated, "levels": list(factors)}, seed=s.seed)
    return replace(result, provenance=made)


def assessed(
    found: Estimate, matrices: ProjectionMatrices, s: RefineSettings, threads: int, steps: Steps
) -> Refinement:
    """What the estimate is worth: the judgement of the held-out pixels, the uncertainty, and what is not observable."""
    data, state, prior = found.data, found.state, found.prior
    centre, radius = np.asarray(data.grid.centre), radius_of(data.grid)
    level = level_of(data, found.judged)
    fit = Fit(precision=prior.precision, steps=3, turns=s.turns, threads=threads)
    held_out, before, after = trial(level, state, fit)
    steps.done()
    at = replace(after, q=state.q)
    here = linearised(level, at, threads=threads)
    information = normal_blocks(here.motions, here.weighed(level))
    left = float((level.weight > 0).mean()) / (1 - s.held_out) if found.faces else 1.0
    open_ = () if found.faces else open_directions(information, prior, radius)
    K = pixel_jacobian(data.matrices.P, points_of(data.grid), centre)
    errors = drawn_errors(level, at, here, prior, samples=s.samples, turns=s.turns, seed=s.seed)
    widening = widening_of(errors, information, prior, K)
    spread = spread_of(widening, information if state.information is None else state.information, prior, K)
    steps.done()
    moved = np.sqrt(np.mean(np.einsum("nmic,nc->nmi", K, state.q) ** 2) / np.mean(spread.points_sigma**2))
    halves = difference_of_halves(level, prior, replace(fit, steps=s.steps), points_of(data.grid))
    verdict, reasons = decide(
        Evidence(
            held_out=held_out,
            chi=state.chi,
            faces=found.faces,
            left=left,
            edges=found.edges,
            open_=open_,
            moved=float(moved),
        )
    )
    refined = replace(
        matrices,
        P=matrices.P @ transforms(state.q, centre),
        points_sigma=spread.points_sigma,
        points_sigma_shared=None,
    )
    return Refinement(
        matrices=refined if verdict is Verdict.REFINED else matrices,
        corrections=state.q,
        sigma=spread.sigma,
        verdict=verdict.value,
        reasons=reasons,
        unobservable=(*GAUGE, *open_),
        residual_before=held_out.residual_before,
        residual_after=held_out.residual_after,
        held_out_before=held_out.before,
        held_out_after=held_out.after,
        held_out_gain=float(held_out.gain),
        iterations=state.steps,
        converged=state.settled,
        chi=state.chi,
        prior_sizes={name: float(size) for name, size in zip(prior.names, prior.sizes, strict=True)},
        outliers=jumps(state.q, spread.sigma, radius),
        widening=widening.factor,
        halves_px=halves,
        stated_px=float(np.sqrt(np.mean(spread.points_sigma**2))),
        volume_before=Volume(values=before.volume, grid=level.grid),
        volume=Volume(values=after.volume, grid=level.grid),
    )


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


def radius_of(grid: VoxelGrid) -> float:
    """Half the longest side of the grid, mm: the lever of a turn."""
    return float(max(grid.spacing * np.array(grid.n_xyz)) / 2)


def points_of(grid: VoxelGrid) -> Array:
    """(9, 3) mm in W: the middle of the grid and the corners of the box of 0.8 of its size."""
    centre = np.asarray(grid.centre)
    return np.concatenate([centre[None], centre + 0.8 * (grid.corners - centre) / np.sqrt(2)])


def prior_of(
    matrices: ProjectionMatrices, grid: VoxelGrid, s: RefineSettings, calibration: Calibration | None
) -> tuple[Prior, float]:
    """The prior of the views' motions, and its size in px (rms): as the settings, the matrices, the calibration or the
    documented default say, in this order."""
    n = len(matrices)
    if s.sigma_px is not None:
        px = np.full(n, s.sigma_px)
    elif matrices.points_sigma is not None and np.all(matrices.points_sigma > 0):
        px = np.sqrt(np.mean(matrices.points_sigma**2, axis=1))
    elif calibration is not None and calibration.d_rms > 0:
        px = np.full(n, float(calibration.d_rms))
    else:
        px = np.full(n, DEFAULT_SIGMA_PX)
    centre = np.asarray(grid.centre)
    K = pixel_jacobian(matrices.P, centre[None], centre)[:, 0, :, :3]  # px per mm
    mm = px / np.sqrt(np.einsum("nic,nic->n", K, K) / 2)
    return scatter(mm, mm / radius_of(grid)), float(np.sqrt(np.mean(px**2)))


def jumps(q: Array, sigma: Array, radius: float) -> tuple[int, ...]:
    """Views whose correction is beyond six robust standard deviations of all and four of its own uncertainty."""
    lever = np.array([1.0] * 3 + [radius] * 3)
    size = np.linalg.norm(q * lever, axis=1)
    middle = float(np.median(size))
    wide = MAD_TO_SIGMA * float(np.median(np.abs(size - middle)))
    own = np.linalg.norm(sigma * lever, axis=1)
    return tuple(int(j) for j in np.flatnonzero((size > middle + 6 * wide) & (size > 4 * own)))
