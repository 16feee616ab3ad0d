"""The difference of two calibrations from halves of the poses, over the field of view."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.calibration.model.budget import Halves
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, LINE, ORANGE, axis, layout
from tomopose.report.words import number
from tomopose.units import Array

ARROW_SHARE = 0.08
"""Length of the longest arrow, as a share of the plotted span."""


def halves_map(h: Halves) -> Figure:
    """Arrows of the difference, and beside them what is stated, to the same scale."""
    size = np.linalg.norm(h.difference, axis=1)
    stated = np.linalg.norm(h.sigma, axis=1)
    span = float(max(np.ptp(h.x_D, axis=0).max(), 1.0))
    longest = float(max(size.max(), stated.max(), 1e-300))
    scale = ARROW_SHARE * span / longest
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "markers",
            "x": h.x_D[:, 0],
            "y": h.x_D[:, 1],
            "name": "stated, one standard uncertainty",
            "marker": {
                "size": 2 * scale * stated / span * 420,
                "color": "rgba(0,0,0,0)",
                "line": {"color": ORANGE, "width": 1.2},
            },
            "hoverinfo": "skip",
        },
        {
            "type": "scatter",
            "mode": "lines",
            "name": "difference",
            **_arrows(h.x_D, h.x_D + scale * h.difference),
            "hoverinfo": "skip",
            "line": {"color": ACCENT, "width": 1.4},
        },
        {
            "type": "scatter",
            "mode": "markers",
            "x": h.x_D[:, 0],
            "y": h.x_D[:, 1],
            "showlegend": False,
            "marker": {"size": 4, "color": LINE},
            "customdata": np.column_stack([size, stated]),
            "hovertemplate": "difference %{customdata[0]:.3~g} px, stated %{customdata[1]:.3~g} px<extra></extra>",
        },
    ]
    return Figure(
        title="Two halves of the poses, compared",
        meaning="The calibration from the poses near the focal spot minus that from the others, at points of a tilted "
        "scan, a rigid motion of the object taken out.  It is "
        f"{number(h.rms_px)} px rms a coordinate where {number(h.stated_px)} px is stated; the longest arrow is "
        f"{number(float(size.max()))} px.",
        look_for="Arrows that leave their circles by much, and alike in one part of the field, show an error of the "
        "model that no residual shows.",
        data=data,
        layout=layout(
            xaxis=axis("u / px"), yaxis=axis("v / px", scaleanchor="x"), legend={"orientation": "h", "y": 1.08}
        ),
        height=520,
    )


def _arrows(base: Array, tip: Array) -> dict[str, list[float | None]]:
    u: list[float | None] = []
    v: list[float | None] = []
    for a, b in zip(base, tip, strict=True):
        u += [float(a[0]), float(b[0]), None]
        v += [float(a[1]), float(b[1]), None]
    return {"x": u, "y": v}
