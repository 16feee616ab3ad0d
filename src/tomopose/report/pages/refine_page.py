"""The report of a refinement: corrections, residuals before and after, slices side by side, what is not observable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tomopose.provenance import Provenance
from tomopose.report.figures.png import data_uri, grey_levels, grey_png
from tomopose.report.page import Block, Figure, KeyFigure, Page, Section, Words, render
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.style import axis, layout
from tomopose.volume import Volume

AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class RefinedViews:
    """columns: as `Refinement.columns`; verdict, reasons, unobservable: in words; gain: of held-out pixels, standard
    errors; halves_px, stated_px: uncertainty of a view by two halves of the views refined apart, and as stated;
    edge_blur_mm: standard deviation of the edges in both volumes, NaN where none can be measured; before, after:
    volumes under both geometries."""

    columns: Mapping[str, Sequence[object] | np.ndarray]
    verdict: str
    reasons: tuple[str, ...]
    unobservable: tuple[str, ...]
    gain: float
    halves_px: float
    stated_px: float
    edge_blur_mm: tuple[float, float]
    before: Volume | None
    after: Volume | None
    provenance: Provenance | None


def refinement_report(views: RefinedViews, *, title: str = "Refinement report") -> str:
    """One offline HTML document about a refinement."""
    c = {name: np.asarray(column, dtype=np.float64) for name, column in views.columns.items()}
    before, after = float(np.median(c["residual_before"])), float(np.median(c["residual_after"]))
    slices: list[Block] = [
        _slice(volume, name)
        for name, volume in (("input", views.before), ("refined", views.after))
        if volume is not None
    ]
    return render(
        Page(
            title=title,
            subtitle=f"{len(c['residual_before'])} views",
            key_figures=[
                KeyFigure(
                    name="Correction", value=views.verdict, note="Applied only where held-out pixels fit better."
                ),
                KeyFigure(
                    name="Gain of held-out pixels",
                    note="In standard errors; above 3 it is more than chance.",
                    value=f"{views.gain:.1f}",
                ),
                KeyFigure(
                    name="Uncertainty of a view",
                    note="px a coordinate: stated, and by two halves of the views refined apart; they should agree.",
                    value=f"{views.stated_px:.3g}, {views.halves_px:.3g}",
                ),
                KeyFigure(
                    name="Residual of a view",
                    note="Median, before and after; the second should be smaller.",
                    value=f"{before:.3g}, {after:.3g}",
                ),
                _blur(views.edge_blur_mm),
            ],
            sections=[
                Section(title="Result", blocks=[Words(title="Why", items=views.reasons)]),
                Section(
                    title="Corrections",
                    lead="Motion of the object in each view, about the middle of the grid, in W.",
                    blocks=[_motions(c, "t", "mm", "shift"), _motions(c, "w", "deg", "turn"), _residuals(c)],
                ),
                Section(title="Slices", lead="Middle slices with the input's and the refined geometry.", blocks=slices),
                Section(
                    title="What the images cannot show",
                    blocks=[Words(title="Not observable", items=views.unobservable)],
                ),
                provenance_section(views.provenance),
            ],
            footer="Written by tomopose.",
        )
    )


def _blur(blurs: tuple[float, float]) -> KeyFigure:
    """The blur of the edges before and after, and how much of it was the geometry's."""
    before, after = blurs
    if not np.isfinite(blurs).all():
        note = "No edge could be measured in both volumes."
    elif before > after:
        note = (
            f"Standard deviation before and after: {np.sqrt(before**2 - after**2):.3g} mm were the views' errors. "
            "Voxels and smoothing of the comparison are in both."
        )
    else:
        note = "Standard deviation before and after; no edge became sharper."
    return KeyFigure(name="Blur of the edges, mm", value=", ".join(f"{b:.3g}" for b in blurs), note=note)


def _motions(c: Mapping[str, np.ndarray], kind: str, unit: str, name: str) -> Figure:
    """Three coordinates of the corrections, with their standard uncertainties as bars."""
    data = []
    for k in AXES:
        y = c[f"{kind}_{k}_{unit}"]
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": k,
                "x": np.arange(1, len(y) + 1),
                "y": y,
                "error_y": {"type": "data", "array": c[f"sigma_{kind}_{k}_{unit}"], "thickness": 0.7, "width": 0},
                "marker": {"size": 3},
                "line": {"width": 1},
            }
        )
    return Figure(
        title=f"Correction of each view: {name}",
        meaning=f"Components in {unit}; bars are standard uncertainties, the volume unknown.",
        look_for="A smooth curve is an error of the manipulator or the table; single peaks are jumps.",
        data=data,
        layout=layout(xaxis=axis("view"), yaxis=axis(f"{name} / {unit}")),
        height=320,
    )


def _residuals(c: Mapping[str, np.ndarray]) -> Figure:
    """Residual of each view before and after."""
    data = [
        {"type": "scatter", "mode": "lines", "name": name, "x": np.arange(1, len(c[key]) + 1), "y": c[key]}
        for name, key in (("before", "residual_before"), ("after", "residual_after"))
    ]
    return Figure(
        title="Residual of each view",
        meaning="Rms of measured minus projected line integrals, relative to the view's own.",
        look_for="After should lie below before; a view that stays above the others fits nowhere.",
        data=data,
        layout=layout(xaxis=axis("view"), yaxis=axis("residual", rangemode="tozero")),
        height=320,
    )


def _slice(volume: Volume, name: str) -> Figure:
    """The slice normal to z through the middle."""
    image = volume.slices()[0]
    n_v, n_u = image.shape
    place = {
        "source": data_uri(grey_png(np.ascontiguousarray(grey_levels(image)[::-1]))),
        "xref": "x", "yref": "y", "x": 0, "y": n_v, "sizex": n_u, "sizey": n_v, "sizing": "stretch", "layer": "below",
    }  # fmt: skip
    bare = {"showgrid": False, "zeroline": False}
    corners = {
        "type": "scatter", "x": [0, n_u], "y": [0, n_v], "mode": "markers", "marker": {"opacity": 0},
        "hoverinfo": "skip", "showlegend": False,
    }  # fmt: skip
    return Figure(
        title=f"Slice normal to z, {name} geometry",
        meaning="Grey values of the volume at the resolution of the comparison.",
        look_for="Edges of the refined slice should be sharper, never doubled.",
        data=[corners],
        layout=layout(
            images=[place],
            xaxis=axis("x / voxel", range=[0, n_u], constrain="domain", **bare),
            yaxis=axis("y / voxel", range=[0, n_v], scaleanchor="x", constrain="domain", **bare),
        ),
        wide=False,
        height=380,
    )
