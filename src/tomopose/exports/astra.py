"""ASTRA `cone_vec`: twelve numbers a view, [source, panel centre, column step U, row step V], mm.

The centre is the middle of the panel; U and V are the steps from pixel to pixel.  Arrays whose row 0 is the top take
-V.  Source: ASTRA toolbox documentation, "3D geometries", cone_vec; proved with projectPoint of libastra 2.5.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.exports.panel import Given, Rows, matrices_of_panels, numbers, panels
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array


def to_astra(matrices: ProjectionMatrices, *, rows: Rows = "bottom") -> Array:
    """Vectors (n, 12), mm, for arrays (rows, n, columns) with that row order.

    Raises NotRepresentableError where a matrix has skew or an aspect that no panel of the given pitch has.
    """
    g = panels(matrices, "astra")
    return np.hstack([g.source, g.centre, g.U, -g.V if rows == "top" else g.V])


def from_astra(vectors: ArrayLike, given: Given, *, where: str = "the ASTRA vectors") -> ProjectionMatrices:
    """Matrices of vectors (n, 12).  They do not hold n_u, n_v and the row order they were made for: `given` must."""
    table = numbers(vectors, (-1, 12), where)
    rows = given.settle("rows", None, where)
    return matrices_of_panels(
        table[:, :3], table[:, 3:6], table[:, 6:9], table[:, 9:], given=given, rows=rows, where=where
    )
