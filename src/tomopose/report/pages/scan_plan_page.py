"""The page of a planned scan: how many views show each patch of the part, the path, and the usual paths beside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NotRequired, TypedDict

import numpy as np

from tomopose.provenance import Provenance
from tomopose.report.page import CARE, GOOD, Block, Figure, KeyFigure, Page, Section, Table, Verdict, Words, render
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.style import ACCENT, SEQUENTIAL, axis, colour_bar, layout, space_axis
from tomopose.report.words import number
from tomopose.units import Array

MOST_TRIANGLES = 30_000
"""Of the picture of the part; of a larger mesh every k-th triangle is drawn, and the page says so."""
GOOD_RATIO = 0.97
"""Share of the bound from which a plan counts as near to the best: the certificate that the planner aims at."""


class FeatureFigures(TypedDict):
    """Of a feature along one path; u_mm None where it is not determined."""

    name: str
    seen_share: float
    u_mm: float | None


class LengthFigures(TypedDict):
    """Of a length along one path; u_mm None where nothing is predicted; draws_measured where scans were drawn."""

    name: str
    u_mm: float | None
    draws_measured: NotRequired[int]


class PathFigures(TypedDict):
    """What scan.json says of one path."""

    J: float
    C: float
    T: float
    M: float
    worst_transmission: float
    largest_gap_deg: float
    travel: float
    duration_s: float
    views_out_of_view: int
    features: list[FeatureFigures]
    lengths: list[LengthFigures]


class Certificate(TypedDict):
    """How near the choice is to its bound."""

    ratio: float


class ScanPlanFigures(PathFigures):
    """What the page reads of scan.json (`tomopose/scan-plan/1`)."""

    part: str
    views: int
    candidates: int
    certificate: Certificate
    paths: dict[str, PathFigures]
    unseen: list[dict[str, str]]
    transmission_by_view: list[float]
    limits: dict[str, list[float]]
    assumed_limits: list[str]
    constants: dict[str, object]
    attenuation: str
    freedoms: list[Freedom]
    joints: list[Joint] | None


class Joint(TypedDict):
    """How far a joint of a robot goes, and what it may."""

    joint: int
    unit: str
    lowest: float
    highest: float
    limits: list[float]


class Freedom(TypedDict):
    """One freedom more, tried by itself."""

    name: str
    J: float
    gain: float


@dataclass(frozen=True, kw_only=True, eq=False)
class PartSurface:
    """points (n, 3) mm, faces (m, 3), views (m,): that show each triangle, nan where no judged point is near."""

    points: Array
    faces: np.ndarray
    views: Array

    @classmethod
    def of(cls, points: Array, faces: np.ndarray, x: Array, seen: Array) -> PartSurface:
        """Triangles take the number of the nearest judged point x (k, 3) within a twelfth of the part's size."""
        from scipy.spatial import cKDTree

        kept = faces[:: max(1, -(-len(faces) // MOST_TRIANGLES))]
        centre = points[kept].mean(axis=1)
        reach = float(np.linalg.norm(np.ptp(points, axis=0))) / 12
        distance, nearest = cKDTree(x).query(centre, distance_upper_bound=reach)
        found = np.append(np.asarray(seen, dtype=np.float64), np.nan)[nearest]
        return cls(points=points, faces=kept, views=np.where(np.isfinite(distance), found, np.nan))


def scan_plan_report(
    document: ScanPlanFigures, surface: PartSurface, source_path: Array, *, provenance: Provenance | None = None
) -> str:
    """One offline HTML document of scan.json, the part's surface, and the source's path (n, 3), mm, about the part."""
    ratio, best = document["certificate"]["ratio"], max(p["J"] for p in document["paths"].values())
    gain = document["J"] / best - 1 if best > 0 else float("inf")
    verdict = Verdict(
        word=f"{100 * gain:+.0f} % against the best usual path",
        sentence=(
            f"J is {document['J']:.3f} for the plan and {best:.3f} for the best of {', '.join(document['paths'])} "
            f"with as many views; the choice reaches {100 * ratio:.1f} % of what any choice of the candidates could."
        ),
        tone=GOOD if ratio >= GOOD_RATIO and gain > 0 else CARE,
        reasons=[f"{u['name']}: {u['why']}" for u in document["unseen"]],
    )
    return render(
        Page(
            title="Planned scan",
            subtitle=f"{document['views']} views of {document['part']}, chosen of {document['candidates']} candidates",
            verdict=verdict,
            key_figures=[
                KeyFigure(
                    name="Coverage C", value=f"{document['C']:.3f}", note="Share of the points that a ray grazes."
                ),
                KeyFigure(
                    name="Completeness T",
                    value=f"{document['T']:.3f}",
                    note="Share of the planes through the part that the source crosses.",
                ),
                KeyFigure(
                    name="Transmission M",
                    value=f"{document['M']:.3f}",
                    note="Mean over views and points; dark views are noise.",
                ),
                KeyFigure(
                    name="Travel",
                    value=f"{document['travel']:.0f}",
                    note="In mm and degrees, all axes: the machine's time.",
                ),
            ],
            sections=[
                Section(
                    title="The part", lead="What the views show of it.", blocks=[_part(surface), _path(source_path)]
                ),
                Section(
                    title="Beside the usual paths",
                    lead="The same number of views, within the same limits, judged on the same points.",
                    blocks=[_paths(document), _features(document), *_lengths(document), _transmission(document)],
                ),
                Section(title="What limits it", lead="Each freedom was tried by itself.", blocks=_limits(document)),
                Section(title="Definitions", blocks=[_constants(document)]),
                provenance_section(provenance),
            ],
            footer="Written by tomopose.",
        )
    )


def _part(s: PartSurface) -> Figure:
    x, y, z = s.points.T
    i, j, k = s.faces.T
    trace = {
        "type": "mesh3d",
        "x": x,
        "y": y,
        "z": z,
        "i": i,
        "j": j,
        "k": k,
        "intensity": np.nan_to_num(s.views, nan=0.0),
        "intensitymode": "cell",
        "colorscale": SEQUENTIAL,
        "colorbar": colour_bar("views"),
        "flatshading": True,
        "hovertemplate": "%{x:.1f}, %{y:.1f}, %{z:.1f} mm<extra></extra>",
    }
    return Figure(
        title="How often each patch is seen",
        meaning="Views whose rays graze the patch and are transmitted enough; 0 also where no feature was asked for.",
        look_for="Dark patches of a feature: no allowed view shows them.",
        data=[trace],
        layout=_space(),
        height=520,
    )


def _path(source: Array) -> Figure:
    x, y, z = source.T
    trace = {
        "type": "scatter3d",
        "mode": "lines+markers",
        "x": x,
        "y": y,
        "z": z,
        "marker": {"size": 3, "color": np.arange(len(source)), "colorscale": SEQUENTIAL},
        "line": {"color": ACCENT, "width": 2},
        "hovertemplate": "view %{marker.color}<br>%{x:.1f}, %{y:.1f}, %{z:.1f} mm<extra></extra>",
    }
    return Figure(
        title="The source about the part",
        meaning="Where the source is in the part's coordinates, in the order of the views.",
        look_for="Views gather where rays run along faces; the order keeps the machine's way short.",
        data=[trace],
        layout=_space(),
        height=480,
    )


def _space() -> dict[str, Any]:
    scene = {f"{a}axis": space_axis(f"{a} / mm") for a in "xyz"}
    return layout(scene={**scene, "aspectmode": "data"}, margin={"l": 0, "r": 0, "t": 30, "b": 0})


def _all(document: ScanPlanFigures) -> list[tuple[str, PathFigures]]:
    return [("plan", document), *document["paths"].items()]


def _paths(document: ScanPlanFigures) -> Table:
    return Table(
        title="Worth of the paths",
        meaning="J = 0.5 C + 0.3 T + 0.2 M; a larger number is better in the first four columns.",
        columns=[
            "path",
            "J",
            "C",
            "T",
            "M",
            "least transmission",
            "largest gap / deg",
            "travel",
            "time / s",
            "out of view",
        ],
        rows=[
            [
                name,
                *(f"{value:.3f}" for value in (p["J"], p["C"], p["T"], p["M"])),
                f"{p['worst_transmission']:.2g}",
                f"{p['largest_gap_deg']:.1f}",
                f"{p['travel']:.0f}",
                f"{p['duration_s']:.0f}",
                str(p["views_out_of_view"]),
            ]
            for name, p in _all(document)
        ],
        numeric=tuple(range(1, 10)),
    )


def _features(document: ScanPlanFigures) -> Table:
    paths = _all(document)
    lookup = {name: {f["name"]: f for f in p["features"]} for name, p in paths}
    rows = []
    for feature in document["features"]:
        cells = [feature["name"]]
        for name, _ in paths:
            f = lookup[name][feature["name"]]
            u = "not determined" if f["u_mm"] is None else f"{number(1000 * f['u_mm'])} um"
            cells.append(f"{100 * f['seen_share']:.0f} %; {u}")
        rows.append(cells)
    return Table(
        title="Features",
        meaning=(
            "Share of the feature that is seen, and the standard uncertainty of its position that the views' noise "
            f"lets expect after SART and the fit, {_predicted_by(document)}. Systematic deviations (few views, cone "
            "beam, beam hardening, scatter) are not in it."
        ),
        columns=["feature", *(name for name, _ in paths)],
        rows=rows,
    )


def _predicted_by(document: ScanPlanFigures) -> str:
    """How u was predicted."""
    constants = document["constants"]
    return {
        "filters": "predicted by filters in the place of SART's steps",
        "exact": "predicted through SART's own steps",
        "drawn": f"the scatter of {constants['draws']} scans with drawn noise",
    }[str(constants["uncertainty"])]


def _lengths(document: ScanPlanFigures) -> list[Block]:
    paths, draws = _all(document), document["constants"]["draws"]
    if not document["lengths"]:
        return []
    rows = [
        [length["name"], *(_length(p["lengths"][k], draws) for _, p in paths)]
        for k, length in enumerate(document["lengths"])
    ]
    table = Table(
        title="Lengths",
        meaning=f"Standard uncertainty of each length from the views' noise alone, {_predicted_by(document)}.",
        columns=["length", *(name for name, _ in paths)],
        rows=rows,
    )
    return [table]


def _length(length: LengthFigures, draws: object) -> str:
    u, n = length["u_mm"], length.get("draws_measured")
    said = "not predicted" if u is None else f"{number(1000 * u)} um"
    return said if n is None or n == draws else f"{said}; measured in {n} of {draws} draws"


def _transmission(document: ScanPlanFigures) -> Figure:
    tau: Sequence[float] = document["transmission_by_view"]
    return Figure(
        title="Transmission of each view",
        meaning="Mean over the points of the features, in the order of the views.",
        look_for="Views near 0 look along the part: they are there for its faces, not for its density.",
        data=[{"type": "bar", "x": list(range(len(tau))), "y": list(tau), "marker": {"color": ACCENT}}],
        layout=layout(xaxis=axis("view"), yaxis=axis("transmission")),
        height=300,
    )


def _limits(document: ScanPlanFigures) -> list[Block]:
    table = Table(
        title="Which freedom would help",
        meaning="J of a coarse search with one freedom more, and its gain over the same search without it.",
        columns=["freedom", "J", "gain"],
        rows=[[f["name"], f"{f['J']:.3f}", f"{100 * f['gain']:+.0f} %"] for f in document["freedoms"]],
        numeric=(1, 2),
    )
    items = [f"{u['name']}: {u['why']}" for u in document["unseen"]] or ["Every point is seen by some allowed view."]
    return [table, Words(title="What no allowed view shows", items=items)]


def _constants(document: ScanPlanFigures) -> Table:
    rows = [["attenuation", document["attenuation"]], *([k, str(v)] for k, v in document["constants"].items())]
    rows += [[k, f"{v[0]:g} to {v[1]:g}"] for k, v in document["limits"].items()]
    rows += [
        [
            f"joint {j['joint']}, {j['unit']}",
            "{:.4g} to {:.4g} of {:g} to {:g}".format(j["lowest"], j["highest"], *j["limits"]),
        ]
        for j in document["joints"] or ()
    ]
    if document["assumed_limits"]:
        rows.append(["limits not given, defaults taken", ", ".join(document["assumed_limits"])])
    return Table(
        title="Constants",
        meaning="Everything that J and the predictions rest on.",
        columns=["name", "value"],
        rows=rows,
    )
