"""Views along one smooth turn: at even table angles, the source's height chosen as J wants it, without jumps.

FDK follows the source from view to view about the axis and needs its height to be a smooth function of the angle.  The
turn is cut in N slots; each takes one of the candidates at its table angle, and neighbours differ in the source's
elevation by at most STEEPEST times the slot's width.  J is raised slot by slot until none gains, from several waves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from tomopose.errors import OutOfReachError
from tomopose.planning.part.worth import Views
from tomopose.planning.part_scan.choose import value, without_each
from tomopose.planning.part_scan.setting import Setting
from tomopose.planning.part_scan.stations import FULL_TURN, Machine
from tomopose.trajectory.completeness import source_path
from tomopose.units import Array

STEEPEST = 1.0
"""Rise of the source over its run, seen from the part.  The reconstruction takes up to 1.5 for smooth, about the
axis of the best plane through the sources; that axis leans, and on the bracket of benchmarks/planning 1.2 became more
than 1.5 there, 1.0 at most 1.39."""
WAVES = (0, 1, 2, 3, 5, 7)
"""Periods of the source's height in the turn that the search starts from."""
SHARES = (1.0, 0.7, 0.5, 0.3, 0.15, 0.0)
SWEEPS = 30
FINE_DEG = 0.5
"""Turn of the table between the places of the path that are written and looked at."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Turn:
    """slots: rows of the candidates at each table angle;  height, azimuth: (n,) rad, of the source as the part's middle
    sees it;  closed: whether the last view has the first for its neighbour."""

    slots: list[np.ndarray]
    height: Array
    azimuth: Array
    closed: bool

    def smooth(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether the source goes from candidates a to b forwards and without a steep rise."""
        run = np.mod(self.azimuth[a] - self.azimuth[b], FULL_TURN)  # the part turns forwards, the source about it back
        rise = np.abs(self.height[b] - self.height[a])
        smooth: np.ndarray = (rise <= STEEPEST * run + 1e-12) & (run < FULL_TURN / 2)
        return smooth


def of_one_turn(setting: Setting) -> Setting:
    """The setting whose grid of candidates has one table angle for each view."""
    low, high = setting.limits.travel.low[6], setting.limits.travel.high[6]
    width = FULL_TURN if setting.machine.turns_freely else high - low
    slots = setting.views if setting.machine.turns_freely else max(setting.views - 1, 1)
    return replace(setting, settings=replace(setting.settings, alpha_step=max(float(width) / slots, 1e-9)))


def smooth_turn(setting: Setting, q: Array, tables: Views, m: Array, w: Array) -> np.ndarray:
    """Rows (N,) of the candidates q (n, 7) of `of_one_turn`, in the order of the turn.  OutOfReachError where a table
    angle has no candidate, or no smooth way leads through all.

    tables:  of the candidates;  m (n,), w (E,): as in `choose`.
    """
    angles, slot = np.unique(np.round(q[:, 6], 9), return_inverse=True)
    if len(angles) < setting.views:
        raise OutOfReachError(
            f"a continuous turn takes {setting.views} table angles, and only {len(angles)} of them have a pose that is "
            "allowed; widen the limits, or plan without --continuous",
            limits=setting.limits,
        )
    ray = source_path(tables.P) - setting.part.centre
    turn = _Turn(
        slots=[np.flatnonzero(slot == k) for k in range(len(angles))],
        height=np.arcsin(ray[:, 2] / np.linalg.norm(ray, axis=1)),
        azimuth=np.arctan2(ray[:, 1], ray[:, 0]),
        closed=setting.machine.turns_freely,
    )
    best, reached = None, -1.0
    for periods in WAVES:
        for sign in (-1, 1) if periods else (1,):
            rows = _start(turn, sign * np.sin(periods * angles) * np.abs(turn.height).max())
            if rows is None:
                continue
            rows = _raised(turn, tables.A, m, w, rows)
            J = value(tables.A, m, w, rows)
            if best is None or J - reached > 0:
                best, reached = rows, J
    if best is None:
        raise OutOfReachError(
            "no smooth turn leads through the allowed poses: the source's height would have to rise by more than "
            f"{STEEPEST:g} of its way between neighbouring views; widen the limits, or plan without --continuous",
            limits=setting.limits,
        )
    return best


def _start(turn: _Turn, wave: Array) -> np.ndarray | None:
    """Of each slot the candidate nearest to the wave, or to a lower one, so that no step is too steep; None without."""
    for share in SHARES:
        rows = np.array([r[np.abs(turn.height[r] - share * wave[k]).argmin()] for k, r in enumerate(turn.slots)])
        ahead = np.roll(rows, -1)
        if turn.smooth(rows, ahead)[: None if turn.closed else -1].all():
            return rows
    return None


def _raised(turn: _Turn, A: np.ndarray, m: Array, w: Array, rows: np.ndarray) -> np.ndarray:
    """Rows after exchanges within the slots, as long as J gains and no step becomes too steep."""
    rows, N, single = rows.copy(), len(rows), w.astype(np.float32)
    best, second, who = without_each(A, rows)
    for _ in range(SWEEPS):
        changed = False
        for i in range(N):
            near = turn.slots[i]
            if turn.closed or i > 0:
                near = near[turn.smooth(rows[i - 1], near)]
            if turn.closed or i < N - 1:
                near = near[turn.smooth(near, rows[(i + 1) % N])]
            base = np.where(who == i, second, best)
            gains = np.maximum(A[near] - base, 0) @ single + m[near]
            own = float(np.maximum(A[rows[i]] - base, 0) @ single + m[rows[i]])
            k = int(np.argmax(gains))
            if gains[k] > own + 1e-7:
                rows[i], changed = near[k], True
                best, second, who = without_each(A, rows)
        if not changed:
            break
    return rows


def fine_path(machine: Machine, q: Array) -> Array:
    """Axes (k, 7) of the way through views q (n, 7) in the order of the turn, a place every FINE_DEG of the table.

    Piecewise cubic without overshoot (Fritsch and Carlson 1980): between views no axis leaves the interval that they
    span, so that the limits hold.
    """
    if len(q) < 2:
        return q
    knots = q
    if machine.turns_freely:
        knots = np.concatenate([q, q[:1] + FULL_TURN * np.eye(1, 7, 6)])
    width = float(knots[-1, 6] - knots[0, 6])
    alpha = np.linspace(knots[0, 6], knots[-1, 6], int(np.ceil(np.degrees(width) / FINE_DEG)) + 1)
    path: Array = PchipInterpolator(knots[:, 6], knots, axis=0)(alpha)
    path[:, 6] = alpha
    return path
