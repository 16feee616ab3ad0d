"""The page of a study: printed numbers beside ours, what was to be shown, and the figures; and its figures as PNG."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat

import numpy as np

from tomopose.errors import EngineMissingError
from tomopose.files import atomic_file
from tomopose.provenance import Provenance
from tomopose.report.overlaps import overlaps
from tomopose.report.page import BAD, GOOD, Block, Figure, KeyFigure, Page, Section, Table, Verdict, Words, render
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.words import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = ("quantity", "unit", "printed", "by the paper's method", "by our best", "where, and notes")
ABSENT = "–"
DPI = 150
USUAL_HEIGHT = 420
"""Of a figure on the page, px; a taller one is drawn taller."""
MATPLOTLIB = "pip install matplotlib"


def with_uncertainty(value: SupportsFloat | None, u: SupportsFloat | None) -> str:
    """A value, with its standard uncertainty where there is one."""
    if value is None:
        return ABSENT
    return number(value) if u is None else f"{number(value)} (u {number(u)})"


def study_report(
    *,
    title: str,
    paper: str,
    question: str,
    rows: Sequence[Mapping[str, object]],
    checks: Sequence[Mapping[str, object]],
    figures: Sequence[Figure],
    notes: Sequence[str],
    scale: str,
    seconds: float,
    provenance: Provenance | None = None,
) -> str:
    """One offline HTML document.

    rows:   mappings with group, quantity, unit, source, printed, paper_method, u_paper_method, best, u, note.
    checks: mappings with statement, found, holds.
    """
    held = sum(bool(c["holds"]) for c in checks)
    groups = list(dict.fromkeys(str(r["group"]) for r in rows))
    tables: list[Block] = [_table(group, [r for r in rows if r["group"] == group]) for group in groups]
    statements = Table(
        title="What it shows",
        meaning="Each statement is tested with the numbers of this run.",
        columns=["statement", "found", "holds"],
        rows=[[c["statement"], c["found"], "yes" if c["holds"] else "NO"] for c in checks],
    )
    sections = [
        Section(title="Statements", lead=question, blocks=[statements]),
        Section(title="Figures", blocks=list(figures)),
        Section(
            title="Printed and ours", lead="u is the standard uncertainty that was stated with a number.", blocks=tables
        ),
        Section(title="What differs, and why", blocks=[Words(items=list(notes))]),
        provenance_section(provenance),
    ]
    return render(
        Page(
            title=title,
            subtitle=f"{paper} of the paper; scale {scale}",
            verdict=Verdict(
                word="Shown" if held == len(checks) else "Not all shown",
                sentence=f"{held} of {len(checks)} statements hold.",
                tone=GOOD if held == len(checks) else BAD,
                reasons=[f"{c['statement']}: {c['found']}" for c in checks if not c["holds"]],
            ),
            key_figures=[
                KeyFigure(name="Time of this run", value=f"{seconds:.0f} s", note=f"Scale {scale}, on this machine.")
            ],
            sections=[s for s in sections if s.blocks],
            footer="Written by tomopose.",
        )
    )


def _table(group: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    return Table(
        title=group,
        meaning="",
        columns=COLUMNS,
        numeric=(2, 3, 4),
        rows=[
            [
                r["quantity"],
                r["unit"],
                with_uncertainty(r["printed"], None),
                with_uncertainty(r["paper_method"], r["u_paper_method"]),
                with_uncertainty(r["best"], r["u"]),
                "; ".join(t for t in (r["source"], r["note"]) if t),
            ]
            for r in rows
        ],
    )


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise EngineMissingError(
            f"figures as PNG need matplotlib, which is not installed ({MATPLOTLIB}); page and JSON do without",
            install_line=MATPLOTLIB,
        ) from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


LEGEND_LETTERS = 110
"""Letters of a legend's line under a drawing."""
LEVEL_LETTERS = 90
"""Letters that fit under a drawing side by side; longer rows of names are slanted."""


def _text(value: object) -> str:
    """A title of plotly's: a string or {"text": ...}."""
    return str(value.get("text", "")) if isinstance(value, Mapping) else str(value or "")


def _colours(scale: Sequence[tuple[float, str]] | None) -> Any:
    """A colour map of plotly's as matplotlib's: (place, "rgb(r,g,b)" or "#rrggbb") pairs; None for the default."""
    if scale is None:
        return None
    from matplotlib.colors import LinearSegmentedColormap

    def colour(text: str) -> Any:
        if not text.startswith("rgb("):
            return text
        return tuple(int(part) / 255 for part in text[4:-1].split(","))

    return LinearSegmentedColormap.from_list("scale", [(place, colour(text)) for place, text in scale])


def _decorate(ax: Axes, plan: Mapping[str, Any]) -> None:
    """Embedded pictures, words and shape of a plotly layout."""
    from matplotlib import image

    for place in plan.get("images", ()):
        png = base64.b64decode(str(place["source"]).split(",", 1)[1])
        left, top = place["x"], place["y"]
        ax.imshow(
            image.imread(io.BytesIO(png), format="png"),
            aspect="auto",
            zorder=0,
            interpolation="antialiased",
            extent=(left, left + place["sizex"], top - place["sizey"], top),
        )
    for words in plan.get("annotations", ()):
        text = str(words["text"]).replace("<br>", "\n")
        ax.text(words["x"], words["y"], text, ha="center", va="bottom", fontsize=10)
    for letter in "xy":
        axis = plan.get(f"{letter}axis", {})
        if "range" in axis:
            getattr(ax, f"set_{letter}lim")(axis["range"])
        if axis.get("visible") is False:
            getattr(ax, f"{letter}axis").set_visible(False)
            for side in ("left", "right") if letter == "y" else ("top", "bottom"):
                ax.spines[side].set_visible(False)
    if "scaleanchor" in plan.get("yaxis", {}):
        ax.set_aspect("equal")


def _draw(ax: Axes, trace: Mapping[str, Any], k: int, n: int) -> None:
    """One trace; bars are side by side, this one the k-th of n."""
    kind, name = trace["type"], str(trace.get("name", ""))
    marker, line = trace.get("marker", {}), trace.get("line", {})
    shown: dict[str, Any] = {} if trace.get("showlegend") is False or not name else {"label": name}
    if kind in ("scatter", "scatter3d"):
        lines = "lines" in trace.get("mode", "lines")
        points = [trace["x"], trace["y"], *([trace["z"]] if kind == "scatter3d" else [])]
        ax.plot(
            *points,
            linestyle={"dash": "--", "dot": ":"}.get(line.get("dash", ""), "-") if lines else "none",
            color=(line if lines else marker).get("color"),
            linewidth=min(line.get("width", 1.5), 2.0),
            marker="o" if "markers" in trace.get("mode", "") else "",
            markersize=0.6 * marker.get("size", 6),
            **shown,
        )
    elif kind == "bar":
        x = range(len(trace["x"]))
        ax.bar(
            [i + (k - (n - 1) / 2) * 0.8 / n for i in x], trace["y"], width=0.8 / n, color=marker.get("color"), **shown
        )
        words = [str(t) for t in trace["x"]]
        slanted = max(map(len, words), default=0) * len(words) > LEVEL_LETTERS
        ax.set_xticks(list(x), words, rotation=20 if slanted else 0, ha="right" if slanted else "center")
    elif kind == "heatmap":
        values = np.array([[np.nan if v is None else v for v in line] for line in trace["z"]], dtype=np.float64)
        picture = ax.pcolormesh(
            trace["x"],
            trace["y"],
            values,
            vmin=trace.get("zmin"),
            vmax=trace.get("zmax"),
            shading="nearest",
            cmap=_colours(trace.get("colorscale")),
        )
        if trace.get("showscale", True):
            ax.figure.colorbar(picture, ax=ax, label=_text(trace.get("colorbar", {}).get("title")))
    else:
        raise ValueError(f"a trace of type {kind!r} cannot be drawn")


def _space_marks(ax: Any) -> None:
    """Marks of three axes in space, as many as there is room for: an axis that is short beside the others has few."""
    spans = {letter: abs(float(np.ptp(getattr(ax, f"get_{letter}lim")()))) for letter in "xyz"}
    for letter, span in spans.items():
        room = round(6 * span / max(spans.values()))
        ax.locator_params(axis=letter, nbins=max(1, room))
        if room < 2:
            low, high = sorted(getattr(ax, f"get_{letter}lim")())
            marks = [m for m in getattr(ax, f"get_{letter}ticks")() if low <= m <= high]
            getattr(ax, f"set_{letter}ticks")(sorted({marks[0], marks[-1]}) if marks else [])
        getattr(ax, f"{letter}axis").labelpad = 14


def figure_png(path: str | Path, figure: Figure) -> tuple[str, ...]:
    """A figure as PNG, atomically; scatter, scatter3d, bar and heatmap traces on one pair of axes.

    Returns what overlaps in the drawing, in words (`overlaps`): empty where everything can be read.
    Raises EngineMissingError where matplotlib is not installed.
    """
    plt = _pyplot()
    solid = any(t["type"] == "scatter3d" for t in figure.data)
    equal = "scaleanchor" in figure.layout.get("yaxis", {})
    height = 6.0 if solid else 4.5 * max(figure.height / USUAL_HEIGHT, 1.0)
    fig = plt.figure(figsize=(8, height), layout="constrained")
    try:
        ax = fig.add_subplot(projection="3d" if solid else None)
        bars = [t for t in figure.data if t["type"] == "bar"]
        for trace in figure.data:
            _draw(ax, trace, bars.index(trace) if trace in bars else 0, max(len(bars), 1))
        place = figure.layout.get("scene", {}) if solid else figure.layout
        for letter in "xyz" if solid else "xy":
            axis = place.get(f"{letter}axis", {})
            getattr(ax, f"set_{letter}label")(_text(axis.get("title")).replace("<sub>", "_").replace("</sub>", ""))
            if axis.get("type") == "log":
                getattr(ax, f"set_{letter}scale")("log")
        if not solid:
            _decorate(ax, figure.layout)
        if solid:
            ax.set_aspect("equal")
            _space_marks(ax)
        ax.set_title(figure.title)
        handles, labels = ax.get_legend_handles_labels()
        if labels:  # beside the axes: inside it would hide what is drawn
            side_by_side = LEGEND_LETTERS // (max(map(len, labels)) + 6)  # 6: the sample of the line
            fig.legend(
                handles, labels, loc="outside lower center", ncols=min(len(labels), 4, max(side_by_side, 1)), fontsize=8
            )
        with atomic_file(path) as temporary:
            fig.savefig(temporary, dpi=DPI, format="png", bbox_inches="tight" if equal else None)
        return overlaps(fig)
    finally:
        plt.close(fig)
