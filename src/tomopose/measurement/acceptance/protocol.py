"""The acceptance protocol of VDI/VDE 2630-1.3 for a multi-sphere standard, filled from a measurement.

Test values, each a measured minus a calibrated value or a form:

    P_F   probing error, form: range of 25 representative points, each the mean of one patch, about the least-squares
          sphere; beside it that of all points and D95 (narrowest shell of 95 %), without a limit
    P_S   probing error, size: diameter of the least-squares sphere of all points minus the calibrated one
    SD    sphere distance error: distance of two least-squares centres minus the calibrated one
    E     length measurement error of the bidirectional length between the far poles of two spheres, from the above:
          (SD + mean of both P_S), made larger in size by the greater of both P_F

P_F, P_S and SD are computed by their definitions in that guideline.  E from sphere distances completes SD by the two
probing errors, so that it is never smaller than what faces would show; it is named as this package's own way, and is no
measurement of gauge blocks.  The guideline is cited as a whole: clause numbers were not checked and are not stated.

The uncertainty of a test value is that of the test and not of the instrument (ISO 14253-5, ISO/TS 23165): calibration
of the standard, its drift and temperature, and for P_F the form of the spheres; expanded with k = 2.  The decision is
that of ISO 14253-1, with the limits that the user gives.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.coverage import expanded_k2
from tomopose.errors import InputError
from tomopose.files import atomic_folder, write_json, write_text
from tomopose.measurement.bench import sphere_name
from tomopose.measurement.conformity import Decision, decide
from tomopose.measurement.features.measurands import maximum_permissible_error
from tomopose.measurement.plan import LimitPlan, MeasurementPlan, SpheresPlan
from tomopose.measurement.result import MeasurementResult
from tomopose.measurement.results import MeasurementResults
from tomopose.provenance import Provenance

SCHEMA = "acceptance-protocol"
GUIDELINE = "VDI/VDE 2630-1.3:2011"
LEAST_LENGTHS, LEAST_DIRECTIONS = 5, 7
"""Calibrated lengths in each of so many directions that a length test holds, as in ISO 10360-2."""
LONGEST_SHARE = 0.66
"""Share of the longest possible length that the longest one reaches (guideline and ASME B89.4.23; 0.85 in ISO/DIS
10360-11)."""
DEFINITIONS: Mapping[str, tuple[str, bool]] = {
    "P_F": ("range of 25 representative points about the least-squares sphere", True),
    "P_S": ("diameter of the least-squares sphere minus the calibrated diameter", True),
    "SD": ("distance of two least-squares centres minus the calibrated distance", True),
    "E": ("SD and the mean P_S of both spheres, made larger in size by the greater P_F", False),
}
"""Quantity -> definition, and whether it is the guideline's own."""
COLUMNS = ("quantity", "name", "value_mm", "reference_mm", "test_value_um", "U_um", "mpe_um", "decision", "definition")


@dataclass(frozen=True, kw_only=True)
class ProtocolLine:
    """One test value, mm: value as measured, reference (nan for a form), test_value, its expanded uncertainty U (k = 2;
    nan where something of it is not stated), mpe (nan where none is given), decision (None without an MPE)."""

    quantity: str
    name: str
    value: float
    reference: float
    test_value: float
    U: float
    mpe: float
    decision: Decision | None

    def to_json(self) -> dict[str, Any]:
        um = 1000.0
        return {
            "quantity": self.quantity,
            "name": self.name,
            "value_mm": self.value,
            "reference_mm": self.reference,
            "test_value_um": um * self.test_value,
            "U_um": um * self.U,
            "mpe_um": um * self.mpe,
            "decision": None if self.decision is None else self.decision.value,
            "definition": DEFINITIONS[self.quantity][0],
        }


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """The protocol of one volume.  header: who, what and when as the user states it;  remarks: what the test lacks."""

    volume: str
    header: Mapping[str, str]
    lines: tuple[ProtocolLine, ...]
    informative: Mapping[str, float]
    remarks: tuple[str, ...]
    provenance: Provenance | None = None

    def of(self, quantity: str) -> tuple[ProtocolLine, ...]:
        return tuple(x for x in self.lines if x.quantity == quantity)

    def worst(self, quantity: str) -> ProtocolLine | None:
        """The line that comes nearest to its limit or exceeds it most; the largest one without a limit."""
        lines = self.of(quantity)
        if not lines:
            return None
        return max(lines, key=lambda x: abs(x.test_value) - (x.mpe if math.isfinite(x.mpe) else 0.0))

    def decision(self, quantity: str) -> Decision | None:
        """A quantity conforms where all its test values do, and does not where one does not."""
        found = {x.decision for x in self.of(quantity)} - {None}
        for decision in (Decision.NOT_CONFORMING, Decision.NOT_DECIDABLE, Decision.CONFORMING):
            if decision in found:
                return decision
        return None

    def to_json(self) -> dict[str, Any]:
        return {
            "guideline": GUIDELINE,
            "volume": self.volume,
            "header": dict(self.header),
            "summary": [self._summary(q) for q in DEFINITIONS if self.of(q)],
            "lines": [x.to_json() for x in self.lines],
            "informative_um": {k: 1000.0 * v for k, v in self.informative.items()},
            "remarks": list(self.remarks),
            "provenance": None if self.provenance is None else self.provenance.to_json(),
        }

    def _summary(self, quantity: str) -> dict[str, Any]:
        worst, decision = self.worst(quantity), self.decision(quantity)
        words, own = DEFINITIONS[quantity]
        return {
            "quantity": quantity,
            "definition": words,
            "definition_of": GUIDELINE if own else "this package, from quantities of the guideline",
            "test_values": len(self.of(quantity)),
            "worst": None if worst is None else worst.to_json(),
            "decision": None if decision is None else decision.value,
        }

    def to_csv(self) -> str:
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for x in self.lines:
            row = x.to_json()
            writer.writerow({k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()})
        return text.getvalue()


def tested_spheres(plan: MeasurementPlan) -> SpheresPlan:
    """The multi-sphere standard of a plan.  InputError where it has none, or corrects the scale by it."""
    if plan.spheres is None:
        raise InputError("the acceptance protocol is of a multi-sphere standard: the plan needs [spheres]")
    if plan.spheres.scale_correction:
        raise InputError("the acceptance test is of the instrument as it is: set scale_correction = false in [spheres]")
    return plan.spheres


def acceptance_protocol(results: MeasurementResults, plan: MeasurementPlan, volume: str) -> Protocol:
    """The protocol of one volume of `results`, which `measure` made of a plan with [spheres] and [acceptance].

    Raises InputError where the plan has no spheres, or the volume was not measured.
    """
    spheres = tested_spheres(plan)
    if volume not in results.features:
        raise InputError(f"there are no results of a volume {volume!r}; known: {', '.join(results.volumes)}")
    rows = {r.name: r for r in results.of(volume)}
    numbers = [k for k in range(len(spheres.centres)) if sphere_name(k) in results.features[volume]]
    form = {k: _form_line(rows[f"form_25 {k + 1:02d}"], plan) for k in numbers}
    size = {k: _size_line(rows[f"D {k + 1:02d}"], plan) for k in numbers}
    pairs = [(i, j) for a, i in enumerate(numbers) for j in numbers[a + 1 :]]
    distance = {(i, j): _distance_line(rows[f"SD {i + 1:02d}-{j + 1:02d}"], plan, spheres) for i, j in pairs}
    lengths = [
        _length_line(distance[i, j], (size[i], size[j]), (form[i], form[j]), plan.acceptance.mpe_E) for i, j in pairs
    ]
    return Protocol(
        volume=volume,
        header=plan.acceptance.header(),
        lines=(*form.values(), *size.values(), *distance.values(), *lengths),
        informative={
            "P_F of all points, largest": max(rows[f"form {k + 1:02d}"].value for k in numbers),
            "P_F of 95 % of the points (D95), largest": max(rows[f"form_95 {k + 1:02d}"].value for k in numbers),
        },
        remarks=_remarks(plan, spheres, numbers, results.notes.get(volume, ())),
        provenance=results.provenance,
    )


def write_protocol(path: str | Path, protocol: Protocol, *, force: bool = False) -> None:
    """protocol.json (schema tomopose/acceptance-protocol/1) and protocol.csv into the folder `path`, both or none."""
    with atomic_folder(path, force=force) as temporary:
        write_json(temporary / "protocol.json", SCHEMA, protocol.to_json())
        write_text(temporary / "protocol.csv", protocol.to_csv())


def _line(
    quantity: str, name: str, value: float, reference: float, test_value: float, u: Sequence[float], mpe: float | None
) -> ProtocolLine:
    """A line whose test value has the independent standard uncertainties u; nan among them says: not stated."""
    U = expanded_k2(math.hypot(*u))
    limit = math.nan if mpe is None else mpe
    return ProtocolLine(
        quantity=quantity,
        name=name,
        value=value,
        reference=reference,
        test_value=test_value,
        U=U,
        mpe=limit,
        decision=None if mpe is None else decide(test_value, U, limit),
    )


def _of_test(row: MeasurementResult) -> list[float]:
    """Standard uncertainties of a test value that come from the standard and its temperature."""
    return [row.u_reference, *(row.stated[k] for k in ("temperature", "drift") if k in row.stated)]


def _form_line(row: MeasurementResult, plan: MeasurementPlan) -> ProtocolLine:
    stated = plan.acceptance
    u_form = math.nan if stated.u_form_mm is None else stated.u_form_mm
    mpe = None if stated.mpe_PF_um is None else stated.mpe_PF_um / 1000
    name = f"sphere {row.name.split()[-1]}"
    return _line("P_F", name, row.value, math.nan, row.value, [u_form], mpe)


def _size_line(row: MeasurementResult, plan: MeasurementPlan) -> ProtocolLine:
    stated = plan.acceptance.mpe_PS_um
    mpe = row.limit if stated is None else stated / 1000
    reference = _reference(row)
    name = f"sphere {row.name.split()[-1]}"
    return _line("P_S", name, row.value, reference, row.value - reference, _of_test(row), mpe)


def _distance_line(row: MeasurementResult, plan: MeasurementPlan, spheres: SpheresPlan) -> ProtocolLine:
    reference = _reference(row)
    limit = plan.acceptance.mpe_SD or spheres.mpe_distance
    name = f"spheres {row.name.split()[-1]}"
    return _line("SD", name, row.value, reference, row.value - reference, _of_test(row), _mpe(limit, reference))


def _length_line(
    distance: ProtocolLine,
    size: tuple[ProtocolLine, ProtocolLine],
    form: tuple[ProtocolLine, ProtocolLine],
    limit: LimitPlan | None,
) -> ProtocolLine:
    """The length between the far poles of two spheres."""
    reference = distance.reference + sum(x.reference for x in size) / 2
    error = distance.test_value + sum(x.test_value for x in size) / 2
    error += math.copysign(max(x.test_value for x in form), error)
    # Both diameters were calibrated alike: their uncertainties are taken as common.
    u = [distance.U / 2, (size[0].U + size[1].U) / 4, max(x.U for x in form) / 2]
    return _line("E", distance.name, reference + error, reference, error, u, _mpe(limit, reference))


def _reference(row: MeasurementResult) -> float:
    if row.reference is None:
        raise InputError(f"{row.name} has no calibrated value")
    return row.reference


def _mpe(limit: LimitPlan | None, length: float) -> float | None:
    return None if limit is None else maximum_permissible_error(length, limit.A_um, limit.K, limit.B_um) / 1000


def _remarks(
    plan: MeasurementPlan, spheres: SpheresPlan, numbers: Sequence[int], notes: Sequence[str]
) -> tuple[str, ...]:
    """What the test holds and what it lacks, in words."""
    x = np.array(spheres.centres)[list(numbers)]
    i, j = np.triu_indices(len(x), 1)
    d = np.linalg.norm(x[i] - x[j], axis=1)
    out = [
        f"{len(numbers)} of {len(spheres.centres)} spheres give {len(d)} distances from {d.min():.3f} to "
        f"{d.max():.3f} mm; the guideline asks for {LEAST_LENGTHS} lengths in {LEAST_DIRECTIONS} directions."
    ]
    longest = plan.acceptance.longest_length_mm
    if longest is None:
        out.append("longest_length_mm, the longest length that the measuring volume holds, is not stated.")
    else:
        share = float(d.max()) / longest
        enough = "enough" if share >= LONGEST_SHARE else "less than the guideline asks for"
        out.append(
            f"The longest distance is {100 * share:.0f} % of the longest possible length ({longest:g} mm): {enough}; "
            f"{100 * LONGEST_SHARE:.0f} % are asked for."
        )
    unstated = [
        words
        for words, value in (
            ("u_distance_mm of the distances", spheres.u_distance_mm),
            ("u_diameter_mm of the diameters", spheres.u_diameter_mm),
            ("u_form_mm of the spheres' form", plan.acceptance.u_form_mm),
        )
        if value is None
    ]
    if unstated:
        out.append(f"Not stated, so that nothing is decided by it: {', '.join(unstated)}; 0 says exact.")
    if spheres.calibrated_diameters_mm is None:
        out.append("The spheres have one nominal diameter; calibrated_diameters_mm gives each its own.")
    if spheres.outliers is not None:
        out.append(f"The plan sets points aside beyond {spheres.outliers:g} rms for the centres and diameters.")
    if plan.surface.curvature_correction:
        out.append("Radii are corrected for the blur (curvature_correction).")
    out.append("Structural resolution and the influence of material and geometry are not part of this protocol.")
    return (*out, *notes)
