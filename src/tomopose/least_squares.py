r"""One nonlinear least-squares loop, and the status in which every one of the package's solvers ends.

Levenberg-Marquardt with the damping of Marquardt (1963): each step solves (N + lambda diag N) s = J^T r with
N = J^T J.  A step that lowers the sum of squares is taken and lambda falls to a tenth; another one raises it tenfold.
The unknowns are any value that a step moves: a pose, a shape, a calibration.  Weights that depend on the unknowns are
held during a step and renewed after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import numpy as np

from tomopose.units import Array

State = TypeVar("State")

LEAST_DAMPING, LARGEST_DAMPING = 1e-15, 1e10
"""Below the first a step is one of Gauss and Newton to the last bit; beyond the second it moves nothing."""
FIRST_DAMPING = 1e-6
"""What a failed step of Gauss and Newton is followed by; less changes nothing that matters."""
ROUNDING = 1e-13
"""Relative growth of the sum of squares that its own rounding explains."""
UNSEEN = 1e-10
"""What the whole step promises, relative to the sum of squares, that rounding of the calculated values may hide: pixels
of some thousands in residuals of hundredths carry 1e-11."""


class Status(Enum):
    """How a least-squares iteration ended."""

    CONVERGED = "an optimum was reached"
    STALLED = "no step lowers the sum of squares, however short"
    OUT_OF_STEPS = "the iteration ended before it reached an optimum"
    SINGULAR = "the data leave a direction of the unknowns open"
    NO_START = "the start has no finite residuals"

    @property
    def at_rest(self) -> bool:
        """Whether nothing lowers the sum of squares any more."""
        return self in (Status.CONVERGED, Status.STALLED)


CODES = tuple(Status)
"""The members in order: compiled loops return their places."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution(Generic[State]):
    """state: where the iteration ended;  r (n,), J (n, m): residuals and derivatives there;  cost: r . r."""

    state: State
    r: Array
    J: Array
    cost: float
    status: Status


def least_squares(
    rows: Callable[[State], tuple[Array, Array]],
    moved: Callable[[State, Array], State],
    start: State,
    *,
    steps: int,
    tolerance: float,
    damping: float = 1e-3,
    renewed: Callable[[State], State] | None = None,
) -> Solution[State]:
    """The least sum of squares reached from `start`.

    Parameters
    ----------
    rows:       state -> r (n,), observed minus calculated, and J (n, m), the derivatives of what is calculated, both in
                one unit (standard deviations, say); not finite where the state is impossible.
    moved:      (state, step (m,)) -> the state after the step.
    steps:      trials at the most.
    tolerance:  root mean square of J s, relative to that of r where this exceeds 1, of a step that ends the iteration.
    damping:    lambda of the first step.
    renewed:    the state with the weights that belong to it; None where they are constant.
    """
    state = start
    r, J = rows(state)
    cost = _sum_of_squares(r)
    if not np.isfinite(cost):
        return Solution(state=state, r=r, J=J, cost=np.inf, status=Status.NO_START)

    def ended(status: Status) -> Solution[State]:
        return Solution(state=state, r=r, J=J, cost=cost, status=status)

    root_n = np.sqrt(len(r))
    for _ in range(steps):
        step = _step(J, r, damping)
        if step is None:
            damping = max(damping * 10, FIRST_DAMPING)
            if damping > LARGEST_DAMPING:
                return ended(Status.SINGULAR)
            continue
        # a step that is short because it is damped says nothing
        short = damping < 1 and bool(np.linalg.norm(J @ step) <= tolerance * max(root_n, np.sqrt(cost)))
        trial = moved(state, step)
        r_new, J_new = rows(trial)
        cost_new = _sum_of_squares(r_new)
        if cost_new <= cost * (1 + ROUNDING):
            state, r, J, cost, damping = trial, r_new, J_new, cost_new, max(damping / 10, LEAST_DAMPING)
            if renewed is not None:
                state = renewed(state)
                r, J = rows(state)
                cost = _sum_of_squares(r)
        else:
            short = short or promised(J, r) <= UNSEEN * cost
            damping = max(damping * 10, FIRST_DAMPING)
        if short:
            return ended(Status.CONVERGED)
        if damping > LARGEST_DAMPING:
            return ended(Status.STALLED)
    return ended(Status.OUT_OF_STEPS)


def _sum_of_squares(r: Array) -> float:
    """r . r; infinite where it is not a number, so that no such state is taken."""
    cost = float(r @ r)
    return cost if np.isfinite(cost) else np.inf


def promised(J: Array, r: Array) -> float:
    """What the sum of squares would still fall by, were the problem linear; infinite where a direction is open."""
    whole = _step(J, r, 0.0)
    return np.inf if whole is None else float(np.sum((J @ whole) ** 2))


def _step(J: Array, r: Array, damping: float) -> Array | None:
    """The damped step (m,), solved with columns of length 1; None where the matrix is singular."""
    lengths = np.linalg.norm(J, axis=0)
    if not (lengths > 0).all():
        return None
    J = J / lengths
    N = J.T @ J
    N[np.diag_indices(len(N))] *= 1 + damping
    try:
        step = np.asarray(np.linalg.solve(N, J.T @ r) / lengths, dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    return step if np.isfinite(step).all() else None
