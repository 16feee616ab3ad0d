"""The control chart of one number of a history: individual values with known, differing uncertainties.

A common between-runs scatter is added where the runs differ by more than they state.  A run is judged by the others
alone, and what lies beyond its limits judges no other: a single bumped run cannot widen the limits that are to show it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtr, stdtrit

from tomopose.calibration.records.history import Entry
from tomopose.errors import InputError
from tomopose.units import Array
from tomopose.values import require_types, value

LIMIT_SIGMAS = 3.0
"""Limits hold a run with the probability of three standard deviations of a normal value, 0.9973; a scatter that is
itself known from few runs only needs more (Student's t)."""

RESIDUAL = "d_rms_px"
FEWEST_RUNS = 3
NO_UNCERTAINTY = 1e-6
"""Of the value: represents a standard uncertainty that is not stated, so that all scatter is between runs."""


@dataclass(frozen=True, kw_only=True)
class Series:
    """One number over the runs that state it: value, u (n,), its unit, and the runs' places in the history (n,)."""

    name: str
    unit: str
    value: Array
    u: Array
    place: np.ndarray


def series(entries: Iterable[Entry], name: str) -> Series:
    """A parameter ("t_HT_x", ...) or "d_rms_px" over the history; runs without a finite value and u are left out.

    Angles are continued over +-pi.  d_rms_px states no uncertainty: all of its scatter is between runs.
    """
    place, value, u, unit = [], [], [], "px"
    for k, entry in enumerate(entries):
        if name == RESIDUAL:
            cell = {"value": entry.get(RESIDUAL, np.nan), "u": 0.0, "unit": "px"}
        elif name in entry["parameters"]:
            cell = entry["parameters"][name]
        else:
            continue
        x, s = float(cell["value"]), float(cell["u"])
        if np.isfinite(x) and np.isfinite(s):
            place.append(k)
            value.append(x)
            u.append(s)
            unit = str(cell["unit"])
    values = np.array(value, dtype=np.float64)
    if unit == "rad" and values.size:
        values = values[0] + np.mod(values - values[0] + np.pi, 2 * np.pi) - np.pi
    least = max(NO_UNCERTAINTY * float(np.abs(values).max(initial=0.0)), 1e-12)
    return Series(name=name, unit=unit, value=values, u=np.maximum(u, least), place=np.array(place, dtype=np.intp))


@value
class ControlChart:
    """One number over the history.

    time: n ISO texts;  value, u: (n,);  centre;  scatter: between-runs standard deviation, 0 where the runs agree;
    low, high: (n,) limits of each run by the others;  out: (n,) bool beyond them;  trend_p: probability of the linear
    trend by chance.  Centre, scatter and trend are those of the runs that are not out.
    """

    name: str
    unit: str
    time: tuple[str, ...]
    value: Array
    u: Array
    centre: float
    scatter: float
    low: Array
    high: Array
    out: np.ndarray
    trend_p: float


def between_runs(squares: float, w: Array, groups: list[np.ndarray]) -> float:
    """Between-runs variance of runs about the weighted means of their groups, by the moment estimate of DerSimonian and
    Laird (Controlled Clinical Trials 7 (1986) 177).  squares: sum of w (value - mean)^2;  w (n,): 1 / u^2."""
    dof = sum(len(g) for g in groups) - len(groups)
    lost = sum(float(w[g].sum() - (w[g] ** 2).sum() / w[g].sum()) for g in groups)
    return max(0.0, (squares - dof) / lost) if dof > 0 else 0.0


def centre_and_scatter(value: Array, u: Array) -> tuple[float, float, float]:
    """(weighted mean, its variance, between-runs variance)."""
    w = 1.0 / u**2
    mean = float((w * value).sum() / w.sum())
    between = between_runs(float((w * (value - mean) ** 2).sum()), w, [np.arange(len(value))])
    w = 1.0 / (u**2 + between)
    return float((w * value).sum() / w.sum()), float(1.0 / w.sum()), between


def from_others(value: Array, u: Array, k: int, others: np.ndarray) -> tuple[float, float, float]:
    """(mean of the other runs, variance of run k minus that mean, the between-runs variance in it)."""
    centre, of_centre, between = centre_and_scatter(value[others], u[others])
    return centre, float(u[k] ** 2 + between + of_centre), between


def _limits(value: Array, u: Array, judges: np.ndarray) -> tuple[Array, Array]:
    """(n,) lowest and highest value of each run that agrees with the judges (n,) bool other than itself."""
    tail = float(ndtr(-LIMIT_SIGMAS))
    low, high = np.empty(len(value)), np.empty(len(value))
    for k in range(len(value)):
        others = np.setdiff1d(np.flatnonzero(judges), k)
        centre, variance, between = from_others(value, u, k, others)
        # Welch and Satterthwaite: only the between-runs part was estimated
        dof = (len(others) - 1) * (variance / between) ** 2 if between > 0.0 else 0.0
        factor = -float(stdtrit(dof, tail)) if dof > 0.0 else LIMIT_SIGMAS
        low[k], high[k] = centre - factor * np.sqrt(variance), centre + factor * np.sqrt(variance)
    return low, high


@require_types
def control_chart(entries: Iterable[Mapping[str, object]], name: str) -> ControlChart:
    """The chart of a parameter ("t_HT_x", ...) or of "d_rms_px".  InputError with fewer than three entries."""
    runs = list(entries)
    found = series(runs, name)
    value, u, n = found.value, found.u, len(found.value)
    if n < FEWEST_RUNS:
        raise InputError(f"the history holds {n} values of {name!r}; a control chart needs three")
    inside = np.ones(n, dtype=bool)
    low, high = _limits(value, u, inside)
    while True:
        beyond = np.where(inside, np.maximum(low - value, value - high) / (high - low), -np.inf)
        worst = int(beyond.argmax())
        # one at a time, while a majority remains to judge
        if beyond[worst] <= 0.0 or 2 * (inside.sum() - 1) <= n:
            break
        inside[worst] = False
        low, high = _limits(value, u, inside)
    centre, _, between = centre_and_scatter(value[inside], u[inside])
    return ControlChart(
        name=name,
        unit=found.unit,
        time=tuple(str(runs[k].get("time_utc", "")) for k in found.place),
        value=value,
        u=u,
        centre=centre,
        scatter=float(np.sqrt(between)),
        low=low,
        high=high,
        out=(value < low) | (value > high),
        trend_p=_trend_p(np.flatnonzero(inside).astype(np.float64), value[inside]),
    )


def _trend_p(k: Array, value: Array) -> float:
    """Probability by chance of a slope of value over k at least this steep."""
    if len(k) < 3:
        return 1.0
    k = k - k.mean()
    slope = float((k * value).sum() / (k**2).sum())
    rest = value - value.mean() - slope * k
    error = np.sqrt((rest**2).sum() / (len(k) - 2) / (k**2).sum())
    return float(2 * stdtr(len(k) - 2, -abs(slope) / error)) if error > 0 else float(slope == 0)
