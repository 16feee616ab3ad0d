"""Figures for a notebook: the same as those of the reports, as plotly figures that a cell shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.errors import EngineMissingError, InputError, ShapeError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.report.figures import coverage_figures, residual_figures, scene_figures
from tomopose.report.figures.thumbnails import Thumbnail, worst_thumbnails
from tomopose.report.gather import Joined, join
from tomopose.report.page import Figure
from tomopose.report.style import ORANGE, axis, layout
from tomopose.values import Images, require_types

RESIDUALS: Mapping[str, Callable[[Calibration, Joined], Figure | None]] = {
    "pose": lambda calibration, joined: residual_figures.by_pose(joined),
    "detector": residual_figures.quiver,
    "sequence": lambda calibration, joined: residual_figures.over_sequence(joined),
    "coordinate": lambda calibration, joined: residual_figures.by_coordinate(joined),
    "histogram": lambda calibration, joined: residual_figures.histogram(joined),
    "quantiles": lambda calibration, joined: residual_figures.quantiles(joined),
}
ACROSS = 4
"""Detections side by side."""
GREY = [[0.0, "#000000"], [1.0, "#ffffff"]]
BLUE = "#39c0ff"
INSTALL = 'pip install "tomopose[notebook]"'


class PlotlyFigure(Protocol):
    """What a notebook does with a `plotly.graph_objects.Figure`, a class without types of its own."""

    data: tuple[object, ...]
    layout: object

    def show(self, renderer: str | None = None) -> None: ...
    def to_html(self, **options: object) -> str: ...
    def write_html(self, file: str | Path, **options: object) -> None: ...
    def write_image(self, file: str | Path, **options: object) -> None: ...
    def update_layout(self, **changes: object) -> PlotlyFigure: ...
    def update_traces(self, **changes: object) -> PlotlyFigure: ...


def as_plotly(figure: Figure) -> PlotlyFigure:
    """A report's figure as one of plotly's, with its title; EngineMissingError without plotly."""
    try:
        import plotly.graph_objects
    except ImportError:
        raise EngineMissingError(
            f"figures for a notebook need plotly, which is not installed: {INSTALL}; reports need nothing more",
            install_line=INSTALL,
        ) from None
    margin = {**dict(figure.layout.get("margin", {})), "t": 64}
    title = {"text": figure.title, "x": 0.02, "y": 0.98, "yanchor": "top", "font": {"size": 15}}
    made = plotly.graph_objects.Figure(
        data=list(figure.data), layout={**figure.layout, "title": title, "margin": margin, "height": figure.height}
    )
    return cast(PlotlyFigure, made)


def _require(value: object, kind: type, name: str, reads: str) -> None:
    if not isinstance(value, kind):
        hint = f": {reads}(path) reads it" if isinstance(value, str) else ""
        raise InputError(f"{name} must be a {kind.__name__}; a {type(value).__name__} was given{hint}")


@require_types
def plot_residuals(
    calibration: Calibration,
    *,
    by: str = "pose",
    observations: BallObservations | None = None,
    poses: PoseSequence | None = None,
) -> PlotlyFigure:
    """Observed minus calculated ball centres, px.

    Parameters
    ----------
    by:            "pose" (paper, fig. 8), "detector" (arrows), "sequence", "coordinate" (needs poses), "histogram" or
                   "quantiles".
    observations:  the detections, for their standard uncertainties.
    poses:         the pose table, for colours by rotation and plots by coordinate.

    Raises
    ------
    InputError  an unknown `by`, a calibration without residuals, or no poses where they are needed.
    """
    _require(calibration, Calibration, "calibration", "read_calibration")
    if by not in RESIDUALS:
        raise InputError(f"by is {by!r}; one of {', '.join(RESIDUALS)} is needed")
    if not calibration.pose_id:
        raise InputError("the calibration holds no residuals: it ended before poses were fitted")
    figure = RESIDUALS[by](calibration, join(calibration, observations=observations, poses=poses))
    if figure is None:
        raise InputError(f"residuals by {by} need the pose table: plot_residuals(calibration, by={by!r}, poses=poses)")
    return as_plotly(figure)


@require_types
def plot_scan(matrices: ProjectionMatrices) -> PlotlyFigure:
    """The path of the source about the object, in W, mm (paper, fig. 9)."""
    _require(matrices, ProjectionMatrices, "matrices", "read_matrices")
    return as_plotly(scene_figures.source_path(matrices))


@require_types
def plot_observability(calibration: Calibration) -> PlotlyFigure:
    """Correlations of all estimated coordinates: what the poses can and cannot distinguish."""
    _require(calibration, Calibration, "calibration", "read_calibration")
    return as_plotly(coverage_figures.correlation_map(calibration))


@require_types
def plot_detections(observations: BallObservations, images: Images, *, count: int = 8) -> PlotlyFigure:
    """The least certain detections as pictures, with the silhouette found (orange) and the projected centre (blue).

    Parameters
    ----------
    observations:  n rows.
    images:        n images [v, u] or a lazy sequence; only those shown are read.
    count:         how many are shown.

    Raises
    ------
    ShapeError  where the counts disagree;  InputError  where there is nothing to show.
    """
    _require(observations, BallObservations, "observations", "read_observations")
    if len(images) != len(observations):
        raise ShapeError(f"{len(observations)} observations but {len(images)} images")
    if count < 1 or not len(observations):
        raise InputError(f"count is {count} of {len(observations)} detections; at least one is needed")
    return as_plotly(detections_figure(worst_thumbnails(observations, images, count=count)))


def detections_figure(pictures: Sequence[Thumbnail]) -> Figure:
    """Pictures side by side, each on axes of its own in px of D."""
    data: list[dict[str, Any]] = []
    plan: dict[str, Any] = {}
    words: list[dict[str, Any]] = []
    rows = -(-len(pictures) // ACROSS)
    for k, picture in enumerate(pictures):
        row, column = divmod(k, ACROSS)
        suffix = "" if k == 0 else str(k + 1)
        x, y = [column / ACROSS + 0.01, (column + 1) / ACROSS - 0.01], [1 - (row + 0.9) / rows, 1 - row / rows]
        plan[f"xaxis{suffix}"] = axis(domain=x, anchor=f"y{suffix}", visible=False, constrain="domain")
        plan[f"yaxis{suffix}"] = axis(domain=y, anchor=f"x{suffix}", visible=False, scaleanchor=f"x{suffix}")
        data += _picture(picture, f"x{suffix}", f"y{suffix}")
        place = {"x": (x[0] + x[1]) / 2, "y": y[0], "xref": "paper", "yref": "paper", "yanchor": "top"}
        words.append({"text": f"{picture.pose_id}: {picture.text or picture.status}", "showarrow": False, **place})
    return Figure(
        title="The least certain detections",
        meaning="Crops of the radiographs with the silhouette that was found and the projection of the ball's centre.",
        look_for="The line should follow the ball's rim all round.",
        data=data,
        layout=layout(**plan, annotations=words, showlegend=False),
        height=90 + 230 * rows,
    )


def _picture(picture: Thumbnail, x: str, y: str) -> list[dict[str, Any]]:
    n_v, n_u = picture.crop.shape
    step = max(1, max(n_v, n_u) // 160)
    shown = np.asarray(picture.crop, dtype=np.float64)[::step, ::step]
    u0, v0 = picture.origin
    common = {"xaxis": x, "yaxis": y, "hoverinfo": "skip"}
    traces: list[dict[str, Any]] = [
        {"type": "heatmap", "z": shown, "x0": u0, "dx": step, "y0": v0, "dy": step, "colorscale": GREY,
         "showscale": False, **common},
    ]  # fmt: skip
    if len(picture.outline):
        u, v = picture.outline.T
        traces.append(
            {"type": "scatter", "mode": "lines", "x": u, "y": v, "line": {"color": ORANGE, "width": 1.5}, **common}
        )
    if picture.centre is not None:
        mark = {"symbol": "cross-thin", "size": 10, "line": {"width": 1.5, "color": BLUE}}
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": picture.centre[:1],
                "y": picture.centre[1:],
                "marker": mark,
                **common,
            }
        )
    return traces
