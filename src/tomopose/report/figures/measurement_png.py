"""A nominal-actual comparison as a picture (fig. 12): four views of the part in colour, scale and histogram.

No display, window or graphics driver is needed: `deviation_picture` draws the views, the Agg canvas of matplotlib sets
scale, histogram and words beside them.
"""

from __future__ import annotations

import io

import numpy as np

from tomopose.errors import EngineMissingError
from tomopose.measurement.mesh.comparison import Comparison
from tomopose.measurement.surface.contour import INSTALL_LINE
from tomopose.report.figures.deviation_picture import drawn, viewpoint
from tomopose.units import MICROMETRES_PER_MM

SIDE = 560
"""Pixels a view."""
VIEWS = (("+x +y +z", 40.0, 30.0), ("-x -y -z", 220.0, -30.0), ("-x +y +z", 140.0, 30.0), ("+x -y -z", 320.0, -30.0))
"""Where each view is seen from, with its azimuth and elevation, degrees."""
MARGIN = 1.04


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
    limit = range_mm * MICROMETRES_PER_MM
    figure = Figure(figsize=(12, 7.2), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1, 0.75))
    x = comparison.points - 0.5 * (comparison.points.min(axis=0) + comparison.points.max(axis=0))
    normals = comparison.alignment.directions(comparison.mesh.normals)
    for k, (name, azimuth, elevation) in enumerate(VIEWS):
        R = viewpoint(azimuth, elevation)
        width = 2 * MARGIN * float(np.abs((x @ R.T)[:, :2]).max())
        axes = figure.add_subplot(grid[k // 2, k % 2])
        axes.imshow(
            drawn(
                x,
                comparison.mesh.faces,
                normals,
                comparison.deviation * MICROMETRES_PER_MM,
                range_um=limit,
                R=R,
                px_per_mm=SIDE / width,
                size_mm=(width, width),
            )
        )
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
    figure.suptitle(
        f"{title + ': ' if title else ''}alignment {comparison.alignment.rule}, mean "
        f"{d.mean() * MICROMETRES_PER_MM:+.1f} µm, "
        f"{100 * comparison.share_within(range_mm):.1f} % within ±{limit:g} µm",
        fontsize=10,
    )
    content = io.BytesIO()
    canvas.print_figure(content, format="png")
    return content.getvalue()
