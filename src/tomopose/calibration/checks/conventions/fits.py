"""An alternative convention, fitted: a linear start, the optimum of some rows, and of all where that may be right."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tomopose.calibration.checks.conventions.remainder import Remainder, remainders
from tomopose.calibration.model.parameters import UNITS, FreeParameters, free_parameters
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.silhouettes import Cameras
from tomopose.calibration.rigid.fit import Fit, minimise
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
    def first(self) -> npt.NDArray[np.int64] | None:
        """(k,): the rows that it is fitted to first; None for all."""
        return None if self.whole else self.rows


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
    """fit: the optimum, or where part of the rows lead;  left: what it leaves in all rows."""

    fit: Fit
    left: Remainder


def fitted(
    readings: Sequence[Reading], free: FreeParameters, held: FreeParameters, *, starts: int, hopeless: float
) -> list[Fitted]:
    """The optimum under each reading, or where part of the rows lead if that leaves a hopeless chi2 in all rows.

    starts: rotations that are tried where the closed form leads nowhere.
    """
    fits = [
        _of_first_rows(one, start, free, held, starts=starts, hopeless=hopeless)
        for one, start in zip(readings, linear_starts(readings), strict=True)
    ]
    found = []
    for one, fit, left in zip(readings, fits, _left(readings, fits, free), strict=True):
        if not one.whole:
            # a ball behind the source in any row makes the reading impossible
            fit = replace(fit, chi2=left.chi2 if np.isfinite(left.chi2) else np.inf)
        found.append(Fitted(fit=fit, left=left))
    hopeful = [k for k, one in enumerate(readings) if not one.whole and found[k].fit.chi2 < hopeless]
    again = [minimise(readings[k].problem, free, found[k].fit, iterations=ITERATIONS) for k in hopeful]
    for k, fit, left in zip(hopeful, again, _left([readings[k] for k in hopeful], again, free), strict=True):
        found[k] = Fitted(fit=fit, left=left)
    return found


def _left(readings: Sequence[Reading], fits: Sequence[Fit], free: FreeParameters) -> list[Remainder]:
    """What fits leave in all rows of readings."""
    return remainders([one.problem for one in readings], [one.cameras for one in readings], fits, free)


def _of_first_rows(
    one: Reading,
    start: tuple[Array, Array, Array],
    free: FreeParameters,
    held: FreeParameters,
    *,
    starts: int = 0,
    hopeless: float = np.inf,
) -> Fit:
    """The optimum of the rows that a reading is fitted to first; `starts` and `hopeless` as of `fitted`."""
    problem, rows = one.problem, one.first
    enough = np.inf if one.whole else SCANNER_GAIN * hopeless * len(one.rows) / len(problem)
    last = STEP_TOLERANCE if one.whole else PASSING
    fit = minimise(problem, held, start, rows=rows, iterations=ITERATIONS, tolerance=PASSING if len(free) else last)
    if not np.isfinite(fit.chi2):
        fit = _from_elsewhere(one, start, held, starts)
    if len(free) and fit.chi2 < enough:
        fit = minimise(problem, free, fit, rows=rows, iterations=ITERATIONS, tolerance=last)
    return fit if len(fit.delta) == len(free) else replace(fit, delta=np.zeros(len(free)))


def _from_elsewhere(one: Reading, start: tuple[Array, Array, Array], held: FreeParameters, starts: int) -> Fit:
    """The optimum from half a turn about the beam, or from the best of some rotations."""
    problem, rows = one.problem, one.first
    turned = turned_about_beam(problem, start[0], one.rays, one.rows)
    fit = minimise(problem, held, turned, rows=rows, iterations=ITERATIONS)
    if np.isfinite(fit.chi2):
        return fit
    # mirrored data have no closed form in front of the source; the residual they leave is still worth knowing
    others = (
        minimise(problem, held, other, rows=rows, iterations=ITERATIONS)
        for other in itertools.islice(other_starts(problem, one.rays), starts)
    )
    return minimise(problem, held, min((fit, *others), key=lambda one: one.chi2), rows=rows)


def optimum_under(problem: Problem, free: FreeParameters) -> Fit:
    """The optimum of a problem that an alternative made."""
    cameras = Cameras.of(problem)
    rays = ray_equations(problem, cameras)
    one = Reading(problem=problem, cameras=cameras, rays=rays, rows=np.arange(len(problem)))
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    return _of_first_rows(one, linear_starts([one])[0], free, held)
