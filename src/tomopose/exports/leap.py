"""LEAP modular beam: sources, module centres and the unit directions in which row and column *index* grow.

A "row vector" is the direction of the growing row index (v), not the direction along a row.  Source: LEAP, "modular
beam geometry"; proved with rayTrace of LEAP 1.26 (5e-6 px; its own arrays are float32, 2e-4 to 4e-4 px).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.exports.panel import Given, Rows, matrices_of_panels, numbers, panels, require_keys
from tomopose.geometry.projection import ProjectionMatrices

KEYS = ("source_positions", "module_centers", "row_vectors", "col_vectors", "pixel_height", "pixel_width")
UNIT_TOLERANCE = 1e-6


def to_leap(matrices: ProjectionMatrices, *, rows: Rows = "bottom") -> dict[str, Any]:
    """The arrays (n, 3) of set_modularbeam, mm, and the pitch.  NotRepresentableError on skew or wrong aspect."""
    g = panels(matrices, "leap")
    V = -g.V if rows == "top" else g.V
    return {
        "source_positions": g.source,
        "module_centers": g.centre,
        "row_vectors": V / matrices.p_v,
        "col_vectors": g.U / matrices.p_u,
        "pixel_height": matrices.p_v,
        "pixel_width": matrices.p_u,
    }


def from_leap(content: Mapping[str, object], given: Given, *, where: str = "the LEAP arrays") -> ProjectionMatrices:
    """Matrices of `to_leap`'s arrays; `given` must hold n_u, n_v and the row order."""
    require_keys(content, KEYS, where)
    vectors = {k: numbers(content[k], (-1, 3), f"{where}: {k}") for k in KEYS[:4]}
    p_v, p_u = (float(numbers(content[k], (), f"{where}: {k}")) for k in KEYS[4:])
    for name in ("row_vectors", "col_vectors"):
        length = np.linalg.norm(vectors[name], axis=1)
        if (np.abs(length - 1) > UNIT_TOLERANCE).any():
            raise InputError(f"{where}: {name} must be unit vectors; found lengths up to {length.max():.6g}")
    return matrices_of_panels(
        vectors["source_positions"],
        vectors["module_centers"],
        p_u * vectors["col_vectors"],
        p_v * vectors["row_vectors"],
        given=given,
        rows=given.settle("rows", None, where),
        where=where,
    )
