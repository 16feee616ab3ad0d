"""Calibrations over months: a history of one line each, and the control chart of any of their numbers.

The history is a text of JSON lines, schema tomopose/history/1, which grows by whole lines.  The chart is that of
individual values with known, differing uncertainties: centre line the weighted mean, limits three standard deviations
of a value about it, with a common between-runs scatter where the runs differ by more than they state.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.files import write_text
from tomopose.units import Array

SCHEMA = "tomopose/history/1"
LIMIT_SIGMAS = 3.0


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
    low, high: (n,) limits;  out: (n,) bool beyond them;  trend_p: probability of the linear trend by chance.
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


def control_chart(entries: Iterable[Mapping[str, Any]], name: str) -> ControlChart:
    """The chart of a parameter ("t_HT_x", ...) or of "d_rms_px".  InputError with fewer than three entries.

    The between-runs variance is the moment estimate of DerSimonian and Laird (Controlled Clinical Trials 7 (1986) 177).
    """
    from scipy.special import stdtr

    rows = [e for e in entries if name == "d_rms_px" or name in e["parameters"]]
    if len(rows) < 3:
        raise InputError(f"the history holds {len(rows)} values of {name!r}; a control chart needs three")
    if name == "d_rms_px":
        value, unit = np.array([float(e[name]) for e in rows]), "px"
        u = np.full(len(rows), np.std(value, ddof=1) if np.ptp(value) > 0 else 1e-12)
    else:
        cells = [e["parameters"][name] for e in rows]
        value, u = np.array([float(c["value"]) for c in cells]), np.array([float(c["u"]) for c in cells])
        unit = str(cells[0]["unit"])
    w = 1.0 / u**2
    mean = float((w * value).sum() / w.sum())
    q = float((w * (value - mean) ** 2).sum())
    between = max(0.0, (q - (len(rows) - 1)) / float(w.sum() - (w**2).sum() / w.sum()))
    if name == "d_rms_px":
        between = 0.0
    w = 1.0 / (u**2 + between)
    centre = float((w * value).sum() / w.sum())
    limit = LIMIT_SIGMAS * np.sqrt(u**2 + between)
    k = np.arange(len(rows)) - (len(rows) - 1) / 2
    slope = float((k * value).sum() / (k**2).sum())
    rest = value - value.mean() - slope * k
    error = np.sqrt((rest**2).sum() / max(len(rows) - 2, 1) / (k**2).sum())
    trend_p = float(2 * stdtr(len(rows) - 2, -abs(slope) / error)) if error > 0 else float(slope == 0)
    return ControlChart(
        name=name, unit=unit, time=tuple(str(e["time_utc"]) for e in rows), value=value, u=u, centre=centre,
        scatter=float(np.sqrt(between)), low=centre - limit, high=centre + limit, out=np.abs(value - centre) > limit,
        trend_p=trend_p,
    )
