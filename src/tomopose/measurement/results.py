"""Results of a measurement: one row a measurand and volume, comparable with calibrated values."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.files import atomic_folder, write_json, write_text
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.budget import FIT_ALONE, Budget, budget, half_width
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.uncertainty import Simulated
from tomopose.provenance import Provenance

SCHEMA = "measurement"
COLUMNS = (
    "volume",
    "name",
    "kind",
    "value",
    "u",
    "U95",
    "unit",
    "reference",
    "u_reference",
    "error",
    "limit",
    "within",
    "direction",
    "method",
    "interval",
)
BUDGET_COLUMNS = (
    "volume",
    "name",
    "unit",
    "value",
    "fit",
    "repeats",
    "calibration",
    "simulation",
    "mean_error",
    "corrected",
    "u",
    "dof",
    "U95",
    "interval",
)


@dataclass(frozen=True, kw_only=True)
class MeasurementResult:
    """One measurand in one volume.

    value, u:     mm or rad as `unit` says; u is the standard uncertainty, nan where it cannot be determined.
    dof:          degrees of freedom of u.
    reference:    calibrated value, else the nominal one, else None; u_reference: its standard uncertainty.
    limit:        largest permitted |value - reference|: the MPE or the tolerance; None where none is given.
    direction:    unidirectional | bidirectional | one-sided (only one end is a surface).
    contributions: standard uncertainties that u is made of.
    """

    name: str
    kind: str
    value: float
    u: float
    unit: str
    method: str
    direction: str
    volume: str = ""
    dof: float = math.inf
    reference: float | None = None
    u_reference: float = 0.0
    limit: float | None = None
    limit_rule: str = ""
    contributions: Mapping[str, float] = field(default_factory=dict)

    @property
    def error(self) -> float | None:
        """value - reference, or None."""
        return None if self.reference is None else self.value - self.reference

    @property
    def U(self) -> float:
        """Half width of the 95 % interval of the value by the fit alone, by Student's t; `interval` says so."""
        return half_width(self.u, self.dof)

    @property
    def interval(self) -> str:
        """What U holds, in words."""
        return FIT_ALONE if math.isfinite(self.u) else "not determined"

    @property
    def within(self) -> bool | None:
        """Whether |error| keeps the limit; None without reference or limit."""
        return None if self.error is None or self.limit is None else abs(self.error) <= self.limit

    def to_json(self) -> dict[str, Any]:
        return {
            "volume": self.volume,
            "name": self.name,
            "kind": self.kind,
            "value": self.value,
            "u": self.u,
            "U95": self.U,
            "dof": self.dof,
            "unit": self.unit,
            "reference": self.reference,
            "u_reference": self.u_reference,
            "error": self.error,
            "limit": self.limit,
            "limit_rule": self.limit_rule,
            "within": self.within,
            "direction": self.direction,
            "method": self.method,
            "interval": self.interval,
            "contributions": dict(self.contributions),
        }


@dataclass(frozen=True, kw_only=True)
class Repeat:
    """A measurand over a group of repeats: mean, standard deviation s, expanded uncertainty after VDI/VDE 2630-2.1:

    U = k sqrt(u_cal^2 + s^2) + |b|, k = 2, b the mean error, where a reference is given; `interval` says what U holds.
    """

    group: str
    name: str
    n: int
    mean: float
    s: float
    unit: str
    error: float | None
    U: float
    interval: str = ""


@dataclass(frozen=True, kw_only=True)
class MeasurementResults:
    """Everything that `measure` found.

    results:  all measurands of all volumes;  features: volume -> name -> feature;  notes: volume -> remarks;
    scale:    volume -> factor that lengths were multiplied by (1 where no correction was made);
    alignments: volume -> part to W;  groups: name -> volumes that repeat one measurement.
    calibration_u: volume -> measurand -> standard uncertainty from a calibration's covariance, where one was given;
    simulated: measurand -> its error over virtual scans, where there were any.
    """

    plan_name: str
    results: tuple[MeasurementResult, ...]
    features: Mapping[str, Mapping[str, Feature]]
    notes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    spacing_mm: Mapping[str, float] = field(default_factory=dict)
    alignments: Mapping[str, Alignment] = field(default_factory=dict)
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    calibration_u: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    simulated: Mapping[str, Simulated] = field(default_factory=dict)
    provenance: Provenance | None = None

    def __len__(self) -> int:
        return len(self.results)

    @property
    def volumes(self) -> tuple[str, ...]:
        return tuple(self.features)

    def of(self, volume: str) -> tuple[MeasurementResult, ...]:
        """The results of one volume."""
        return tuple(r for r in self.results if r.volume == volume)

    def repeats(self) -> tuple[Repeat, ...]:
        """Each measurand over each group of at least two volumes."""
        return tuple(
            _repeat(group, name, rows)
            for group, volumes in self.groups.items()
            if len(volumes) > 1
            for name, rows in _by_name(r for r in self.results if r.volume in volumes).items()
        )

    def budgets(self) -> tuple[Budget, ...]:
        """The uncertainty of each result from all that is known."""
        group = {v: g for g, volumes in self.groups.items() for v in volumes}
        repeats = {(r.group, r.name): r for r in self.repeats()}
        return tuple(
            budget(
                r,
                repeat=repeats.get((group.get(r.volume, ""), r.name)),
                calibration=self.calibration_u.get(r.volume, {}).get(r.name),
                simulated=self.simulated.get(r.name),
            )
            for r in self.results
        )

    @property
    def out_of_limits(self) -> tuple[MeasurementResult, ...]:
        return tuple(r for r in self.results if r.within is False)

    def to_json(self) -> dict[str, Any]:
        return {
            "plan": self.plan_name,
            "volumes": list(self.volumes),
            "spacing_mm": dict(self.spacing_mm),
            "scale": dict(self.scale),
            "groups": {g: list(v) for g, v in self.groups.items()},
            "alignments": {v: a.to_json() for v, a in self.alignments.items()},
            "results": [r.to_json() for r in self.results],
            "repeats": [vars(r) for r in self.repeats()],
            "uncertainty": [b.to_json() for b in self.budgets()],
            "simulated": {n: vars(s) for n, s in self.simulated.items()},
            "features": {v: {n: f.to_json() for n, f in found.items()} for v, found in self.features.items()},
            "notes": {v: list(n) for v, n in self.notes.items()},
            "provenance": None if self.provenance is None else self.provenance.to_json(),
        }

    def to_csv(self) -> str:
        return _table(COLUMNS, [r.to_json() for r in self.results])

    def budgets_csv(self) -> str:
        """Shares of the uncertainty, one row a result."""
        return _table(BUDGET_COLUMNS, [b.to_json() for b in self.budgets()])


def _table(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow(
            ["" if row[c] is None else repr(row[c]) if isinstance(row[c], float) else row[c] for c in columns]
        )
    return text.getvalue()


def write_results(results: MeasurementResults, folder: str | Path, *, force: bool = False) -> None:
    """measurement.json, measurement.csv and uncertainty.csv into a folder, all or none.

    FileError where they exist without `force`.
    """
    with atomic_folder(folder, force=force) as temporary:
        write_json(temporary / "measurement.json", SCHEMA, results.to_json())
        write_text(temporary / "measurement.csv", results.to_csv())
        write_text(temporary / "uncertainty.csv", results.budgets_csv())


def _by_name(rows: Iterable[MeasurementResult]) -> dict[str, list[MeasurementResult]]:
    found: dict[str, list[MeasurementResult]] = {}
    for r in rows:
        found.setdefault(r.name, []).append(r)
    return found


def _repeat(group: str, name: str, rows: list[MeasurementResult]) -> Repeat:
    values = np.array([r.value for r in rows])
    s = float(values.std(ddof=1)) if len(values) > 1 else math.nan
    u_fit = float(np.nanmean([r.u for r in rows])) if any(math.isfinite(r.u) for r in rows) else 0.0
    reference = rows[0].reference
    error = None if reference is None else float(values.mean()) - reference
    # The spread of repeats holds the fit's noise already; the larger of the two stands for both.
    U = 2.0 * math.sqrt(rows[0].u_reference ** 2 + max(s, u_fit) ** 2) + (0.0 if error is None else abs(error))
    systematic = "without the systematic part" if error is None else "mean error from the reference"
    return Repeat(
        group=group,
        name=name,
        n=len(rows),
        mean=float(values.mean()),
        s=s,
        unit=rows[0].unit,
        error=error,
        U=U,
        interval=f"repeats; {systematic}",
    )
