"""Two calibrations from disjoint halves of the poses, and how they differ over the field of view.

A model error leaves residuals that look like noise where every pose is fitted at once; fitted to poses near the focal
spot and to those far from it, it ends in two scanners.  Their difference is compared with what both state (the check of
camera calibration by differencing, as in mrcal).  With the rows A_h of a half, F_h = A_h^T A_h, the priors P and
N_h = F_h + P, the estimates are off by N_h^-1 (A_h^T r_h + P d), so that their difference has the covariance

    sum_h N_h^-1 F_h N_h^-1 + (N_1^-1 - N_2^-1) P (N_1^-1 - N_2^-1).
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from tomopose.calibration.model.budget import Halves
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.tall import parts
from tomopose.units import Array

FEWEST = 4
"""Equations that each half needs beyond the unknowns without a prior."""

SEEN = 1e-9
"""Scaled eigenvalues of the covariance below this are directions that both halves take from the priors."""


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
    m = linear.J.shape[2]
    P = linear.prior_rows.T @ linear.prior_rows
    pull = linear.prior_rows.T @ linear.prior_residuals
    shift, spread, inverses = np.zeros(m), np.zeros((m, m)), []
    for sign, rows in zip((1.0, -1.0), near_and_far(linear), strict=True):
        if 2 * len(rows) < m - len(linear.prior_rows) + FEWEST:
            return None
        F, g = _normal_equations(linear, rows)
        if not (np.diag(F + P) > 0).all():
            return None
        inverse = inverse_information(F + P)
        shift += sign * (inverse @ (g + pull))
        spread += inverse @ F @ inverse
        inverses.append(inverse)
    apart = inverses[0] - inverses[1]
    C = widening * (spread + apart @ P @ apart)
    difference = J @ shift
    sigma = np.sqrt(np.maximum(np.einsum("kic,cd,kid->ki", J, C, J, optimize=True), 0.0))
    return Halves(
        x_D=x_D,
        difference=difference,
        sigma=sigma,
        rms_px=float(np.sqrt(np.mean(difference**2))),
        stated_px=float(np.sqrt(np.mean(sigma**2))),
        p=_chance(shift, C),
    )


def _normal_equations(linear: LinearFit, rows: np.ndarray) -> tuple[Array, Array]:
    """J^T W^T W J (m, m) and J^T W^T W r (m,) of some rows."""
    m = linear.J.shape[2]
    F, g = np.zeros((m, m)), np.zeros(m)
    for part in parts(len(rows)):
        A, r = linear.J_white(rows[part]).reshape(-1, m), linear.r_white[rows[part]].ravel()
        F += A.T @ A
        g += A.T @ r
    return F, g


def _chance(shift: Array, C: Array) -> float:
    """Probability that normal errors with the covariance C are as far from zero as `shift`; NaN where C is not
    finite."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(C), 1e-300))
    scaled = C * scale[:, None] * scale
    if not np.isfinite(scaled).all():
        return float("nan")
    value, V = np.linalg.eigh(scaled)
    seen = value > SEEN * value[-1]
    z = V.T @ (scale * shift)
    return float(chdtrc(int(seen.sum()), float((z[seen] ** 2 / value[seen]).sum())))
