"""Bare projection matrices: an array (n, 3, 4), rows of twelve numbers, or MATLAB's 3 x 4 x n.

They map points of W, in mm, to pixel indices; integers are pixel centres.  Which detector row is row 0 is not in them
and must be given.  Any scale and sign is accepted: the matrix is scaled so that points in front of the source have w >
0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from tomopose.errors import InputError
from tomopose.exports.panel import Given, numbers
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array

ROUGH_PANEL = 0.1
"""Skew and aspect error above which twelve numbers are no projection matrix of that pitch: few digits stay far
below.
"""


def matrices_in(content: object) -> Array | None:
    """(n, 3, 4) of an array, of the one such array in a mapping, or of a text with twelve numbers a row; else None."""
    if isinstance(content, np.ndarray):
        return _as_matrices(content)
    if isinstance(content, Mapping):
        found = [P for v in content.values() if isinstance(v, np.ndarray) and (P := _as_matrices(v)) is not None]
        return found[0] if len(found) == 1 else None
    return _of_text(content) if isinstance(content, str) else None


def _as_matrices(array: Array) -> Array | None:
    """(n, 3, 4) of (n, 3, 4), MATLAB's (3, 4, n) or one (3, 4)."""
    if array.dtype.kind not in "fiu":
        return None
    if array.ndim == 2 and array.shape == (3, 4):
        return array[None].astype(np.float64)
    if array.ndim != 3:
        return None
    if array.shape[1:] == (3, 4):
        return array.astype(np.float64)
    return np.moveaxis(array, 2, 0).astype(np.float64) if array.shape[:2] == (3, 4) else None


def _of_text(text: str) -> Array | None:
    rows = []
    for line in text.splitlines():
        line = line.split("#", 1)[0].strip()
        if not line:
            continue
        words = [w for w in re.split(r"[\s,;]+", line) if w]
        try:
            rows.append([float(w) for w in words])
        except ValueError:
            return None
    if rows and {len(r) for r in rows} == {12}:
        return np.array(rows).reshape(-1, 3, 4)
    return None


def from_matrices(content: object, given: Given, *, where: str = "the matrices") -> ProjectionMatrices:
    """Matrices of bare numbers; `given` must hold size, pitch and row order."""
    found = matrices_in(content)
    if found is None:
        raise InputError(f"{where} holds no 3 x 4 matrices: (n, 3, 4), rows of twelve numbers, or 3 x 4 x n are read")
    P = numbers(found, (-1, 3, 4), where)
    rows = given.settle("rows", None, where)
    n_u, n_v, p_u, p_v = (given.settle(k, None, where) for k in ("n_u", "n_v", "p_u", "p_v"))
    if not len(P) or not np.linalg.norm(P[:, 2, :3], axis=1).min() > 0:
        raise InputError(f"{where}: a matrix has a third row of zeros; no cone beam")
    _require_panel(P, p_u, p_v, where)
    if rows == "top":
        P = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, n_v - 1.0], [0.0, 0.0, 1.0]]) @ P
    return given.matrices(P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v)


def _require_panel(P: Array, p_u: float, p_v: float, where: str) -> None:
    """InputError where the numbers cannot be matrices of a panel of that pitch, as when they are vectors."""
    with np.errstate(all="ignore"):
        M = P[:, :, :3]
        det = np.linalg.det(M / np.linalg.norm(M, axis=(1, 2), keepdims=True))
        if not (np.abs(det) > 0).all() or not np.isfinite(det).all():
            raise InputError(f"{where}: matrix {int(np.argmin(np.abs(det)))} is singular; no cone beam")
        inverse = np.linalg.inv(M)
    a, b = inverse[:, :, 0], inverse[:, :, 1]
    length_a, length_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    skew = np.abs(np.einsum("ni,ni->n", a, b)) / (length_a * length_b)
    aspect = np.abs((p_u / length_a) / (p_v / length_b) - 1)
    worst = np.maximum(skew, aspect)
    if worst.max() > ROUGH_PANEL:
        k = int(np.argmax(worst))
        raise InputError(
            f"{where}: matrix {k} has no panel of {p_u:g} x {p_v:g} mm pixels (skew {skew[k]:.3g}, aspect error "
            f"{aspect[k]:.3g}); are the twelve numbers ASTRA vectors? --format astra reads those"
        )
