"""Centres that do not belong: found by leverage-corrected residuals, set aside and listed, never silently averaged in.

A residual r_k with covariance C_k is compared through its own predicted covariance C_k - J_k Sigma J_k^T: an image with
much leverage pulls the fit to itself, and its raw residual hides it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tomopose.calibration.model.covariance import median
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.tall import ByBall, parts
from tomopose.calibration.rigid.fit import Fit, blocks, derivatives, minimise, residuals, whitened2
from tomopose.units import Array

FALSE_ALARM = 0.01
"""Probability that a whole run of clean normal centres has one set aside."""

LARGEST_SHARE = 0.2
"""Should more of the poses fail than this share, they are not outliers: the model does not fit, and all are kept."""

LEAST_SHARE = 0.01
"""Of a row's covariance that its residual keeps, in any direction."""

MEDIAN_CHI2_2 = 2.0 * math.log(2.0)
REWEIGHTINGS = 40
RECLASSIFICATIONS = 8


@dataclass(frozen=True, kw_only=True)
class RobustFit:
    """fit of the rows `keep` (n,) bool; distance2 (n,): squared studentised residuals, 2 degrees of freedom each;
    scale: robust estimate of chi2/dof; misfit: more rows fail than may be outliers, and none was set aside."""

    fit: Fit
    keep: Any
    distance2: Array
    scale: float
    misfit: bool


def limit(n: int) -> float:
    """Largest squared studentised residual that n clean rows are allowed."""
    return -2.0 * math.log(FALSE_ALARM / n)


def limit_beside(found: Array, n: int) -> float:
    """The limit for n rows once outliers of squared distances `found` are among them.

    Where many rows are wrong by little, a row a little nearer is more likely one of them than a clean row far out: a
    share p of the rows has the spread s = mean(found) / 2 instead of 1, and the limit is where both are equally likely,
    p exp(-d^2 / 2s) / s = (1 - p) exp(-d^2 / 2).  It is never above `limit`: gross errors do not excuse small ones.
    """
    if not len(found):
        return limit(n)
    p, s = min(len(found) / n, LARGEST_SHARE), float(np.mean(found)) / 2.0
    return min(limit(n), 2.0 * s / (s - 1.0) * math.log(s * (1.0 - p) / p))


def studentised(problem: Problem, fit: Fit, keep: npt.NDArray[np.bool_], x_calc: Array, J: Array | ByBall) -> Array:
    """(n,) squared residuals in their own predicted standard deviations.  Rows not kept count as predictions.

    x_calc (n, 2) px and J (n, 2, m): calculated centres and their derivatives at the fit.
    """
    r = problem.x_D - x_calc
    spread: Array = np.empty((len(r), 2, 2))
    for p in parts(len(r)):
        some = J[p]
        spread[p] = some @ fit.inverse @ np.swapaxes(some, 1, 2)
    V = problem.covariance + np.where(keep[:, None, None], -spread, spread)
    V = problem.W @ V @ np.swapaxes(problem.W, 1, 2)
    y_0, y_1 = (problem.W @ r[:, :, None])[..., 0].T
    a, b, c = V[:, 0, 0], V[:, 0, 1], V[:, 1, 1]
    det = a * c - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        found: Array = (c * y_0 * y_0 - 2.0 * b * y_0 * y_1 + a * y_1 * y_1) / det
    # a row that the fit follows entirely has no residual of its own: floor at one per cent of its covariance
    low = np.flatnonzero(~((a > LEAST_SHARE) & ((a - LEAST_SHARE) * (c - LEAST_SHARE) > b * b)))
    if len(low):
        value, Q = np.linalg.eigh(V[low])
        z = (np.swapaxes(Q, 1, 2) @ np.stack([y_0[low], y_1[low]], axis=1)[:, :, None])[..., 0]
        found[low] = (z**2 / np.maximum(value, LEAST_SHARE)).sum(axis=1)
    return found


def _scale(distance2: Array) -> float:
    return median(distance2) / MEDIAN_CHI2_2


def robust_fit(
    problem: Problem,
    free: FreeParameters,
    start: Fit,
    x_calc: Array,
    J: Array | ByBall,
    *,
    before: RobustFit | None = None,
) -> RobustFit:
    """The fit without the rows that do not belong, from the ordinary fit `start`; x_calc, J: of it, as of
    `studentised`;  before: of the same rows with other covariances, whose outliers are tried first."""
    n = len(problem)
    all_rows = np.ones(n, dtype=bool)
    d2 = first = studentised(problem, start, all_rows, x_calc, J)
    scale = _scale(d2)
    if d2.max() <= limit(n) * max(1.0, scale):
        return RobustFit(fit=start, keep=all_rows, distance2=d2, scale=scale, misfit=False)
    if before is None or before.keep.all():
        fit, keep = _reweighted(problem, free, start)
    else:
        fit, keep = before.fit, before.keep
    for turn in range(2 * RECLASSIFICATIONS):
        if keep.mean() < 1.0 - LARGEST_SHARE or 2 * keep.sum() <= fit.N.shape[0] + 4:
            break
        fit = minimise(problem, free, fit, weight=keep.astype(float))
        b = blocks(problem, free, fit)
        d2 = studentised(problem, fit, keep, b.x_D, derivatives(problem, free, b))
        scale = _scale(d2[keep])
        unit = max(1.0, scale)
        new_keep = d2 <= limit_beside(d2[d2 > limit(n) * unit] / unit, n) * unit
        # a row at the border, or two that hide each other, may come and go for ever: later nothing comes back
        new_keep &= keep | (turn < RECLASSIFICATIONS)
        if (new_keep == keep).all():
            return RobustFit(fit=fit, keep=keep, distance2=d2, scale=scale, misfit=False)
        keep = new_keep
    return RobustFit(fit=start, keep=all_rows, distance2=first, scale=scale, misfit=True)


def _reweighted(problem: Problem, free: FreeParameters, start: Fit) -> tuple[Fit, npt.NDArray[np.bool_]]:
    """A fit to which rows count the less the farther they are, and the rows (n,) that it does not place far away."""
    fit, weight = start, np.ones(len(problem))
    for _ in range(REWEIGHTINGS):
        d2 = whitened2(problem, residuals(problem, free, fit))
        scale = max(1.0, _scale(d2))
        # Geman-McClure, whose influence falls to zero: a gross error does not pull at all
        new = (1.0 + d2 / (9.0 * scale)) ** -2
        fit = minimise(problem, free, fit, weight=new, iterations=2)
        settled = np.abs(new - weight).max() < 1e-3
        weight = new
        if settled:
            break
    return fit, d2 <= limit(len(problem)) * scale
