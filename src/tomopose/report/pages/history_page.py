"""Calibrations of one machine over time: what changed between two, and the control charts of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tomopose.calibration.records.charts import FEWEST_RUNS, ControlChart, control_chart
from tomopose.calibration.records.compare import Comparison
from tomopose.calibration.records.history import Entry
from tomopose.calibration.records.monitor import Monitoring, monitor
from tomopose.coverage import K2, expanded_k2
from tomopose.errors import InputError
from tomopose.provenance import Provenance
from tomopose.report.page import CARE, GOOD, Block, Figure, Page, Section, Table, Verdict, render
from tomopose.report.sections.checks import probability
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.style import ACCENT, ALERT, LINE, SOFT, axis, layout
from tomopose.report.words import meaning, number, small_unit, symbol
from tomopose.units import MICROMETRES_PER_MM, MICRORADIANS_PER_RAD

CHARTED = ("d_rms_px", "t_HT_x", "t_HT_y", "t_HT_z", "phi_HT_x", "phi_HT_y", "phi_HT_z")
SCALES: Mapping[str, tuple[float, str]] = {
    "mm": (MICROMETRES_PER_MM, "µm"),
    "rad": (MICRORADIANS_PER_RAD, "µrad"),
    "px": (1.0, "px"),
}


COMPARED_UNITS = {"w": "rad", "t": "mm"}


def compared_rows(comparison: Comparison) -> list[list[str]]:
    """One row a coordinate: name, meaning, change with u, U, ratio and probability."""
    columns = (comparison.names, comparison.difference, comparison.u, comparison.z, comparison.p)
    rows = []
    for name, d, u, z, p in zip(*columns, strict=True):
        unit = COMPARED_UNITS.get(name.split("_")[0].split("[")[0], "")
        chance = "–" if np.isnan(p) else probability(p)
        change = [signed(d, unit), small_unit(u, unit), small_unit(expanded_k2(u), unit), f"{z:+.2f}", chance]
        rows.append([name, meaning(name), *change])
    return rows


def compared_figure(comparison: Comparison) -> Figure:
    """Each change in units of its standard uncertainty."""
    line = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "line": {"color": SOFT, "dash": "dash", "width": 1}}
    return Figure(
        title="Changes in units of their standard uncertainty",
        meaning="Each change divided by its standard uncertainty; the dashed lines are ±2.",
        look_for="Most bars should end between the lines; t_HT and t may leave them together, and cancel in the scan.",
        data=[
            {
                "type": "bar",
                "x": [symbol(n) for n in comparison.names],
                "y": comparison.z,
                "marker": {"color": ACCENT},
                "hovertemplate": "%{x}: %{y:.2f}<extra></extra>",
            }
        ],
        layout=layout(
            xaxis=axis(type="category"),
            yaxis=axis("change / u"),
            bargap=0.5,
            shapes=[{**line, "y0": y, "y1": y} for y in (-K2, K2)],
        ),
        height=330,
    )


def comparison_report(
    comparison: Comparison,
    *,
    labels: tuple[str, str] = ("A", "B"),
    provenance: Provenance | None = None,
    title: str = "Two calibrations compared",
) -> str:
    """One offline HTML document about the change from one calibration to another: the questions of the paper's table 2.

    labels: names of the two calibrations.
    """
    table = Table(
        title="Changes",
        meaning=f"{labels[1]} minus {labels[0]}, the two taken as independent.",
        columns=["coordinate", "what it is", "change", "u", "U (k = 2)", "change / u", "probability by chance"],
        rows=compared_rows(comparison),
        numeric=(2, 3, 4, 5, 6),
    )
    verdict = Verdict(
        word="Changed" if comparison.changed else "Unchanged",
        tone=CARE if comparison.changed else GOOD,
        sentence=(
            "The two calibrations assume different scanners, so their mounts cannot be compared."
            if comparison.scanner
            else f"Probability of a change of the mount this large by chance: {probability(comparison.p_mount)}."
        ),
        reasons=comparison.words,
    )
    return render(
        Page(
            title=title,
            subtitle=f"{labels[0]} → {labels[1]}",
            verdict=verdict,
            sections=[
                Section(title="What changed", blocks=[table, compared_figure(comparison)]),
                provenance_section(provenance),
            ],
            footer="Written by tomopose.",
        )
    )


def signed(value: float, unit: str) -> str:
    """A change with its sign, in µm or µrad where its unit is mm or rad."""
    factor, name = SCALES.get(unit, (1.0, unit))
    return f"{'−' if value < 0 else '+'}{number(abs(value) * factor)} {name}".rstrip()


def history_section(entries: Sequence[Entry], alarmed: Sequence[str] = ()) -> Section | None:
    """Control charts of the mount, the residual and what raised an alarm; None with fewer than three entries."""
    if len(entries) < FEWEST_RUNS:
        return None
    charts = []
    for name in dict.fromkeys((*CHARTED, *alarmed)):
        try:
            charts.append(control_chart(entries, name))
        except InputError:  # a parameter that too few entries hold
            continue
    blocks: list[Block] = [chart_figure(chart) for chart in charts]
    return Section(title="Over time", lead=f"{len(entries)} calibrations of this machine, oldest first.", blocks=blocks)


def chart_figure(chart: ControlChart) -> Figure:
    """One number over the history with its limits.  mm and rad are shown as departure from the centre line."""
    factor, unit = SCALES.get(chart.unit, (1.0, chart.unit))
    base = 0.0 if chart.unit == "px" else chart.centre
    x = list(chart.time)
    y = factor * (chart.value - base)
    beyond = int(np.sum(chart.out))
    trend = f"trend by chance: {probability(chart.trend_p)}"
    lines = [
        {
            "type": "scatter",
            "mode": "lines",
            "x": x,
            "y": factor * (limit - base),
            "showlegend": False,
            "line": {"color": SOFT, "width": 1, "dash": "dash", "shape": "hvh"},
            "hoverinfo": "skip",
        }
        for limit in (chart.low, chart.high)
    ]
    bars = (
        None
        if chart.name == "d_rms_px"
        else {
            "type": "data",
            "array": K2 * factor * chart.u,
            "thickness": 1.2,
            "width": 3,
            "color": ACCENT,
        }
    )
    points: dict[str, Any] = {
        "type": "scatter",
        "mode": "lines+markers",
        "x": x,
        "y": y,
        "showlegend": False,
        "line": {"color": LINE, "width": 1.2},
        "marker": {"size": 7, "color": [ALERT if out else ACCENT for out in chart.out]},
        "hovertemplate": f"%{{x}}<br>%{{y:.4g}} {unit}<extra></extra>",
    }
    if bars is not None:
        points["error_y"] = bars
    words = meaning(chart.name).replace(", R = R_x R_y R_z", "") or "reprojection error"
    departure = "" if chart.unit == "px" else ", departure from the centre line"
    return Figure(
        title=words[:1].upper() + words[1:],
        meaning=f"{chart.name}{departure}; dashed: limits of three standard deviations; {beyond} beyond; {trend}.",
        look_for="A red point or a trend means that something moved or wears.",
        data=[*lines, points],
        layout=layout(xaxis=axis(type="date", nticks=6), yaxis=axis(f"{chart.name.removesuffix('_px')} / {unit}")),
        height=300,
        wide=False,
    )


def history_verdict(found: Monitoring) -> Verdict:
    """The answer of the rules as the page's verdict."""
    return Verdict(
        word="Alarm" if found.alarms else "No alarm",
        tone=CARE if found.alarms else GOOD,
        sentence=found.words[0][:1].upper() + found.words[0][1:] + ".",
        reasons=(*found.words[1:], *found.notes),
    )


def history_report(
    entries: Sequence[Entry],
    *,
    title: str = "Calibrations over time",
    baseline: str | None = None,
    provenance: Provenance | None = None,
) -> str:
    """One offline HTML document with the answer of the rules and control charts.

    entries: of a history file, oldest first (`tomopose.calibration.records.history.read_history`);  baseline: the runs
    that define the normal state, as in `tomopose.calibration.records.monitor.monitor`.
    InputError with fewer than three.
    """
    found = monitor(entries, baseline=baseline)
    section = history_section(entries, [a.parameter for a in found.alarms])
    if section is None:
        raise InputError(f"the history holds {len(entries)} calibrations; control charts need {FEWEST_RUNS}")
    table = Table(
        title="Entries",
        meaning="",
        columns=["time (UTC)", "label", "verdict", "model", "poses", "d_rms / px", "χ²/dof"],
        rows=[
            [
                e["time_utc"],
                e.get("label") or "–",
                e["verdict"],
                e["model"],
                e["n_poses"],
                number(e["d_rms_px"]),
                number(e["chi2_dof"]),
            ]
            for e in entries
        ],
        numeric=(4, 5, 6),
    )
    return render(
        Page(
            title=title,
            subtitle=f"{len(entries)} calibrations, {entries[0]['time_utc']} to {entries[-1]['time_utc']}",
            verdict=history_verdict(found),
            sections=[section, Section(title="All entries", blocks=[table]), provenance_section(provenance)],
            footer="Written by tomopose. Bars are expanded uncertainties, k = 2.",
        )
    )
