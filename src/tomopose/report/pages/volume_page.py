"""The report of a reconstruction: slices, maximum projection, and how each view agrees with the volume."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.report.figures.png import data_uri, grey_levels, grey_png
from tomopose.report.page import Block, Figure, KeyFigure, Page, Section, Table, Words, render
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.style import ACCENT, axis, layout
from tomopose.report.words import cell
from tomopose.volume import Volume

LARGEST_PICTURE = 512
"""Longest side of an embedded picture, px; larger slices are thinned."""

VIEWS = (("z", "x", "y"), ("y", "x", "z"), ("x", "y", "z"))
"""Normal of each middle slice, and its horizontal and vertical axis."""


def volume_pictures(volume: Volume) -> dict[str, bytes]:
    """PNGs by name: the three middle slices and the maximum projection along y, the second axis upwards."""
    images = dict(zip(("slice_z", "slice_y", "slice_x"), volume.slices(), strict=True))
    images["maximum"] = volume.maximum_projection()
    return {name: grey_png(np.ascontiguousarray(grey_levels(image)[::-1])) for name, image in images.items()}


def volume_report(volume: Volume, *, title: str = "Reconstruction report") -> str:
    """One offline HTML document about a volume."""
    blocks: list[Block] = [_slice(volume, image, *names) for image, names in zip(volume.slices(), VIEWS, strict=True)]
    blocks.append(
        _picture(
            volume,
            volume.maximum_projection(),
            "x",
            "z",
            title="Maximum along y",
            meaning="The largest value met along y.",
            look_for="Doubled edges are a wrong geometry; streaks, dense parts.",
        )
    )
    n_x, n_y, n_z = volume.grid.n_xyz
    agreement: list[Block] = [] if volume.view_residual is None else [_residuals(volume.view_residual)]
    notes = Words(title="Notes", items=volume.notes or ("There is nothing to note.",))
    settings = Table(
        title="Settings",
        meaning="",
        columns=["setting", "value"],
        rows=[[name, cell(value)] for name, value in volume.settings.items()],
    )
    residual = volume.view_residual
    return render(
        Page(
            title=title,
            subtitle=f"{n_x} × {n_y} × {n_z} voxels of {' × '.join(f'{s:g}' for s in volume.grid.spacing)} mm, frame W",
            key_figures=[
                KeyFigure(
                    name="Voxels", value=f"{n_x * n_y * n_z / 1e6:.1f} million", note="Of the whole grid, air included."
                ),
                KeyFigure(
                    name="Largest value",
                    value=f"{float(volume.values.max()):.4g} / mm",
                    note="Attenuation: compare it with the material's; far above it lie streaks.",
                ),
                KeyFigure(
                    name="Residual of a view",
                    note="Median of the reprojection; one view far above the others has a wrong matrix.",
                    value="not determinable" if residual is None else f"{float(np.median(residual)):.3g}",
                ),
            ],
            sections=[
                Section(title="The volume", lead="Middle slices; the object is as at home.", blocks=blocks),
                Section(
                    title="Agreement of the views",
                    lead="How well the volume explains each radiograph.",
                    blocks=[*agreement, notes],
                ),
                Section(title="How it was made", blocks=[settings]),
                provenance_section(volume.provenance),
            ],
            footer="Written by tomopose.",
        )
    )


def _slice(volume: Volume, image: np.ndarray, normal: str, across: str, up: str) -> Figure:
    return _picture(
        volume,
        image,
        across,
        up,
        title=f"Slice through the middle, normal to {normal}",
        meaning=f"Grey values in the plane of {across} and {up}.",
        look_for="Doubled or smeared edges are a wrong geometry; cupping is beam hardening.",
    )


def _picture(volume: Volume, image: np.ndarray, across: str, up: str, **words: str) -> Figure:
    """A slice as a picture on axes in mm, the second axis upwards."""
    step = max(1, -(-max(image.shape) // LARGEST_PICTURE))
    png = grey_png(np.ascontiguousarray(grey_levels(image[::step, ::step])[::-1]))
    (a_0, a_1), (u_0, u_1) = (_extent(volume, name) for name in (across, up))
    place: dict[str, Any] = {
        "source": data_uri(png),
        "xref": "x",
        "yref": "y",
        "x": a_0,
        "y": u_1,
        "sizex": a_1 - a_0,
        "sizey": u_1 - u_0,
        "sizing": "stretch",
        "layer": "below",
    }
    bare = {"showgrid": False, "zeroline": False}  # lines would lie over the picture
    return Figure(
        data=[
            {
                "type": "scatter",
                "x": [a_0, a_1],
                "y": [u_0, u_1],
                "mode": "markers",
                "marker": {"opacity": 0},
                "hoverinfo": "skip",
                "showlegend": False,
            }
        ],
        layout=layout(
            images=[place],
            xaxis=axis(f"{across} / mm", range=[a_0, a_1], constrain="domain", **bare),
            yaxis=axis(f"{up} / mm", range=[u_0, u_1], scaleanchor="x", constrain="domain", **bare),
        ),
        wide=False,
        height=420,
        **words,  # type: ignore[arg-type]
    )


def _extent(volume: Volume, name: str) -> tuple[float, float]:
    """Outer faces of the grid along an axis, mm."""
    k = "xyz".index(name)
    half = 0.5 * volume.grid.spacing[k]
    first = volume.grid.origin[k]
    return float(first - half), float(first + (volume.grid.n_xyz[k] - 1) * volume.grid.spacing[k] + half)


def _residuals(residual: np.ndarray) -> Figure:
    return Figure(
        title="Residual by view",
        meaning="Rms of measured minus reprojected line integrals, relative to the view's own.",
        look_for="Single views far above the others have a wrong pose or a bad image; a period is a trajectory error.",
        data=[
            {
                "type": "scatter",
                "mode": "lines",
                "x": np.arange(1, len(residual) + 1),
                "y": residual,
                "line": {"color": ACCENT, "width": 1.5},
            }
        ],
        layout=layout(xaxis=axis("view"), yaxis=axis("residual", rangemode="tozero")),
        height=320,
    )
