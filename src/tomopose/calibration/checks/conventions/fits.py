"""An alternative convention, fitted: a linear start, the optimum of some rows, and of all where that may be right."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tomopose.calibration.checks.conventions.hypothesis import BELONGING, BELONGING_MEAN
from tomopose.calibration.model.parameters import (
    UNITS,
    FreeParameters,
    ImpossibleScannerError,
    adjusted_scanners,
    free_parameters,
)
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.silhouettes import Cameras, size_ratio_of
from tomopose.calibration.rigid.fit import Fit, minimise, residuals, whitened2
from tomopose.calibration.rigid.kernel import STEP_TOLERANCE
from tomopose.calibration.rigid.start import Rays, closed_forms, other_starts, ray_equations, turned_about_beam
from tomopose.units import Array

ITERATIONS = 20
"""An alternative that is right needs fewer; one that is wrong is not worth more."""

FIRST_ROWS, HOPELESS = 48, 100.0
"""Where a ball has more than twice as many rows, an alternative is fitted to so many of each ball first; one that then
leaves so many times the declared reading's chi2 (or dof) in all rows is wrong, and is not fitted to all of them."""

PASSING = 1e-4
"""Last step, in standard deviations, of a fit that another one starts from or that is hopeless."""

SCANNER_GAIN = 1e3
"""Values of the scanner that were off by 30 times what is assumed of them would lower chi2 so much."""

AT_ONCE = 4096
"""Rows whose linear starts are calculated together: some megabytes."""


@dataclass(frozen=True, kw_only=True)
class Left:
    """What a fit leaves.  d_rms: px;  sigmas: rms residual of a coordinate in stated standard uncertainties, of the
    80 % of the centres that fit best;  share: d_rms over the rms spread of the centres."""

    d_rms: float
    sigmas: float
    share: float

    @classmethod
    def of(cls, problem: Problem, r: Array, d2: Array) -> Left:
        """r (n, 2) px, d2 (n,): residuals of all rows, and their squares in standard deviations."""
        n = len(d2)
        kept = np.sort(d2)[: max(1, int(np.ceil(BELONGING * n)))]
        d_rms = math.sqrt(float(np.vdot(r, r)) / n)
        from_mean = problem.x_D - problem.x_D.sum(axis=0) / n
        spread = math.sqrt(float(np.vdot(from_mean, from_mean)) / n)
        return cls(
            d_rms=d_rms,
            sigmas=math.sqrt(float(kept.sum()) / len(kept) / BELONGING_MEAN),
            share=d_rms / spread if spread > 0 else 0.0,
        )


def size_ratio(problem: Problem, free: FreeParameters, fit: Fit, x_T: Array, cameras: Cameras) -> float:
    """Measured size of the silhouettes over the calculated one; NaN where it is not known or cannot be calculated.

    x_T (n, 3) mm: where the fit places the balls;  cameras: of the problem's scanners, before the fit moved them.
    """
    if problem.outline is None or problem.ball_diameter is None or not np.isfinite(fit.chi2):
        return float("nan")
    if fit.delta.any():
        try:
            scanners = adjusted_scanners(problem.scanners, free, fit.delta)
        except ImpossibleScannerError:  # a wrong reading may end anywhere
            return float("nan")
        P = cameras.seen_by(scanners)
    else:
        P = cameras.at_angle
    found = size_ratio_of(problem, P, x_T, which=cameras.which)
    return float("nan") if found is None else found


@functools.lru_cache(maxsize=16)
def _spread(n: int) -> npt.NDArray[np.int64]:
    """FIRST_ROWS rows, spread evenly over n, or all where they are fewer."""
    rows = np.unique(np.linspace(0, n - 1, min(n, FIRST_ROWS)).round().astype(np.int64))
    rows.flags.writeable = False
    return rows


def _spread_of_each(ball: npt.NDArray[np.int64], balls: int) -> npt.NDArray[np.int64]:
    """FIRST_ROWS rows of each ball, spread evenly over its rows; ball (n,): index of each row's."""
    own = np.split(np.argsort(ball, kind="stable"), np.cumsum(np.bincount(ball, minlength=balls))[:-1])
    return np.sort(np.concatenate([rows[_spread(len(rows))] for rows in own]))


@dataclass(frozen=True, kw_only=True)
class Reading:
    """A problem as an alternative reads it, with its cameras and rays, and the rows (k,) that it is fitted to first."""

    problem: Problem
    cameras: Cameras
    rays: Rays
    rows: npt.NDArray[np.int64]

    @classmethod
    def of(cls, problem: Problem, cameras: Cameras, rays: Rays, *, thoroughly: bool) -> Reading:
        """With all rows first where they are few, or where it is to be thorough."""
        n, balls = len(problem), len(problem.ball_ids)
        if thoroughly or n <= 2 * FIRST_ROWS * balls:
            rows: npt.NDArray[np.int64] = np.arange(n)
        else:
            rows = _spread(n) if balls == 1 else _spread_of_each(problem.ball, balls)
        return cls(problem=problem, cameras=cameras, rays=rays, rows=rows)

    @property
    def whole(self) -> bool:
        return len(self.rows) == len(self.problem)

    @property
    def weight(self) -> Array | None:
        """(n,) 1 for the rows that it is fitted to first; None for all."""
        if self.whole:
            return None
        weight = np.zeros(len(self.problem))
        weight[self.rows] = 1.0
        return weight


def linear_starts(readings: Sequence[Reading]) -> list[tuple[Array, Array, Array]]:
    """R_HT, t_HT, t of each in closed form, of those with as many rows and balls at once."""
    found: list[tuple[Array, Array, Array]] = [(np.zeros((0, 0)),) * 3] * len(readings)
    alike: dict[tuple[int, int], list[int]] = {}
    for k, one in enumerate(readings):
        alike.setdefault((len(one.rows), len(one.problem.ball_ids)), []).append(k)
    for (n, _), members in alike.items():
        most = max(1, AT_ONCE // n)
        for first in range(0, len(members), most):
            some = members[first : first + most]
            each = [readings[k] for k in some]
            starts = closed_forms([e.problem for e in each], [e.rays for e in each], [e.rows for e in each])
            for k, start in zip(some, starts, strict=True):
                found[k] = start
    return found


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """fit: the optimum, or where part of the rows lead;  r (n, 2) px: what it leaves in all rows;  d2 (n,): their
    squares in standard deviations."""

    fit: Fit
    r: Array
    d2: Array


def fitted(
    one: Reading,
    start: tuple[Array, Array, Array],
    free: FreeParameters,
    held: FreeParameters,
    *,
    starts: int = 0,
    hopeless: float = np.inf,
) -> Fitted:
    """The optimum under an alternative, or where part of the rows lead if that leaves a hopeless chi2 in all rows.

    starts: rotations that are tried where the closed form leads nowhere.
    """
    problem, weight = one.problem, one.weight
    enough = np.inf if one.whole else SCANNER_GAIN * hopeless * len(one.rows) / len(problem)
    last = STEP_TOLERANCE if one.whole else PASSING
    fit = minimise(problem, held, start, weight=weight, iterations=ITERATIONS, tolerance=PASSING if len(free) else last)
    if not np.isfinite(fit.chi2):
        fit = _from_elsewhere(one, start, held, starts)
    if len(free) and fit.chi2 < enough:
        fit = minimise(problem, free, fit, weight=weight, iterations=ITERATIONS, tolerance=last)
    if len(fit.delta) != len(free):
        fit = replace(fit, delta=np.zeros(len(free)))
    r = residuals(problem, free, fit)
    d2 = whitened2(problem, r)
    if one.whole:
        return Fitted(fit=fit, r=r, d2=d2)
    chi2 = float(d2.sum() + (free.information * fit.delta**2).sum())
    if not chi2 < hopeless:
        # a ball behind the source in any row makes the reading impossible
        return Fitted(fit=replace(fit, chi2=chi2 if np.isfinite(chi2) else np.inf), r=r, d2=d2)
    fit = minimise(problem, free, fit, iterations=ITERATIONS)
    r = residuals(problem, free, fit)
    return Fitted(fit=fit, r=r, d2=whitened2(problem, r))


def _from_elsewhere(one: Reading, start: tuple[Array, Array, Array], held: FreeParameters, starts: int) -> Fit:
    """The optimum from half a turn about the beam, or from the best of some rotations."""
    problem, weight = one.problem, one.weight
    turned = turned_about_beam(problem, start[0], one.rays, one.rows)
    fit = minimise(problem, held, turned, weight=weight, iterations=ITERATIONS)
    if np.isfinite(fit.chi2):
        return fit
    # mirrored data have no closed form in front of the source; the residual they leave is still worth knowing
    others = (
        minimise(problem, held, other, weight=weight, iterations=ITERATIONS)
        for other in itertools.islice(other_starts(problem, one.rays), starts)
    )
    return minimise(problem, held, min((fit, *others), key=lambda one: one.chi2), weight=weight)


def optimum_under(problem: Problem, free: FreeParameters) -> Fit:
    """The optimum of a problem that an alternative made."""
    cameras = Cameras.of(problem)
    rays = ray_equations(problem, cameras)
    one = Reading(problem=problem, cameras=cameras, rays=rays, rows=np.arange(len(problem)))
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    return fitted(one, linear_starts([one])[0], free, held).fit
