"""The figures of a measurement: errors beside their limits (figs. 13 to 16), the comparison in colour (fig. 12)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tomopose.measurement.mesh.comparison import Comparison
from tomopose.measurement.result import MeasurementResult
from tomopose.measurement.results import MeasurementResults
from tomopose.report.figures.deviation_picture import vik_scale
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, ALERT, LINE, ORANGE, axis, colour_bar, layout, space_axis
from tomopose.units import MICROMETRES_PER_MM

COLOURS = (ACCENT, ORANGE, "#2b7d4f", "#8a6bb1", "#b2433f", "#4a4a4a")
SHOWN_TRIANGLES = 100_000


def error_bars(
    words: str, rows: Sequence[MeasurementResult], volumes: Sequence[str], *, of_value: bool = False
) -> Figure:
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


def group_bars(words: str, rows: Sequence[MeasurementResult], results: MeasurementResults) -> Figure:
    """Mean errors of the groups of repeats and of the volumes that are single, side by side (figs. 13 to 16)."""
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


def errors_by_length(words: str, rows: Sequence[MeasurementResult], volumes: Sequence[str]) -> Figure:
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


def deviation_view(comparison: Comparison, range_mm: float) -> Figure:
    """Deviations from a reference in colour, clipped at +-range_mm."""
    limit = range_mm * MICROMETRES_PER_MM
    step = max(len(comparison.mesh.faces) // SHOWN_TRIANGLES, 1)
    faces = comparison.mesh.faces[::step]
    deviation = comparison.deviation * MICROMETRES_PER_MM
    x = comparison.points
    return Figure(
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


def deviation_histogram(comparison: Comparison, range_mm: float) -> Figure:
    """Vertices by deviation."""
    count, centre = comparison.histogram(range_mm)
    return Figure(
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
