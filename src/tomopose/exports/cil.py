"""CIL `Cone3D_Flex` (25.0 and later): source, detector centre and unit directions in x (u) and y (v, always up).

Arrays whose row 0 is the top say so by origin 'top-left'; the vectors stay, because CIL turns y itself.
Source: CIL documentation, AcquisitionGeometry.create_Cone3D_Flex and set_panel; proved with CIL 26.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.exports.panel import Given, Rows, matrices_of_panels, numbers, panels, require_keys
from tomopose.geometry.projection import ProjectionMatrices

KEYS = ("source", "detector", "direction_x", "direction_y", "pixel_size", "num_pixels", "origin")
ORIGINS = {"bottom": "bottom-left", "top": "top-left"}


def to_cil(matrices: ProjectionMatrices, *, rows: Rows = "bottom") -> dict[str, Any]:
    """Arguments of create_Cone3D_Flex (n, 3), mm, and of set_panel ([x, y]).  NotRepresentableError on skew."""
    g = panels(matrices, "cil")
    return {
        "source": g.source,
        "detector": g.centre,
        "direction_x": g.U / matrices.p_u,
        "direction_y": g.V / matrices.p_v,
        "pixel_size": np.array([matrices.p_u, matrices.p_v]),
        "num_pixels": np.array([matrices.n_u, matrices.n_v]),
        "origin": np.array(ORIGINS[rows]),
    }


def from_cil(content: Mapping[str, object], given: Given, *, where: str = "the CIL arrays") -> ProjectionMatrices:
    """Matrices of `to_cil`'s arrays.  The row order has no part in them: direction_y points up either way."""
    require_keys(content, KEYS, where)
    if str(content["origin"]) not in ORIGINS.values():
        raise InputError(f"{where}: origin is {content['origin']!s}; known are {', '.join(ORIGINS.values())}")
    source, detector, x, y = (numbers(content[k], (-1, 3), f"{where}: {k}") for k in KEYS[:4])
    lengths = [np.linalg.norm(d, axis=1, keepdims=True) for d in (x, y)]
    if min(length.min(initial=1.0) for length in lengths) == 0:
        raise InputError(f"{where}: a direction has length 0")
    x, y = x / lengths[0], y / lengths[1]
    size = numbers(content["num_pixels"], (2,), f"{where}: num_pixels")
    pitch = numbers(content["pixel_size"], (2,), f"{where}: pixel_size")
    settled = Given(
        n_u=given.settle("n_u", int(size[0]), where),
        n_v=given.settle("n_v", int(size[1]), where),
        p_u=given.settle("p_u", float(pitch[0]), where),
        p_v=given.settle("p_v", float(pitch[1]), where),
        pose_id=given.pose_id,
    )
    return matrices_of_panels(source, detector, pitch[0] * x, pitch[1] * y, given=settled, rows="bottom", where=where)
