"""Pictures of figs. 11 to 16: slices, deviations in colour, lengths, and what was measured of the balls."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.measurement.mesh.mesh import Mesh
from tomopose.report.figures.deviation_picture import deviation_figure, vik_scale
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, ALERT, ORANGE, SOFT, axis, colour_bar, layout
from tomopose.simulation.objects.specimen import FLANGE_LENGTH, LENGTH
from tomopose.studies.section6.scan import Numbers
from tomopose.studies.section6.specimen import azimuth, cylinder_areas
from tomopose.studies.section6.standard import true_distances
from tomopose.studies.section6.tables import Found, deviations, limit
from tomopose.units import Array

GREY_STEPS = 250.0
"""Steps of a slice's grey values: a screen shows 256."""
RANGE_UM = 50.0
"""Where the colours of deviations are clipped; the paper clips at 25 um, at voxels of 0.0756 mm."""
GREYS = [[0.0, "#000000"], [1.0, "#ffffff"]]
THEIRS, OURS, CIRCLE = "3D scan, paper's method", "3D scan, our best", "circular scan"
ANGLES, HEIGHTS = 180, 8
"""Cells of the unrolled cylinder areas, around and along each."""
COLOURS = {CIRCLE: ALERT, THEIRS: ORANGE, OURS: ACCENT}
SECOND = {THEIRS: "#a8561a", OURS: "#7fb0dc"}


def panels(thing: str) -> dict[str, str]:
    """Name in words -> name of the case."""
    return {CIRCLE: f"{thing}-circular-best-run0", THEIRS: f"{thing}-3D-paper-run1", OURS: f"{thing}-3D-best-run1"}


def compared(thing: str, runs: tuple[int, ...]) -> list[tuple[str, str, str]]:
    """(name in words, name of the case, colour) of all volumes that a figure sets side by side."""
    out = [(CIRCLE, panels(thing)[CIRCLE], COLOURS[CIRCLE])]
    for words, method in ((THEIRS, "paper"), (OURS, "best")):
        for run in runs:
            label = f"{words}, run {run}" if len(runs) > 1 else words
            out.append((label, f"{thing}-3D-{method}-run{run}", COLOURS[words] if run == 1 else SECOND[words]))
    return out


def slices(found: Found) -> Figure:
    """Fig. 11: the same slice of three volumes, side by side on one scale of grey."""
    data, words, offset, top = [], [], 0.0, 0.0
    for name, case in panels("specimen").items():
        values, side = np.array(found[case]["slice"]), float(found[case]["slice_side_mm"])
        n_z, n_x = values.shape
        middle = float(np.percentile(values, 99.5))
        digits = int(np.ceil(-np.log10(max(middle, 1e-6) / GREY_STEPS)))
        data.append(
            {
                "type": "heatmap",
                "x": offset + side * np.arange(n_x),
                "y": side * np.arange(n_z),
                "z": np.round(values, digits),
                "zmin": -0.15 * middle,
                "zmax": 1.15 * middle,
                "colorscale": GREYS,
                "showscale": False,
            }
        )
        words.append(
            {"x": offset + side * n_x / 2, "y": side * n_z, "text": name, "showarrow": False, "yanchor": "bottom"}
        )
        offset, top = offset + side * (n_x + 4), side * n_z
    return Figure(
        title="Fig. 11: slices of the specimen",
        meaning="Attenuation in the plane through the axis and the thread.",
        look_for="Streaks beside the part in the 3D scan, stronger by the paper's method.",
        data=data,
        layout=layout(annotations=words, xaxis=axis("mm"), yaxis=axis("mm", scaleanchor="x", range=[0, 1.15 * top])),
    )


def picture(found: Found, mesh: Mesh) -> Figure:
    """Fig. 12: the 3D scan's deviation map by the paper's method and by ours."""
    names = [THEIRS, OURS]
    maps = {name.replace(", ", "<br>"): deviations(found, panels("specimen")[name]) for name in names}
    return deviation_figure(
        maps,
        mesh.points,
        mesh.faces,
        mesh.normals,
        range_um=RANGE_UM,
        title="Fig. 12: deviation map",
        meaning=f"Measured surface minus the specimen as made, clipped at ±{RANGE_UM:g} µm; edges take the colours of "
        "their neighbours.",
        look_for="Waves along the circumference by the paper's method; by ours they are gone.",
    )


def unrolled(found: Found, mesh: Mesh) -> Figure:
    """Fig. 12: both cylinder areas, angle against height, for three volumes one above the other."""
    chosen = np.flatnonzero(cylinder_areas(mesh))
    x = mesh.points[chosen]
    angle = np.degrees(np.arctan2(x[:, 1], x[:, 0])) % 360
    inner = LENGTH / 2 - FLANGE_LENGTH
    data, words, base = [], [], 0.0
    for k, (name, case) in enumerate(panels("specimen").items()):
        d = deviations(found, case)[chosen]
        for side in (-1.0, 1.0):
            mine = np.isfinite(d) & (side * x[:, 2] > 0)
            edges = (np.linspace(0, 360, ANGLES + 1), np.linspace(inner, LENGTH / 2, HEIGHTS + 1))
            place = (angle[mine], side * x[mine, 2])
            total, count = (np.histogram2d(*place, bins=edges, weights=w)[0] for w in (d[mine], None))
            with np.errstate(invalid="ignore"):
                cells = (total / count).T[:: int(side)]
            data.append(
                {
                    "type": "heatmap",
                    "x": (edges[0][:-1] + edges[0][1:]) / 2,
                    "y": base + FLANGE_LENGTH * (np.arange(HEIGHTS) + 0.5) / HEIGHTS,
                    "z": [[None if np.isnan(v) else float(v) for v in line] for line in cells],
                    "zmin": -RANGE_UM,
                    "zmax": RANGE_UM,
                    "colorscale": vik_scale(),
                    "showscale": k == 0 and side < 0,
                    "colorbar": colour_bar("deviation / µm"),
                }
            )
            base += FLANGE_LENGTH + 1.0
        words.append({"x": 180.0, "y": base - 0.5, "text": name, "showarrow": False, "yanchor": "bottom"})
        base += 6.0
    return Figure(
        title="Fig. 12: the cylinder areas, unrolled",
        meaning="Mean deviation by angle about the part's axis and height, lower and upper area of each volume.",
        look_for="Stripes that repeat seven times around by the paper's method.",
        data=data,
        height=520,
        layout=layout(
            annotations=words, xaxis=axis("angle / deg"), yaxis=axis("height, stacked / mm", range=[0, base])
        ),
    )


def lines_around(mesh: Mesh, cases: Mapping[str, tuple[Array, str]]) -> list[dict[str, object]]:
    """A line for each case, name -> (deviations of the mesh's vertices, um; colour): mean over the height of the
    cylinder areas by direction about the rotation axis."""
    chosen = cylinder_areas(mesh)
    phi = np.degrees(azimuth(mesh)[chosen]) % 360
    cell = np.minimum(phi / 360 * ANGLES, ANGLES - 1).astype(int)  # -1e-20 % 360 is 360
    lines: list[dict[str, object]] = []
    for name, (deviation, colour) in cases.items():
        d = deviation[chosen]
        good = np.isfinite(d)
        count = np.bincount(cell[good], minlength=ANGLES)
        with np.errstate(invalid="ignore"):
            mean = np.bincount(cell[good], d[good], minlength=ANGLES) / count
        lines.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": name,
                "x": 360 * (np.arange(ANGLES) + 0.5) / ANGLES,
                "y": [None if np.isnan(m) else float(m) for m in mean],
                "line": {"color": colour, "width": 1.8},
            }
        )
    return lines


def around(found: Found, mesh: Mesh) -> Figure:
    """Fig. 12: deviation of the cylinder areas by direction about the rotation axis."""
    cases = {name: (deviations(found, case), COLOURS[name]) for name, case in panels("specimen").items()}
    data = lines_around(mesh, cases)
    return Figure(
        title="Fig. 12: deviation around the rotation axis",
        meaning="Mean over the cylinder areas, by the direction of the surface's normal.",
        look_for="Seven waves by the paper's method; by ours what voxels and views leave.",
        data=data,
        layout=layout(xaxis=axis("angle / deg"), yaxis=axis("deviation / µm")),
    )


def bars(found: Found, cases: list[tuple[str, str, str]], key: str, names: list[str], **words: Any) -> Figure:
    """One bar for each measurand and volume."""
    data = []
    for label, case, colour in cases:
        values = found[case][key]
        data.append(
            {
                "type": "bar",
                "name": label,
                "x": names,
                "y": list(values.values()) if isinstance(values, dict) else values,
                "marker": {"color": colour},
            }
        )
    return Figure(data=data, layout=layout(xaxis=axis(type="category"), yaxis=axis("µm"), barmode="group"), **words)


def distance_errors(found: Found, runs: tuple[int, ...]) -> Figure:
    """Fig. 14: errors of the 351 distances over their length, with the user's limit."""
    length = true_distances()
    data = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": label,
            "x": length,
            "y": found[case]["distance_um"],
            "marker": {"color": colour, "size": 4},
        }
        for label, case, colour in compared("standard", runs)
    ]
    ends = np.array([0.0, 1.05 * max(length)])
    data += [
        {
            "type": "scatter",
            "mode": "lines",
            "name": "MPE" if sign > 0 else "",
            "showlegend": sign > 0,
            "x": ends,
            "y": sign * limit(ends),
            "line": {"color": SOFT, "dash": "dash", "width": 1.4},
        }
        for sign in (1, -1)
    ]
    return Figure(
        title="Fig. 14: sphere distances",
        meaning="Errors of the 351 distances between 27 balls.",
        look_for="Whether points lie between the dashed lines, and whether the second run changes anything.",
        data=data,
        layout=layout(xaxis=axis("distance / mm"), yaxis=axis("error / µm")),
    )


def figures_of(found: Found, mesh: Mesh, numbers: Numbers) -> tuple[Figure, ...]:
    """All figures, the deviation map first."""
    runs = numbers.runs
    balls = [str(k + 1) for k in range(27)]
    lengths = list(found["specimen-circular-best-run0"]["length_um"])
    standard = compared("standard", runs["standard"])
    orders = [
        (f"views in {o} order", f"standard-3D-best-run1-{o}", colour)
        for o, colour in (("sequential", ORANGE), ("golden", ACCENT))
    ]
    figures = [
        picture(found, mesh),
        unrolled(found, mesh),
        around(found, mesh),
        slices(found),
        bars(
            found,
            compared("specimen", runs["specimen"]),
            "length_um",
            lengths,
            title="Fig. 13: lengths",
            meaning="Errors of L1 to L6 between planes and L7 between calottes.",
            look_for="Whether bars of the 3D scan by our best are longer than the circular scan's.",
        ),
        distance_errors(found, runs["standard"]),
        bars(
            found,
            standard,
            "diameter_um",
            balls,
            title="Fig. 15: sphere diameters",
            meaning="Errors of the 27 diameters.",
            look_for="Scatter from ball to ball.",
        ),
        bars(
            found,
            standard,
            "form_um",
            balls,
            title="Fig. 16: sphericities",
            meaning="Farthest minus nearest point of each ball from its fitted sphere.",
            look_for="Differences between the scans; the common part is the voxels'.",
        ),
    ]
    if all(case in found for _, case, _ in orders):
        figures.append(
            bars(
                found,
                orders,
                "diameter_um",
                balls,
                title="Order of the views: diameters",
                meaning="One iteration of SART from zero, the same images and matrices.",
                look_for="What the sequence of views alone does.",
            )
        )
    return tuple(figures)
