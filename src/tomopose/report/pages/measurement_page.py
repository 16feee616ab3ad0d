"""The report of a measurement: errors beside their limits, with the decision about each, and where U comes from."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from tomopose.geometry.rotations import log_rotation
from tomopose.measurement.budget import Budget
from tomopose.measurement.conformity import Decision
from tomopose.measurement.mesh.comparison import Comparison
from tomopose.measurement.result import FIT_ALONE, MeasurementResult
from tomopose.measurement.results import MeasurementResults
from tomopose.report.figures.measurement_figures import (
    deviation_histogram,
    deviation_view,
    error_bars,
    errors_by_length,
    group_bars,
)
from tomopose.report.page import BAD, CARE, GOOD, Block, KeyFigure, Page, Section, Table, Verdict, Words, render
from tomopose.report.sections.budget import MANY, budget_sections, micrometres
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.words import NOT_DETERMINABLE, number
from tomopose.units import MICROMETRES_PER_MM, Array

FORM_NAMES = {"form": "all points", "form_95": "95 % of the points", "form_25": "25 patches"}


def measurement_report(
    results: MeasurementResults,
    *,
    comparisons: Mapping[str, Comparison] | None = None,
    range_mm: float = 0.025,
    title: str = "Measurement report",
) -> str:
    """One offline HTML document about a measurement.

    comparisons: volume -> nominal-actual comparison;  range_mm: where its colours are clipped.
    """
    sections = [
        Section(
            title="Errors", lead="Measured minus calibrated value, beside what is permitted.", blocks=_errors(results)
        ),
        Section(title="All results", blocks=[_rows(results), *_repeats(results)]),
        *budget_sections(results),
    ]
    for name, comparison in (comparisons or {}).items():
        sections.insert(1, _comparison(name, comparison, range_mm))
    sections += [
        _features(results),
        Section(title="Remarks", blocks=_notes(results)),
        provenance_section(results.provenance),
    ]
    n = len(results.volumes)
    return render(
        Page(
            title=title,
            subtitle=f"{results.plan_name}: {n} volume{'s' if n > 1 else ''}",
            verdict=_verdict(results),
            key_figures=_keys(results),
            sections=sections,
            footer="Written by tomopose. Intervals of single results are 95 % of the fit's own scatter.",
        )
    )


def _verdict(results: MeasurementResults) -> Verdict:
    beyond, undecided = results.decided(Decision.NOT_CONFORMING), results.decided(Decision.NOT_DECIDABLE)
    judged = len(beyond) + len(undecided) + len(results.decided(Decision.CONFORMING))
    if not judged:
        return Verdict(word="Measured", sentence="No limits were given, so nothing is judged.", tone=CARE)
    rule = "by the 95 % interval of each (ISO 14253-1)"
    reasons = [_decision_words(b, results) for b in (*beyond, *undecided)[:8]]
    if beyond:
        rest = f" {len(undecided)} more cannot be decided." if undecided else ""
        return Verdict(
            word="Not conforming",
            sentence=f"{len(beyond)} of {judged} results with a limit exceed it, {rule}.{rest}",
            tone=BAD,
            reasons=reasons,
        )
    if undecided:
        return Verdict(
            word="Not decidable",
            sentence=f"{len(undecided)} of {judged} results with a limit cannot be decided, {rule}; others conform.",
            tone=CARE,
            reasons=reasons,
        )
    return Verdict(word="Conforming", sentence=f"All {judged} results with a limit conform, {rule}.", tone=GOOD)


def _decision_words(b: Budget, results: MeasurementResults) -> str:
    """Why one result is not said to conform."""
    row = next(r for r in results.results if (r.volume, r.name) == (b.volume, b.name))
    found = f"{b.name} ({b.volume}): error {_shown(b.error, b.unit, signed=True)}"
    if math.isnan(row.u_reference):
        return f"{found}, permitted {_shown(row.limit, b.unit)}; the uncertainty of the calibrated value is not stated"
    if not math.isfinite(b.U_error):
        return f"{found}, permitted {_shown(row.limit, b.unit)}; its uncertainty is not determined"
    return f"{found} ± {_shown(b.U_error, b.unit)}, permitted {_shown(row.limit, b.unit)}"


def _shown(value: float | None, unit: str, *, signed: bool = False) -> str:
    """Micrometres or seconds of arc, with the unit."""
    if value is None or not math.isfinite(value):
        return NOT_DETERMINABLE
    if unit == "mm":
        return f"{micrometres(value, signed)} µm"
    seconds = math.degrees(value) * 3600
    return f"{seconds:+.1f} arcsec" if signed else f"{seconds:.1f} arcsec"


def _keys(results: MeasurementResults) -> list[KeyFigure]:
    errors = np.array(
        [
            r.error
            for r in results.results
            if r.error is not None and r.unit == "mm" and r.kind in ("distance", "diameter")
        ],
        dtype=np.float64,
    )
    spacing = max(results.spacing_mm.values(), default=math.nan)
    keys = [
        KeyFigure(
            name="Results", value=str(len(results)), note=f"Measured values of {len(results.volumes)} volume(s)."
        ),
        KeyFigure(name="Voxel", value=f"{number(spacing)} mm", note="Largest side; errors of edges scale with it."),
    ]
    if errors.size:
        largest = float(np.abs(errors).max())
        keys += [
            KeyFigure(
                name="Largest length error",
                value=f"{micrometres(largest)} µm",
                note=f"{largest / spacing:.3f} of a voxel; compare it with what is permitted.",
            ),
            KeyFigure(
                name="Rms of length errors",
                value=f"{micrometres(float(np.sqrt(np.mean(errors**2))))} µm",
                note="Of all distances, diameters and positions: the usual error.",
            ),
        ]
    for name, factor in results.scale.items():
        if factor != 1.0:
            keys.append(
                KeyFigure(
                    name="Scale correction", value=f"{factor:.7f}", note=f"Lengths of {name} were multiplied by it."
                )
            )
    return keys


def _errors(results: MeasurementResults) -> list[Block]:
    blocks: list[Block] = []
    for kind, words in (("distance", "Distances"), ("diameter", "Diameters"), ("position", "Positions")):
        rows = [r for r in results.results if r.kind == kind and r.error is not None]
        if rows:
            many = kind == "distance" and len(rows) > MANY * len(results.volumes)
            blocks.append(
                errors_by_length(words, rows, results.volumes) if many else error_bars(words, rows, results.volumes)
            )
            if results.repeats() and not many:
                blocks.append(group_bars(words, rows, results))
    for kind, words in FORM_NAMES.items():
        rows = [r for r in results.results if r.kind == kind]
        if rows:
            blocks.append(error_bars(f"Form deviation, {words}", rows, results.volumes, of_value=True))
    angles = [r for r in results.results if r.unit == "rad" and r.error is not None]
    if angles:
        blocks.append(
            Table(
                title="Angles",
                meaning="",
                columns=["volume", "name", "angle / °", "error / arcsec"],
                numeric=(2, 3),
                rows=[
                    [r.volume, r.name, f"{math.degrees(r.value):.6f}", f"{math.degrees(r.error or 0.0) * 3600:+.1f}"]
                    for r in angles
                ],
            )
        )
    return blocks or [Words(paragraphs=["No measurand has a reference."])]


def _rows(results: MeasurementResults) -> Table:
    def cells(r: MeasurementResult, b: Budget) -> list[str]:
        value = f"{r.value:.5f} mm" if r.unit == "mm" else f"{math.degrees(r.value):.6f} °"
        aside = f"{r.n_set_aside} of {r.n_points}" if r.n_set_aside else "none"
        return [
            r.volume,
            r.name,
            value,
            _shown(r.U, r.unit) if math.isfinite(r.U) else "–",
            "–" if r.error is None else _shown(r.error, r.unit, signed=True),
            "–" if not math.isfinite(b.U_error) else _shown(b.U_error, b.unit),
            "–" if r.limit is None else f"{_shown(r.limit, r.unit)} ({r.limit_rule})",
            "–" if b.decision is None else b.decision.value,
            aside,
            r.direction,
            r.method,
        ]

    return Table(
        title="Rows",
        meaning="U: half width of the 95 % interval from the scatter of the fitted points. It is not the whole "
        "uncertainty: what all scans have in common (attenuation that is not linear, artefacts, the calibration) is "
        "not in it. U of the error holds what else is known, and the reference's own uncertainty. A result conforms "
        "where its whole interval keeps the limit (ISO 14253-1).",
        columns=[
            "volume",
            "name",
            "value",
            f"U ({FIT_ALONE})",
            "error",
            "U of the error",
            "limit",
            "decision",
            "points set aside",
            "direction",
            "method",
        ],
        rows=[cells(r, b) for r, b in zip(results.results, results.budgets(), strict=True)],
        numeric=(2, 3, 4, 5, 6),
        folded=len(results) > MANY,
    )


def _repeats(results: MeasurementResults) -> list[Block]:
    found = [r for r in results.repeats() if r.unit == "mm"]
    if not found:
        return []
    return [
        Table(
            title="Repeats",
            meaning="Groups of volumes that repeat one measurement. U is that of one further scan: Student's factor "
            "times the root of the sum of squares of repeats, reference, drift, workpiece and temperature, plus the "
            "size of the mean error where the reference is calibrated. U of the mean has s / √n in place of s.",
            columns=[
                "group",
                "name",
                "n",
                "mean / mm",
                "s / µm",
                "mean error / µm",
                "U / µm",
                "U of the mean / µm",
                "holds",
            ],
            numeric=(2, 3, 4, 5, 6, 7),
            rows=[
                [
                    r.group,
                    r.name,
                    str(r.n),
                    f"{r.mean:.5f}",
                    micrometres(r.s),
                    "–" if r.error is None else micrometres(r.error, True),
                    micrometres(r.U),
                    micrometres(r.U_mean),
                    r.interval,
                ]
                for r in found
            ],
            folded=len(found) > MANY,
        )
    ]


def _features(results: MeasurementResults) -> Section:
    rows = [
        [
            v,
            name,
            f.kind,
            f.association,
            str(len(f.points)),
            str(f.n_set_aside),
            f"{f.n_effective:.0f}",
            micrometres(f.rms),
            micrometres(f.form),
            micrometres(f.form_95),
        ]
        for v, found in results.features.items()
        for name, f in found.items()
    ]
    return Section(
        title="Features",
        blocks=[
            Table(
                title="Fitted features",
                meaning="Effective points: independent ones that carry the same information; of a feature other than "
                "the least-squares one, those that determine it. Form and D95 are of all points.",
                columns=[
                    "volume",
                    "name",
                    "kind",
                    "reference feature",
                    "points",
                    "set aside",
                    "effective",
                    "rms / µm",
                    "form / µm",
                    "D95 / µm",
                ],
                rows=rows,
                numeric=(4, 5, 6, 7, 8, 9),
                folded=len(rows) > MANY,
            )
        ],
    )


def _notes(results: MeasurementResults) -> list[Block]:
    return [Words(title=volume, items=list(notes) or ["none"]) for volume, notes in results.notes.items()]


def _comparison(name: str, comparison: Comparison, range_mm: float) -> Section:
    limit = range_mm * MICROMETRES_PER_MM
    percentiles = Table(
        title="Percentiles",
        meaning="",
        columns=["share", "deviation / µm"],
        numeric=(1,),
        rows=[[k, micrometres(v, True)] for k, v in comparison.percentiles().items()],
    )
    moved = Words(
        title="Alignment",
        paragraphs=[
            f"Rule: {comparison.alignment.rule}. Part to W: rotation vector "
            f"{_vector(1000 * log_rotation(comparison.alignment.R))} mrad, translation "
            f"{_vector(comparison.alignment.t)} mm. Moved by {micrometres(comparison.moved_mm)} µm and turned by "
            f"{comparison.turned_rad * 1e6:.1f} µrad by the fit. Within ±{limit:g} µm: "
            f"{100 * comparison.share_within(range_mm):.1f} % of {len(comparison.measured)} vertices."
        ],
    )
    figures = deviation_view(comparison, range_mm), deviation_histogram(comparison, range_mm)
    return Section(title=f"Nominal-actual comparison: {name}", blocks=[*figures, percentiles, moved])


def _vector(x: Array) -> str:
    return "(" + ", ".join(f"{v:.4f}" for v in x) + ")"
