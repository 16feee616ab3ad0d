"""The report of a measurement: errors beside their limits (figs. 13 to 16), the comparison in colour (fig. 12)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tomopose.geometry.rotations import log_rotation
from tomopose.measurement.budget import FIT_ALONE, Budget
from tomopose.measurement.mesh.comparison import Comparison
from tomopose.measurement.results import MeasurementResult, MeasurementResults
from tomopose.report.figures.deviation_picture import vik_scale
from tomopose.report.page import (
    BAD,
    CARE,
    GOOD,
    Block,
    Figure,
    KeyFigure,
    Page,
    Section,
    Table,
    Verdict,
    Words,
    render,
)
from tomopose.report.pages.provenance_section import provenance_section
from tomopose.report.style import ACCENT, ALERT, LINE, ORANGE, axis, colour_bar, layout, space_axis
from tomopose.report.words import NOT_DETERMINABLE, number
from tomopose.units import MICROMETRES_PER_MM, Array

COLOURS = (ACCENT, ORANGE, "#2b7d4f", "#8a6bb1", "#b2433f", "#4a4a4a")
MANY = 40
"""Results of one kind from which they are shown by number instead of by name."""
SHOWN_TRIANGLES = 100_000
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
        *_budgets(results),
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


def _um(value: float | None, signed: bool = False) -> str:
    if value is None or not math.isfinite(value):
        return NOT_DETERMINABLE
    return f"{value * MICROMETRES_PER_MM:+.2f}" if signed else f"{value * MICROMETRES_PER_MM:.2f}"


def _verdict(results: MeasurementResults) -> Verdict:
    judged = [r for r in results.results if r.within is not None]
    out = results.out_of_limits
    if not judged:
        return Verdict(word="Measured", sentence="No limits were given, so nothing is judged.", tone=CARE)
    if out:
        worst = [
            f"{r.name} ({r.volume}): {_um(r.error, True)} µm, permitted {_um(r.limit)} µm"
            if r.unit == "mm"
            else f"{r.name} ({r.volume})"
            for r in out[:6]
        ]
        return Verdict(
            word="Out of limits",
            sentence=f"{len(out)} of {len(judged)} results exceed their limit.",
            tone=BAD,
            reasons=worst,
        )
    return Verdict(word="Within limits", sentence=f"All {len(judged)} results with a limit keep it.", tone=GOOD)


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
        KeyFigure(name="Results", value=str(len(results)), note=f"of {len(results.volumes)} volume(s)"),
        KeyFigure(name="Voxel", value=f"{number(spacing)} mm"),
    ]
    if errors.size:
        largest = float(np.abs(errors).max())
        keys += [
            KeyFigure(name="Largest length error", value=f"{_um(largest)} µm", note=f"{largest / spacing:.3f} voxel"),
            KeyFigure(name="Rms of length errors", value=f"{_um(float(np.sqrt(np.mean(errors**2))))} µm"),
        ]
    for name, factor in results.scale.items():
        if factor != 1.0:
            keys.append(KeyFigure(name="Scale correction", value=f"{factor:.7f}", note=name))
    return keys


def _errors(results: MeasurementResults) -> list[Block]:
    blocks: list[Block] = []
    for kind, words in (("distance", "Distances"), ("diameter", "Diameters"), ("position", "Positions")):
        rows = [r for r in results.results if r.kind == kind and r.error is not None]
        if rows:
            many = kind == "distance" and len(rows) > MANY * len(results.volumes)
            blocks.append(_by_length(words, rows, results.volumes) if many else _bars(words, rows, results.volumes))
            if results.repeats() and not many:
                blocks.append(_groups(words, rows, results))
    for kind, words in FORM_NAMES.items():
        rows = [r for r in results.results if r.kind == kind]
        if rows:
            blocks.append(_bars(f"Form deviation, {words}", rows, results.volumes, of_value=True))
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


def _bars(words: str, rows: Sequence[MeasurementResult], volumes: Sequence[str], *, of_value: bool = False) -> Figure:
    data: list[dict[str, Any]] = []
    for k, volume in enumerate(volumes):
        mine = [r for r in rows if r.volume == volume]
        bars = [r.U if math.isfinite(r.U) else 0.0 for r in mine]
        data.append(
            {
                "type": "bar",
                "name": volume,
                "x": [r.name for r in mine],
                "y": [(r.value if of_value else r.error or 0.0) * MICROMETRES_PER_MM for r in mine],
                "marker": {"color": COLOURS[k % len(COLOURS)]},
                "error_y": {
                    "type": "data",
                    "array": [b * MICROMETRES_PER_MM for b in bars],
                    "visible": any(bars),
                    "thickness": 1.2,
                },
                "hovertemplate": "%{x}<br>%{y:.3f} µm<extra></extra>",
            }
        )
    limits = {r.name: r.limit for r in rows if r.limit is not None}
    for sign in (1, -1) if limits and not of_value else ():
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": "limit",
                "showlegend": sign > 0,
                "x": list(limits),
                "y": [sign * float(v) * MICROMETRES_PER_MM for v in limits.values()],
                "line": {"color": ALERT, "dash": "dash", "width": 1},
                "marker": {"size": 4, "color": ALERT},
                "hovertemplate": "limit %{y:.2f} µm<extra></extra>",
            }
        )
    return Figure(
        title=words,
        meaning="Value in micrometres." if of_value else "Error in micrometres, with the 95 % interval of the fit.",
        look_for="Form grows with noise and with the number of points; compare only what was measured alike."
        if of_value
        else "Errors should be even in sign and stay inside the dashed limits.",
        data=data,
        layout=layout(xaxis=axis("", type="category"), yaxis=axis("µm"), barmode="group"),
        height=380,
    )


def _groups(words: str, rows: Sequence[MeasurementResult], results: MeasurementResults) -> Figure:
    """Mean errors of the groups of repeats and of the volumes that stand alone, side by side (figs. 13 to 16)."""
    names = list(dict.fromkeys(r.name for r in rows))
    data: list[dict[str, Any]] = []
    bars: dict[str, dict[str, tuple[float, float]]] = {}
    for repeat in results.repeats():
        if repeat.name in names and repeat.error is not None:
            bars.setdefault(repeat.group, {})[repeat.name] = (repeat.error, repeat.s)
    grouped = {v for group in results.groups.values() for v in group}
    for r in rows:
        if r.volume not in grouped and r.error is not None:
            bars.setdefault(r.volume, {})[r.name] = (r.error, math.nan)
    for k, (group, found) in enumerate(bars.items()):
        spread = [0.0 if not math.isfinite(s) else s * MICROMETRES_PER_MM for _, s in found.values()]
        data.append(
            {
                "type": "bar",
                "name": group,
                "x": list(found),
                "y": [e * MICROMETRES_PER_MM for e, _ in found.values()],
                "marker": {"color": COLOURS[k % len(COLOURS)]},
                "error_y": {"type": "data", "array": spread, "visible": any(spread), "thickness": 1.2},
                "hovertemplate": "%{x}<br>%{y:.3f} µm<extra></extra>",
            }
        )
    return Figure(
        title=f"{words}: groups side by side",
        meaning="Mean error of each group of repeats, with the standard deviation of one; volumes in no group alone.",
        look_for="Groups that differ by more than their repeats scatter differ for a reason.",
        data=data,
        layout=layout(xaxis=axis("", type="category"), yaxis=axis("µm"), barmode="group"),
        height=380,
    )


def _by_length(words: str, rows: Sequence[MeasurementResult], volumes: Sequence[str]) -> Figure:
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": volume,
            "marker": {"size": 5, "color": COLOURS[k % len(COLOURS)]},
            "x": [r.reference for r in rows if r.volume == volume],
            "y": [(r.error or 0.0) * MICROMETRES_PER_MM for r in rows if r.volume == volume],
            "text": [r.name for r in rows if r.volume == volume],
            "hovertemplate": "%{text}<br>%{x:.3f} mm<br>%{y:.3f} µm<extra></extra>",
        }
        for k, volume in enumerate(volumes)
    ]
    limited = sorted(((r.reference or 0.0), r.limit) for r in rows if r.limit is not None)
    for sign in (1, -1) if limited else ():
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": "MPE",
                "showlegend": sign > 0,
                "x": [x for x, _ in limited],
                "y": [sign * y * MICROMETRES_PER_MM for _, y in limited],
                "line": {"color": ALERT, "dash": "dash", "width": 1.4},
                "hoverinfo": "skip",
            }
        )
    return Figure(
        title=words,
        meaning="Error of each distance by its calibrated length.",
        look_for="A line through zero is a scale error; points outside the dashed lines exceed the permissible error.",
        data=data,
        layout=layout(xaxis=axis("length / mm"), yaxis=axis("error / µm")),
        height=420,
    )


def _rows(results: MeasurementResults) -> Table:
    def cells(r: MeasurementResult) -> list[str]:
        if r.unit == "mm":
            shown = [
                f"{r.value:.5f} mm",
                _um(r.U) if math.isfinite(r.U) else "–",
                "–" if r.error is None else _um(r.error, True),
                "–" if r.limit is None else _um(r.limit),
            ]
        else:
            shown = [
                f"{math.degrees(r.value):.6f} °",
                "–",
                "–" if r.error is None else f"{math.degrees(r.error) * 3600:+.1f} arcsec",
                "–",
            ]
        kept = {True: "yes", False: "no", None: "–"}[r.within]
        return [r.volume, r.name, *shown, kept, r.direction, r.method]

    return Table(
        title="Rows",
        meaning="U: half width of the 95 % interval from the scatter of the fitted points. It is not the whole "
        "uncertainty: what all scans have in common (attenuation that is not linear, artefacts, the calibration) is "
        "not in it.",
        columns=[
            "volume",
            "name",
            "value",
            f"U / µm ({FIT_ALONE})",
            "error / µm",
            "limit / µm",
            "within",
            "direction",
            "method",
        ],
        rows=[cells(r) for r in results.results],
        numeric=(2, 3, 4, 5),
        folded=len(results) > MANY,
    )


def _repeats(results: MeasurementResults) -> list[Block]:
    found = [r for r in results.repeats() if r.unit == "mm"]
    if not found:
        return []
    return [
        Table(
            title="Repeats",
            meaning="Groups of volumes that repeat one measurement: U = 2 √(u_cal² + s²) + |mean error|.",
            columns=["group", "name", "n", "mean / mm", "s / µm", "mean error / µm", "U / µm", "holds"],
            numeric=(2, 3, 4, 5, 6),
            rows=[
                [
                    r.group,
                    r.name,
                    str(r.n),
                    f"{r.mean:.5f}",
                    _um(r.s),
                    "–" if r.error is None else _um(r.error, True),
                    _um(r.U),
                    r.interval,
                ]
                for r in found
            ],
            folded=len(found) > MANY,
        )
    ]


def _budgets(results: MeasurementResults) -> list[Section]:
    """Where the uncertainty comes from, where more than the fit is known."""
    found = [b for b in results.budgets() if b.unit == "mm"]
    if not any((b.repeats, b.calibration, b.simulation) != (None, None, None) for b in found):
        return []

    def cells(b: Budget) -> list[str]:
        shares = [
            "–" if u is None or not math.isfinite(u) else _um(u)
            for u in (b.fit, b.repeats, b.calibration, b.simulation)
        ]
        corrected = ["–", "–"] if b.mean_error is None else [_um(b.mean_error, True), f"{b.corrected:.5f}"]
        return [
            b.volume,
            b.name,
            f"{b.value:.5f}",
            *shares,
            *corrected,
            _um(b.U) if math.isfinite(b.U) else "–",
            b.interval,
        ]

    return [
        Section(
            title="Uncertainty",
            lead="Standard uncertainties, each by itself, and the 95 % interval of all together.",
            blocks=[
                Table(
                    title="Shares",
                    meaning="Fit and repeats show the same scatter, the larger counts; the calibration's share is "
                    "added in squares. Virtual scans hold noise and systematic part, and stand for all: their mean "
                    "error is taken off the value, and U is that of one more scan like them.",
                    columns=[
                        "volume",
                        "name",
                        "measured / mm",
                        "fit / µm",
                        "repeats / µm",
                        "calibration / µm",
                        "simulation / µm",
                        "its mean error / µm",
                        "corrected by simulation / mm",
                        "U / µm",
                        "holds",
                    ],
                    numeric=tuple(range(2, 10)),
                    rows=[cells(b) for b in found],
                    folded=len(found) > MANY,
                )
            ],
        )
    ]


def _features(results: MeasurementResults) -> Section:
    rows = [
        [v, name, f.kind, str(f.n_used), f"{f.n_effective:.0f}", _um(f.rms), _um(f.form), _um(f.form_95)]
        for v, found in results.features.items()
        for name, f in found.items()
    ]
    return Section(
        title="Features",
        blocks=[
            Table(
                title="Fitted features",
                meaning="Effective points: independent ones that carry the same information.",
                columns=["volume", "name", "kind", "points", "effective", "rms / µm", "range / µm", "D95 / µm"],
                rows=rows,
                numeric=(3, 4, 5, 6, 7),
                folded=len(rows) > MANY,
            )
        ],
    )


def _notes(results: MeasurementResults) -> list[Block]:
    return [Words(title=volume, items=list(notes) or ["none"]) for volume, notes in results.notes.items()]


def _comparison(name: str, comparison: Comparison, range_mm: float) -> Section:
    limit = range_mm * MICROMETRES_PER_MM
    count, centre = comparison.histogram(range_mm)
    step = max(len(comparison.mesh.faces) // SHOWN_TRIANGLES, 1)
    faces = comparison.mesh.faces[::step]
    deviation = comparison.deviation * MICROMETRES_PER_MM
    x = comparison.points
    view = Figure(
        title="Deviations in colour",
        meaning=f"Measured surface minus reference at the reference's vertices, clipped at ±{limit:g} µm.",
        look_for="Waves along the circumference follow the trajectory; one colour on a side is size or alignment.",
        data=[
            {
                "type": "mesh3d",
                "x": np.round(x[:, 0], 4),
                "y": np.round(x[:, 1], 4),
                "z": np.round(x[:, 2], 4),
                "i": faces[:, 0],
                "j": faces[:, 1],
                "k": faces[:, 2],
                "intensity": [None if not math.isfinite(d) else round(float(d), 2) for d in deviation],
                "cmin": -limit,
                "cmax": limit,
                "colorscale": vik_scale(),
                "colorbar": colour_bar("µm"),
                "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
                "hovertemplate": "%{intensity} µm<extra></extra>",
            }
        ],
        layout=layout(
            scene={
                "aspectmode": "data",
                "xaxis": space_axis("x / mm"),
                "yaxis": space_axis("y / mm"),
                "zaxis": space_axis("z / mm"),
            },
            margin={"l": 0, "r": 0, "t": 0, "b": 0},
        ),
        height=560,
    )
    histogram = Figure(
        title="Histogram",
        meaning="Vertices by deviation; the outermost bars hold what lies beyond.",
        look_for="One narrow peak at zero.",
        data=[
            {
                "type": "bar",
                "x": centre * MICROMETRES_PER_MM,
                "y": count,
                "marker": {"color": ACCENT, "line": {"color": LINE, "width": 0}},
                "hovertemplate": "%{x:.2f} µm: %{y}<extra></extra>",
            }
        ],
        layout=layout(xaxis=axis("deviation / µm"), yaxis=axis("vertices"), bargap=0, showlegend=False),
        height=320,
    )
    percentiles = Table(
        title="Percentiles",
        meaning="",
        columns=["share", "deviation / µm"],
        numeric=(1,),
        rows=[[k, _um(v, True)] for k, v in comparison.percentiles().items()],
    )
    moved = Words(
        title="Alignment",
        paragraphs=[
            f"Rule: {comparison.alignment.rule}. Part to W: rotation vector "
            f"{_vector(1000 * log_rotation(comparison.alignment.R))} mrad, translation "
            f"{_vector(comparison.alignment.t)} mm. Moved by {_um(comparison.moved_mm)} µm and turned by "
            f"{comparison.turned_rad * 1e6:.1f} µrad by the fit. Within ±{limit:g} µm: "
            f"{100 * comparison.share_within(range_mm):.1f} % of {len(comparison.measured)} vertices."
        ],
    )
    return Section(title=f"Nominal-actual comparison: {name}", blocks=[view, histogram, percentiles, moved])


def _vector(x: Array) -> str:
    return "(" + ", ".join(f"{v:.4f}" for v in x) + ")"
