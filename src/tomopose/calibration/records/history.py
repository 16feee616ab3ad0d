"""Calibrations over months: a history of one line each, and the control chart of any of their numbers.

The history is a text of JSON lines, schema tomopose/history/1, which grows by whole lines.  The chart is that of
individual values with known, differing uncertainties, and with a common between-runs scatter where the runs differ by
more than they state.  A run is judged by the others alone, and what lies beyond its limits judges no other: a single
bumped run cannot widen the limits that are to show it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtr, stdtrit

from tomopose.calibration.result import Calibration
from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.files import write_text
from tomopose.units import Array

SCHEMA = "tomopose/history/1"
LIMIT_SIGMAS = 3.0
"""Limits hold a run with the probability of three standard deviations of a normal value, 0.9973; a scatter that is
itself known from few runs only needs more (Student's t)."""


def history_entry(calibration: Calibration, *, label: str = "") -> dict[str, Any]:
    """What the history keeps of a calibration: parameters with uncertainties, residual, verdict, time."""
    made = calibration.provenance.time_utc if calibration.provenance else ""
    return {
        "schema": SCHEMA,
        "time_utc": made or datetime.now(UTC).isoformat(timespec="seconds"),
        "label": label,
        "parameters": {p.name: {"value": p.value, "u": p.u, "unit": p.unit} for p in calibration.parameters},
        "d_rms_px": calibration.d_rms,
        "chi2_dof": calibration.chi2_dof,
        "n_poses": len(calibration.pose_id),
        "n_outliers": len(calibration.outliers),
        "verdict": calibration.verdict,
        "model": calibration.model,
    }


def read_history(path: str | Path) -> list[dict[str, Any]]:
    """All entries, in the order written.  FileError or SchemaVersionError names the line."""
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise FileError(f"cannot read {path}: {error}", path=path) from error
    entries = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
        except ValueError as error:
            raise FileError(f"{path}, line {number}: no JSON ({error})", path=path) from error
        if not isinstance(entry, dict) or entry.get("schema") != SCHEMA:
            raise SchemaVersionError(f"{path}, line {number}: schema is not {SCHEMA}", path=path)
        entries.append(entry)
    return entries


def append_history(path: str | Path, calibration: Calibration, *, label: str = "") -> list[dict[str, Any]]:
    """Add a calibration to the history file (made if absent), atomically; returns all entries."""
    path = Path(path)
    entries = read_history(path) if path.exists() else []
    entries.append(history_entry(calibration, label=label))
    write_text(path, "".join(json.dumps(e, ensure_ascii=False, allow_nan=True) + "\n" for e in entries))
    return entries


@dataclass(frozen=True, kw_only=True)
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
    out: Any
    trend_p: float


def _centre_and_scatter(value: Array, u: Array) -> tuple[float, float, float]:
    """(weighted mean, its variance, between-runs variance), the last by the moment estimate of DerSimonian and Laird
    (Controlled Clinical Trials 7 (1986) 177)."""
    w = 1.0 / u**2
    mean = float((w * value).sum() / w.sum())
    between = 0.0
    if len(value) > 1:
        q = float((w * (value - mean) ** 2).sum())
        between = max(0.0, (q - (len(value) - 1)) / float(w.sum() - (w**2).sum() / w.sum()))
    w = 1.0 / (u**2 + between)
    return float((w * value).sum() / w.sum()), float(1.0 / w.sum()), between


def _limits(value: Array, u: Array, judges: Array) -> tuple[Array, Array]:
    """(n,) lowest and highest value of each run that agrees with the judges (n,) bool other than itself."""
    tail = float(ndtr(-LIMIT_SIGMAS))
    low, high = np.empty(len(value)), np.empty(len(value))
    for k in range(len(value)):
        others = judges.copy()
        others[k] = False
        centre, of_centre, between = _centre_and_scatter(value[others], u[others])
        variance = u[k] ** 2 + between + of_centre
        # Welch and Satterthwaite: only the between-runs part is uncertain
        factor = (
            LIMIT_SIGMAS if between == 0.0 else -float(stdtrit((others.sum() - 1) * (variance / between) ** 2, tail))
        )
        low[k], high[k] = centre - factor * np.sqrt(variance), centre + factor * np.sqrt(variance)
    return low, high


def control_chart(entries: Iterable[Mapping[str, Any]], name: str) -> ControlChart:
    """The chart of a parameter ("t_HT_x", ...) or of "d_rms_px".  InputError with fewer than three entries."""
    rows = [e for e in entries if name == "d_rms_px" or name in e["parameters"]]
    n = len(rows)
    if n < 3:
        raise InputError(f"the history holds {n} values of {name!r}; a control chart needs three")
    if name == "d_rms_px":
        # it states no uncertainty: all of its scatter is between runs
        value, unit = np.array([float(e[name]) for e in rows]), "px"
        u = np.full(n, max(1e-6 * float(np.abs(value).max()), 1e-12))
    else:
        cells = [e["parameters"][name] for e in rows]
        value, u = np.array([float(c["value"]) for c in cells]), np.array([float(c["u"]) for c in cells])
        unit = str(cells[0]["unit"])
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
    centre, _, between = _centre_and_scatter(value[inside], u[inside])
    return ControlChart(
        name=name,
        unit=unit,
        time=tuple(str(e["time_utc"]) for e in rows),
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
