"""Two calibrations from disjoint halves of the poses, and how they differ over the field of view.

A model error leaves residuals that look like noise where every pose is fitted at once; fitted to poses near the focal
spot and to those far from it, it ends in two scanners.  Their difference is compared with what both state (the check of
camera calibration by differencing, as in mrcal).  The equations A_h of a half and B of the priors, in standard
deviations, have the pseudo-inverse (K_h, L_h) of the stack (A_h, B).  An estimate is off by K_h e_h + L_h d, where the
halves share d, so that their difference has the covariance G G^T of

    G = (K_1, -K_2, L_1 - L_2).

Calculated from its roots, as here, it stays positive whatever the condition of the normal equations.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from tomopose.calibration.model.budget import Halves
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.tall import parts, triangle
from tomopose.units import Array

FEWEST = 4
"""Equations that each half needs beyond the unknowns without a prior."""

SEEN = 1e-9
"""Directions in which the halves may differ by less than this share of their own variances are what both take from the
priors.  Over 48 clean runs of the three plans of benchmarks/reality seen directions are above 1e-5 and rounding leaves
1e-26: the probability is the same from 1e-13 to 1e-6, and evenly distributed."""

BLIND = 3e-8
"""Singular values of scaled equations below this are rounding: the root of the resolution of a number."""


def near_and_far(linear: LinearFit) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the half of each ball's poses with the larger magnification, and of the others."""
    size, ball = np.linalg.norm(linear.J_t_HT, axis=(1, 2)), linear.problem.ball
    near = np.zeros(len(size), dtype=bool)
    for k in np.unique(ball):
        own = np.flatnonzero(ball == k)
        near[own[np.argsort(-size[own], kind="stable")[: len(own) // 2]]] = True
    return np.flatnonzero(near), np.flatnonzero(~near)


def halves_of(linear: LinearFit, J: Array, x_D: Array, *, widening: float) -> Halves | None:
    """The check; J (k, 2, m) px: how points of a scan, imaged at x_D (k, 2), answer to what was estimated.

    widening: factor on the covariance, as the calibration's own.  None where a half has too few poses.
    """
    m, priors = linear.J.shape[2], len(linear.prior_rows)
    shift, variance, parts_of_G, by_prior = np.zeros(m), np.zeros(m), [], np.zeros((m, priors))
    for sign, rows in zip((1.0, -1.0), near_and_far(linear), strict=True):
        if 2 * len(rows) < m - priors + FEWEST:
            return None
        equations = np.vstack([_reduced(linear, rows), np.c_[linear.prior_rows, linear.prior_residuals]])
        A, r = equations[:, :-1], equations[:, -1]
        if not np.linalg.norm(A, axis=0).all():
            return None
        K = _pseudo_inverse(A)
        own = len(A) - priors
        shift += sign * (K @ r)
        variance += (K**2).sum(axis=1)
        parts_of_G.append(K[:, :own])
        by_prior += sign * K[:, own:]
    G = np.sqrt(widening) * np.hstack([*parts_of_G, by_prior])
    difference = J @ shift
    sigma = np.linalg.norm(J @ G, axis=-1)
    return Halves(
        x_D=x_D,
        difference=difference,
        sigma=sigma,
        rms_px=float(np.sqrt(np.mean(difference**2))),
        stated_px=float(np.sqrt(np.mean(sigma**2))),
        p=_chance(shift, G, np.sqrt(variance)),
    )


def _reduced(linear: LinearFit, rows: np.ndarray) -> Array:
    """(at most m + 1, m + 1): equations with the inner products of those rows, residuals in the last column."""
    m = linear.J.shape[2]
    return triangle(
        np.c_[linear.J_white(rows[part]).reshape(-1, m), linear.r_white[rows[part]].ravel()]
        for part in parts(len(rows))
    )


def _pseudo_inverse(A: Array) -> Array:
    """(m, k) of equations (k, m), by the singular values of their scaled columns."""
    scale = 1.0 / np.linalg.norm(A, axis=0)
    U, s, Vt = np.linalg.svd(A * scale, full_matrices=False)
    return np.asarray((scale[:, None] * Vt.T / np.maximum(s, BLIND)) @ U.T)


def _chance(shift: Array, G: Array, sigma: Array) -> float:
    """Probability that normal errors with the covariance G G^T are as far from zero as `shift`; NaN where a number is
    not finite.  sigma (m,): what both halves state together, the unit in which a direction counts as seen."""
    scaled = G / sigma[:, None]
    if not np.isfinite(scaled).all():
        return float("nan")
    U, s, _ = np.linalg.svd(scaled, full_matrices=False)
    seen = s**2 > SEEN
    z = U.T @ (shift / sigma)
    return float(chdtrc(int(seen.sum()), float((z[seen] ** 2 / s[seen] ** 2).sum())))
