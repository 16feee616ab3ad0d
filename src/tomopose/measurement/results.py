"""Results of a measurement: one row for each measurand and volume, with groups of repeats and their uncertainties."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

from tomopose.files import atomic_folder, write_json, write_text
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.budget import Budget, budget, repeat_of
from tomopose.measurement.conformity import Decision
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.result import MeasurementResult, Repeat
from tomopose.measurement.uncertainty import Simulated
from tomopose.provenance import Provenance
from tomopose.values import value

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
    "decision",
    "within",
    "direction",
    "method",
    "association",
    "n_points",
    "n_set_aside",
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
    "workpiece",
    "temperature",
    "drift",
    "mean_error",
    "corrected",
    "u",
    "dof",
    "U95",
    "error",
    "U_error",
    "decision",
    "interval",
)


@value
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
            repeat_of(group, rows)
            for group, volumes in self.groups.items()
            if len(volumes) > 1
            for rows in _by_name(r for r in self.results if r.volume in volumes).values()
            if len(rows) > 1
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

    def decided(self, decision: Decision) -> tuple[Budget, ...]:
        """Results with a limit about which this was decided, by all that is known of their uncertainty."""
        return tuple(b for b in self.budgets() if b.decision is decision)

    @property
    def out_of_limits(self) -> tuple[MeasurementResult, ...]:
        """Results that exceed their limit by more than their uncertainty."""
        beyond = {(b.volume, b.name) for b in self.decided(Decision.NOT_CONFORMING)}
        return tuple(r for r in self.results if (r.volume, r.name) in beyond)

    def rows(self) -> list[dict[str, Any]]:
        """Each result as JSON, with the decision by all that is known of its uncertainty."""
        return [
            r.to_json()
            | {
                "decision": None if b.decision is None else b.decision.value,
                "within": None if b.decision is None else b.decision.within,
            }
            for r, b in zip(self.results, self.budgets(), strict=True)
        ]

    def to_json(self) -> dict[str, Any]:
        return {
            "plan": self.plan_name,
            "volumes": list(self.volumes),
            "spacing_mm": dict(self.spacing_mm),
            "scale": dict(self.scale),
            "groups": {g: list(v) for g, v in self.groups.items()},
            "alignments": {v: a.to_json() for v, a in self.alignments.items()},
            "results": self.rows(),
            "repeats": [vars(r) for r in self.repeats()],
            "uncertainty": [b.to_json() for b in self.budgets()],
            "simulated": {n: vars(s) for n, s in self.simulated.items()},
            "features": {v: {n: f.to_json() for n, f in found.items()} for v, found in self.features.items()},
            "notes": {v: list(n) for v, n in self.notes.items()},
            "provenance": None if self.provenance is None else self.provenance.to_json(),
        }

    def to_csv(self) -> str:
        return _table(COLUMNS, self.rows())

    def budgets_csv(self) -> str:
        """Shares of the uncertainty, one row a result."""
        return _table(BUDGET_COLUMNS, [b.to_json() for b in self.budgets()])


def _table(columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow(
            ["" if row[c] is None else repr(row[c]) if isinstance(row[c], float) else row[c] for c in columns]
        )
    return text.getvalue()


def write_results(path: str | Path, results: MeasurementResults, *, force: bool = False) -> None:
    """measurement.json, measurement.csv and uncertainty.csv into the folder `path`, all or none.

    FileError where they exist without `force`.
    """
    with atomic_folder(path, force=force) as temporary:
        write_json(temporary / "measurement.json", SCHEMA, results.to_json())
        write_text(temporary / "measurement.csv", results.to_csv())
        write_text(temporary / "uncertainty.csv", results.budgets_csv())


def _by_name(rows: Iterable[MeasurementResult]) -> dict[str, list[MeasurementResult]]:
    found: dict[str, list[MeasurementResult]] = {}
    for r in rows:
        found.setdefault(r.name, []).append(r)
    return found
