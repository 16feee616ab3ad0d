"""PYRO-NN (and CONRAD): the matrices themselves, pixel indices of the array, world in mm.

The back-projector weights with 1/w^2 and the projector casts rays along M^-1 (u, v, 1), so |P[2, :3]| = 1 and w > 0
are part of the format.  Arrays whose row 0 is the top take F P.  Source: PYRO-NN's layers; CONRAD's documentation.
"""

from __future__ import annotations

from collections.abc import Mapping

from tomopose.exports.panel import Given, Rows, numbers, require_keys
from tomopose.geometry.projection import ProjectionMatrices, row_flip
from tomopose.units import Array


def to_pyronn(matrices: ProjectionMatrices, *, rows: Rows = "bottom") -> dict[str, Array]:
    """projection_matrices (n, 3, 4), |P[2, :3]| = 1, w > 0, for arrays (n, rows, columns) with that row order."""
    return {"projection_matrices": matrices.top_first() if rows == "top" else matrices.P}


def from_pyronn(
    content: Mapping[str, object], given: Given, *, where: str = "the PYRO-NN arrays"
) -> ProjectionMatrices:
    """Matrices of `to_pyronn`'s array; `given` must hold size, pitch and row order."""
    require_keys(content, ("projection_matrices",), where)
    P = numbers(content["projection_matrices"], (-1, 3, 4), f"{where}: projection_matrices")
    n_u, n_v, p_u, p_v, rows = (given.settle(k, None, where) for k in ("n_u", "n_v", "p_u", "p_v", "rows"))
    return given.matrices(row_flip(n_v) @ P if rows == "top" else P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v)
