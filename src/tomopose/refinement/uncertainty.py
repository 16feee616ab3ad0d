r"""How exact each view is after the fit, with the volume unknown, and which directions the images leave open.

The motions' covariance is the inverse of the reduced normal equations, the volume eliminated.  Its size comes from
draws: noise of the weights' size and motions of the prior's are put into the linearised problem, whose own step answers
with an error of exactly that covariance.  The draws give, point by point, how much larger the uncertainty is than with
the volume known; the views' own blocks give how it differs from view to view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.refinement.joint_fit.balls import Balls
from tomopose.refinement.joint_fit.fit import (
    LEVEL_SIGMA,
    Linearised,
    State,
    motions_among_levels,
    ridge_of,
    with_balls,
    with_levels,
)
from tomopose.refinement.joint_fit.linear import Linear
from tomopose.refinement.joint_fit.measured import Measured
from tomopose.refinement.joint_fit.motions import gauge, pixel_jacobian, without_gauge
from tomopose.refinement.joint_fit.precondition import passed_frequencies
from tomopose.refinement.prior import Prior
from tomopose.refinement.settings import MODEL_ERROR, UNDETERMINED
from tomopose.units import Array

VOLUME_UNKNOWN = 9.0
"""Factor of variance by which an unknown volume widens the motions before draws have measured it: simulated scans of
balls and step cylinders show 3 to 4 in the standard deviation."""
AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class Spread:
    """sigma: (n, 6), mm and rad, of each view's motion; points_sigma: (n, m), px per coordinate; points_known: the
    same with the volume known."""

    sigma: Array
    points_sigma: Array
    points_known: Array


def drawn_errors(
    data: Measured,
    state: State,
    here: Linearised,
    prior: Prior,
    *,
    samples: int,
    turns: int,
    seed: int,
    balls: Balls | None = None,
) -> Array:
    """Errors (samples, n, 6) of the motions that noise and prior of their own size make.  here: the data at `state`."""
    n, x, w = len(data.p), here.x, here.weighed(data)
    C, own = prior.covariance, prior.precision
    precision = with_levels(own)
    H = passed_frequencies(data.matrices, data.grid)
    system, _ = with_balls(precision, np.zeros(7 * n), balls, state.q)
    linear = Linear.of(here.projector, x > 0, here.J, w, system, ridge_of(state.volume, state.chi), H)
    rng, root = np.random.default_rng([seed, 21]), root_of(C)
    root_of_balls = None if balls is None else root_of(balls.reduced(state.q)[0])
    G = gauge(data.matrices.P, np.asarray(data.grid.centre))
    sigma = np.where(w > 0, 1 / np.sqrt(np.maximum(w, 1e-30)), 0)
    errors = np.empty((samples, n, 6))
    for k in range(samples):
        truth = np.zeros((n, 7))
        truth[:, :6] = (root @ rng.standard_normal(6 * n)).reshape(n, 6)
        truth[:, 6] = LEVEL_SIGMA * rng.standard_normal(n)
        noise = data.smooth((sigma * rng.standard_normal(sigma.shape)).astype(np.float32))
        pull = -(precision @ truth.ravel())
        if root_of_balls is not None:
            pull[motions_among_levels(n)] -= root_of_balls @ rng.standard_normal(6 * n)
        _, dq = linear.solve(noise, pull, np.zeros_like(x), turns=turns)
        errors[k] = without_gauge(dq[:, :6], G, own)
    return errors


def root_of(C: Array) -> Array:
    """L with L L' = C, a covariance or precision that may leave directions open."""
    return np.asarray(np.linalg.cholesky(C + 1e-12 * np.trace(C) / len(C) * np.eye(len(C))))


@dataclass(frozen=True, kw_only=True)
class Widening:
    """How much an unknown volume widens the variance: points (m, 2), of points along u and v; motions: of all six."""

    points: Array
    motions: float

    @property
    def factor(self) -> float:
        """Of the standard deviation, all points together."""
        return float(np.sqrt(self.points.mean()))


def with_volume_held(information: Array, prior: Prior) -> Array:
    """(n, 6, 6) covariance of each view's motion with the volume known, by information (n, 6, 6) and prior."""
    return np.asarray(np.linalg.inv(information + np.linalg.inv(prior.blocks)))


def of_points(covariance: Array, K: Array) -> Array:
    """(n, m, 2) px^2: variance of points under motions of that covariance (n, 6, 6); K (n, m, 2, 6), px each."""
    return np.asarray(np.einsum("nmic,ncd,nmid->nmi", K, covariance, K))


def widening_of(errors: Array, information: Array, prior: Prior, K: Array) -> Widening:
    """From draws (s, n, 6), each view's information (n, 6, 6) of the same level, and K (n, m, 2, 6), px per motion."""
    known = with_volume_held(information, prior)
    drawn = np.einsum("nmic,snc->snmi", K, errors)
    with_volume_known = of_points(known, K)
    root = np.sqrt(np.einsum("ncc->nc", prior.blocks).mean(axis=0))
    motions = ((errors / root) ** 2).mean() / np.mean(np.einsum("ncc->nc", known) / root**2)
    return Widening(
        points=np.maximum((drawn**2).mean(axis=(0, 1)) / with_volume_known.mean(axis=0), 1.0),
        motions=max(float(motions), 1.0),
    )


def spread_of(widening: Widening, information: Array, prior: Prior, K: Array) -> Spread:
    """Per view and point, from each view's information (n, 6, 6) of the finest level; never more than the prior.

    The information holds the size of the residual already: where the voxels do not explain the images to their noise,
    the weights are as much smaller (Birge ratio).
    """
    blocks, known = prior.blocks, with_volume_held(information, prior)
    with_volume_known, prior_points = of_points(known, K), of_points(blocks, K)
    wide = MODEL_ERROR**2
    variance = np.minimum(wide * with_volume_known * widening.points, np.maximum(prior_points, with_volume_known))
    return Spread(
        sigma=np.sqrt(np.minimum(wide * np.einsum("ncc->nc", known) * widening.motions, np.einsum("ncc->nc", blocks))),
        points_sigma=np.sqrt(variance.mean(axis=2)),
        points_known=np.sqrt(with_volume_known.mean(axis=2)),
    )


def size_sigma(prior: Prior, P: Array, points: Array, centre: Array) -> Array:
    """(n, m) px per coordinate: the uncertainty of points (m, 3) of W that the object's size has, which no image shows
    and all views share; a rigid pose of the object is removed."""
    G = gauge(P, centre)
    flat = G.reshape(-1, 7)
    scale = 1 / np.linalg.norm(flat, axis=0)
    inner = (flat * scale).T @ prior.precision @ (flat * scale)
    sigma = float(np.sqrt(np.linalg.pinv(inner, rcond=1e-12, hermitian=True)[6, 6])) * scale[6]
    moved = (pixel_jacobian(P, points, centre) @ G[:, None]).reshape(-1, 7)
    rigid = moved[:, :6] / np.linalg.norm(moved[:, :6], axis=0)
    left = moved[:, 6] - rigid @ np.linalg.lstsq(rigid, moved[:, 6], rcond=1e-9)[0]
    return np.asarray(sigma * np.sqrt(np.mean(left.reshape(len(P), len(points), 2) ** 2, axis=2)))


@dataclass(frozen=True, kw_only=True)
class OpenDirection:
    """words: a sentence; left_px: rms px per coordinate that the direction leaves uncertain."""

    words: str
    left_px: float


def open_directions(information: Array, prior: Prior, K: Array, radius: float) -> tuple[OpenDirection, ...]:
    """Directions of the object's frame that no view determines.

    information: (n, 6, 6) of the views with the volume held; K: (n, m, 2, 6), px per motion.  A direction is open where
    the images, the volume unknown, leave more than `UNDETERMINED` of the prior that was stated.  radius: mm, of the
    object, in the words.
    """
    root = np.linalg.cholesky(prior.stated.blocks.mean(axis=0))
    F = root.T @ (information.mean(axis=0) / VOLUME_UNKNOWN) @ root
    values, vectors = np.linalg.eigh(F)
    left = 1 / np.sqrt(1 + np.maximum(values, 0))
    found = []
    for share, vector in zip(left, vectors.T, strict=True):
        if share > UNDETERMINED:
            px = share * float(np.sqrt(np.mean((K @ (root @ vector)) ** 2)))
            words = (
                f"{direction_in_words(root @ vector, radius)} is not determined by these images: they leave "
                f"{100 * share:.0f} % of the prior's uncertainty, {px:.2g} px"
            )
            found.append(OpenDirection(words=words, left_px=px))
    return tuple(found)


def direction_in_words(motion: Array, radius: float) -> str:
    """A motion (t, w) as "motion along z" or "a turn about (0.6, 0.8, 0)"."""
    t, w = motion[:3], motion[3:] * radius
    turning = np.linalg.norm(w) > np.linalg.norm(t)
    axis = w if turning else t
    axis = axis / np.linalg.norm(axis)
    k = int(np.abs(axis).argmax())
    where = AXES[k] if abs(axis[k]) > 0.95 else "(" + ", ".join(f"{a:.2f}" for a in axis * np.sign(axis[k])) + ")"
    return f"A turn of the object about {where}" if turning else f"Motion of the object along {where}"
