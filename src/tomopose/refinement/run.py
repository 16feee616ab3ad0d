"""`refine`: each view's geometry corrected from the scan's own images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.coverage import MAD_TO_SIGMA
from tomopose.engines.cpu import processors
from tomopose.engines.geometry import require_usable
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.reconstruction.line_integrals import Correction, ImagesAre, require_contrast
from tomopose.reconstruction.run import line_integrals_of
from tomopose.refinement.checkpoint import checkpoint_of
from tomopose.refinement.estimate import Estimate, Progress, Steps, estimate, levels_of
from tomopose.refinement.halves import halves_px
from tomopose.refinement.joint_fit.balls import Balls
from tomopose.refinement.joint_fit.balls_seen import balls_of, without_shadows
from tomopose.refinement.joint_fit.fit import Fit, linearised
from tomopose.refinement.joint_fit.linear import normal_blocks
from tomopose.refinement.joint_fit.measured import measured, rays_through, with_held_out
from tomopose.refinement.joint_fit.motions import transforms
from tomopose.refinement.joint_fit.projector import Workers
from tomopose.refinement.joint_fit.pyramid import level_of
from tomopose.refinement.judge import Evidence, Verdict, decide, trial
from tomopose.refinement.result import Refinement
from tomopose.refinement.settings import OPEN_PX, RefineSettings
from tomopose.refinement.sharpness import edge_blurs_mm
from tomopose.refinement.stated import points_of, prior_of, radius_of
from tomopose.refinement.uncertainty import (
    VOLUME_UNKNOWN,
    drawn_errors,
    open_directions,
    size_sigma,
    spread_of,
    widening_of,
)
from tomopose.units import Array
from tomopose.values import Images, require_types
from tomopose.volume import Volume, VoxelGrid

FEWEST_VIEWS = 8
"""Views below which the volume explains any motion of them."""
GAUGE = (
    "A rigid motion of the whole object, common to all views, is not observable: the object keeps its mean pose.",
    "The size of the object (a depth common to all views) is not observable in its images: scale comes from the "
    "calibration alone and is unchanged.",
)


@require_types
def refine(
    images: Images,
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    calibration: Calibration | None = None,
    *,
    poses: PoseSequence | None = None,
    balls: Sequence[BallObservations] = (),
    images_are: ImagesAre | None = None,
    correction: Correction | None = None,
    settings: RefineSettings | None = None,
    checkpoint: str | Path | None = None,
    progress: Progress = None,
) -> Refinement:
    """Correct each view's geometry from the scan's own images: volume and poses are estimated together.

    Parameters
    ----------
    images:      n images [v, u] in any lazy sequence with a length; array row index = v (row 0 is the bottom).
    matrices:    n projection matrices of eq. (5), as calibrated.  Their `points_sigma` is the prior of each view.
    grid:        voxels, mm in W, that hold the whole object.
    calibration: with `poses` its covariance is the prior, correlated over the views; without them its residual, where
                 the matrices state no uncertainty.  Its scale is kept in any case.
    poses:       the scan's n poses, in the order of the matrices.
    balls:       observations of balls on the object, a table for each ball, its pose ids those of the matrices.  Nobody
                 need know where the balls sit: they join as points that move with the object, inside the grid or not.
    images_are:  "transmission", "line-integrals" or "counts"; never guessed.
    correction:  how images become line integrals (white level, bad pixels, beam hardening ...), as for `reconstruct`.
    settings:    levels, steps, held-out share, seed.
    checkpoint:  folder in which each level's result is kept; a second call with the same images, matrices and settings
                 continues from there.
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
    if poses is not None and len(poses) != len(matrices):
        raise InputError(f"{len(poses)} poses for {len(matrices)} matrices; one pose for each view is needed")
    require_usable(matrices, grid)
    scan = line_integrals_of(images, matrices, images_are, correction)
    require_contrast(scan, sorted({0, len(scan) // 3, len(scan) // 2, len(scan) - 1}))
    data = measured(scan, grid)
    factors = levels_of(data, s)
    data = with_held_out(data, s.held_out, coarsest=factors[0], seed=s.seed)
    workers = Workers(threads=s.threads or processors(), client=s.client)
    points = balls_of(balls, matrices, np.asarray(grid.centre)) if balls else None
    if points is not None:
        data = without_shadows(data, points)
    prior, stated = prior_of(matrices, grid, s, calibration, poses)
    steps = Steps(2 * len(factors) + 4, progress)
    kept = checkpoint_of(checkpoint, scan, grid, prior, s, factors, points)
    found = estimate(data, factors, prior, s, workers, steps, kept, points)
    result = assessed(found, matrices, s, workers, steps, points)
    steps.finish()
    if kept is not None:
        kept.remove()
    made = provenance(arguments={"prior_px": stated, "levels": list(factors)}, seed=s.seed)
    return replace(result, provenance=made)


def assessed(
    found: Estimate,
    matrices: ProjectionMatrices,
    s: RefineSettings,
    workers: Workers,
    steps: Steps,
    balls: Balls | None = None,
) -> Refinement:
    """What the estimate is worth: the judgement of the held-out pixels, the uncertainty, and what is not observable."""
    data, state, prior, K = found.data, found.state, found.prior, found.K
    centre, radius = np.asarray(data.grid.centre), radius_of(data.grid)
    level = level_of(data, found.judged)
    fit = Fit(precision=prior.precision, steps=3, turns=s.turns, workers=workers)
    held_out, before, after = trial(level, state, fit)
    steps.done()
    at = replace(after, q=state.q)
    here = linearised(level, at, workers=workers)
    information = normal_blocks(here.motions, here.weighed(level))
    left = 1.0 - float(rays_through(level, found.faces).mean()) if found.faces else 1.0
    finest = information if state.information is None else state.information
    points = 0.0 if balls is None else balls.blocks(state.q)
    open_ = () if found.faces else open_directions(information + VOLUME_UNKNOWN * points, prior, K, radius)
    errors = drawn_errors(level, at, here, prior, samples=s.samples, turns=s.turns, seed=s.seed, balls=balls)
    widening = widening_of(errors, information + points, prior, K)
    spread = spread_of(widening, finest + points, prior, K)
    steps.done()
    moved_px = np.einsum("nmic,nc->nmi", K, state.q)
    moved = np.sqrt(np.mean(moved_px**2) / np.mean(spread.points_sigma**2))
    known_px = float(np.sqrt(np.mean(spread.points_known**2)))
    halves = halves_px(level, prior, replace(fit, steps=s.steps), K, known_px)
    misfit = None if balls is None else balls.misfit(state.q)
    verdict, reasons = decide(
        Evidence(
            held_out=held_out,
            chi=state.chi,
            faces=found.faces,
            left=left,
            edges=found.edges,
            open_=tuple(each.words for each in open_ if each.left_px > OPEN_PX),
            moved=float(moved),
            balls=misfit,
        )
    )
    shared = size_sigma(prior.stated, data.matrices.P, points_of(data.grid), centre)
    refined = replace(
        matrices,
        P=matrices.P @ transforms(state.q, centre),
        points_sigma=np.sqrt(spread.points_sigma**2 + shared**2),
        points_sigma_shared=shared,
    )
    volumes = tuple(Volume(values=each.volume, grid=level.grid) for each in (before, after))
    blurs = edge_blurs_mm(volumes[0], volumes[1])
    return Refinement(
        matrices=refined if verdict is Verdict.REFINED else matrices,
        corrections=state.q,
        sigma=spread.sigma,
        verdict=verdict.value,
        reasons=reasons,
        unobservable=(*GAUGE, *(each.words for each in open_)),
        residual_before=held_out.residual_before,
        residual_after=held_out.residual_after,
        held_out_before=held_out.before,
        held_out_after=held_out.after,
        held_out_gain=float(held_out.gain),
        iterations=state.steps,
        converged=state.settled,
        chi=state.chi,
        prior_sizes={name: float(size) for name, size in zip(prior.names, prior.sizes, strict=True)},
        outliers=jumps(moved_px, spread.points_sigma) if verdict is Verdict.REFINED else (),
        widening=widening.factor,
        halves_px=halves,
        stated_px=float(np.sqrt(np.mean(spread.points_sigma**2))),
        balls=None if balls is None else balls.places(state.q),
        balls_misfit=float("nan") if misfit is None else misfit,
        edge_blur_before_mm=blurs[0],
        edge_blur_after_mm=blurs[1],
        volume_before=volumes[0],
        volume=volumes[1],
    )


def jumps(moved: Array, sigma: Array) -> tuple[int, ...]:
    """Views that are beyond six robust standard deviations of all and four of their own uncertainty.

    moved: (n, m, 2) px that the correction moves points; sigma: (n, m), px per coordinate, after it.  In pixels a
    view's depth, which is uncertain and hardly seen, does not hide a jump.
    """
    size = np.sqrt(np.mean(moved**2, axis=(1, 2)))
    middle = float(np.median(size))
    wide = MAD_TO_SIGMA * float(np.median(np.abs(size - middle)))
    own = np.sqrt(np.mean(sigma**2, axis=1))
    return tuple(int(j) for j in np.flatnonzero((size > middle + 6 * wide) & (size > 4 * own)))
