"""A nominal-actual comparison as a picture (fig. 12): four views of the part in colour, scale and histogram.

The views are drawn by a depth buffer of our own, so that no display, window or graphics driver is needed; matplotlib's
Agg canvas sets scale, histogram and words beside them.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numba import njit

from tomopose.errors import EngineMissingError
from tomopose.measurement.comparison import Comparison
from tomopose.measurement.contour import INSTALL_LINE
from tomopose.units import MICROMETRES_PER_MM, Array

SIDE = 560
"""Pixels a view."""
VIEWS = (("+x +y +z", (1.0, 0.8, 0.7)), ("-x -y -z", (-1.0, -0.8, -0.7)), ("-x +y +z", (-1.0, 0.8, 0.7)),
         ("+x -y -z", (1.0, -0.8, -0.7)))
"""Where each view is seen from."""
LEAST_LIGHT = 0.55
BACKGROUND = 255


def comparison_png(comparison: Comparison, *, range_mm: float, title: str = "") -> bytes:
    """PNG of a comparison, colours clipped at +-range_mm, grey where nothing was measured.

    EngineMissingError without matplotlib or cmcrameri.
    """
    try:
        from cmcrameri import cm
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize
        from matplotlib.figure import Figure
    except ImportError as error:
        raise EngineMissingError("the picture needs matplotlib and cmcrameri", install_line=INSTALL_LINE) from error
    colours = comparison.colours(range_mm)
    limit = range_mm * MICROMETRES_PER_MM
    figure = Figure(figsize=(12, 7.2), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1, 0.75))
    for k, (name, towards) in enumerate(VIEWS):
        axes = figure.add_subplot(grid[k // 2, k % 2])
        axes.imshow(drawn(comparison.points, comparison.mesh.faces, colours, np.array(towards), SIDE))
        axes.set_title(f"from {name}", fontsize=9)
        axes.set_axis_off()
    axes = figure.add_subplot(grid[:, 2])
    count, centre = comparison.histogram(range_mm)
    axes.barh(centre * MICROMETRES_PER_MM, count, height=2 * limit / len(count), color="#4a4a4a")
    axes.set_ylabel("measured minus nominal / µm (outermost bars: beyond)")
    axes.set_xlabel("vertices")
    axes.set_ylim(-limit, limit)
    figure.colorbar(ScalarMappable(norm=Normalize(-limit, limit), cmap=cm.vik), ax=axes, location="left", pad=0.02)
    d = comparison.measured
    figure.suptitle(f"{title + ': ' if title else ''}alignment {comparison.alignment.rule}, mean "
                    f"{d.mean() * MICROMETRES_PER_MM:+.1f} µm, "
                    f"{100 * comparison.share_within(range_mm):.1f} % within ±{limit:g} µm", fontsize=10)
    content = io.BytesIO()
    canvas.print_figure(content, format="png")
    return content.getvalue()


def drawn(points: Array, faces: np.ndarray, colours: np.ndarray, towards: Array, side: int) -> Any:
    """(side, side, 3) uint8: a mesh in parallel projection, seen from `towards` (3,), z up, white around.

    points (n, 3) mm; colours (n, 3) uint8 at the points; triangles that look away from the light are darker.
    """
    w = towards / np.linalg.norm(towards)
    right = np.cross([0.0, 0.0, 1.0], w)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(w, right), w])
    y = (points - 0.5 * (points.min(axis=0) + points.max(axis=0))) @ frame.T
    reach = 1.04 * float(np.abs(y[:, :2]).max())
    x = np.column_stack([(y[:, 0] / reach + 1) * (side - 1) / 2, (1 - y[:, 1] / reach) * (side - 1) / 2, y[:, 2]])
    return _filled(np.ascontiguousarray(x), np.ascontiguousarray(faces), colours.astype(np.float64), side)


@njit(cache=True)
def _filled(x: Any, faces: Any, colours: Any, side: Any) -> Any:
    """Triangles in pixels and depth, nearest in front; colours run evenly between the corners."""
    image = np.full((side, side, 3), np.uint8(BACKGROUND))
    depth = np.full((side, side), -np.inf)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
        vx, vy, vz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
        area = ux * vy - uy * vx
        # Rows run down, so what faces the viewer turns the other way.
        if area >= 0.0:
            continue
        length = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + area * area)
        light = LEAST_LIGHT + (1.0 - LEAST_LIGHT) * (-area / length if length > 0.0 else 0.0)
        low_i, high_i = min(x[a, 0], x[b, 0], x[c, 0]), max(x[a, 0], x[b, 0], x[c, 0])
        low_j, high_j = min(x[a, 1], x[b, 1], x[c, 1]), max(x[a, 1], x[b, 1], x[c, 1])
        for j in range(max(int(np.ceil(low_j)), 0), min(int(np.floor(high_j)), side - 1) + 1):
            for i in range(max(int(np.ceil(low_i)), 0), min(int(np.floor(high_i)), side - 1) + 1):
                px, py = i - x[a, 0], j - x[a, 1]
                s, t = (px * vy - py * vx) / area, (ux * py - uy * px) / area
                if s < -1e-9 or t < -1e-9 or s + t > 1.0 + 1e-9:
                    continue
                z = x[a, 2] + s * uz + t * vz
                if z > depth[j, i]:
                    depth[j, i] = z
                    for k in range(3):
                        value = (1.0 - s - t) * colours[a, k] + s * colours[b, k] + t * colours[c, k]
                        image[j, i, k] = np.uint8(min(max(light * value + 0.5, 0.0), 255.0))
    return image
