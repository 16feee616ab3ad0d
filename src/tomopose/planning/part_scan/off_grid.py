"""Views moved off the grid of candidates: table angle, tilts and lift of each by half steps, as long as J gains.

The tolerance of a tangent is finer than the grid, so a view of the grid often misses faces by a fraction of a degree.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tomopose.planning.part.settings import WEIGHTS
from tomopose.planning.part.worth import Goal, Views, table
from tomopose.planning.part_scan.choose import without_each
from tomopose.planning.part_scan.stations import Machine, allowed
from tomopose.units import Array

ROUNDS = 2
"""Each halves the steps of the one before."""
LIFT_STEP_MM = 2.0


def refine_off_grid(goal: Goal, machine: Machine, q: Array, views: Views) -> tuple[Array, Views]:
    """(q (n, 7), their tables): no view worth less for J than before, all within limits, in view and clear."""
    q, w, n = q.copy(), goal.w, len(q)
    P, A, tau, incidence = (np.array(a) for a in (views.P, views.A, views.tau, views.incidence))
    s = goal.settings
    full = {6: s.alpha_step, 3: s.tilt_step, 4: s.tilt_step, 2: LIFT_STEP_MM}
    if machine.spin[1] > machine.spin[0]:
        full[5] = s.alpha_step
    best, second, who = without_each(A, np.arange(n))
    for halving in range(1, ROUNDS + 1):
        for i in range(n):
            base = np.where(who == i, second, best)
            around = _neighbours(machine, q[i], {axis: step / 2**halving for axis, step in full.items()})
            around = around[allowed(machine, goal.part, around, margin=s.margin)]
            if not len(around):
                continue
            tried = table(goal, machine.matrices(around))
            clear = s.least_view_transmission <= tried.M
            if not clear.any():
                continue
            around, tried = around[clear], tried.take(clear)
            gains = np.maximum(tried.A - base, 0) @ w + WEIGHTS[2] * tried.M / n
            own = float(np.maximum(A[i] - base, 0) @ w) + WEIGHTS[2] * float(tau[i].mean()) / n
            k = int(np.argmax(gains))
            if gains[k] > own + 1e-9:
                q[i], P[i], A[i] = around[k], tried.P[k], tried.A[k]
                tau[i], incidence[i] = tried.tau[k], tried.incidence[k]
                best, second, who = without_each(A, np.arange(n))
    return q, Views(P=P, A=A, tau=tau, incidence=incidence)


def _neighbours(machine: Machine, q: Array, steps: Mapping[int, float]) -> Array:
    """(k, 7): one step up and down along each of the axes named, within the limits."""
    moved = np.repeat(q[None], 2 * len(steps), axis=0)
    for k, (axis, step) in enumerate(steps.items()):
        moved[2 * k, axis] += step
        moved[2 * k + 1, axis] -= step
    moved = machine.clipped(moved)
    return moved[(np.abs(moved - q) > 1e-12).any(axis=1)]
