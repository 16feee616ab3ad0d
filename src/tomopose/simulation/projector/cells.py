"""What a cell holds, and the cells of pixels whose transmission follows from the rays through their corners.

A cell holds six numbers: mean, slopes along u and v (per px), twist (per px^2), curvatures along u and v (per px^2): of
the surface m + m_u x + m_v y + m_uv x y + m_uu (x^2 - h^2 / 12) / 2 + m_vv (y^2 - h^2 / 12) / 2 nearest to the
transmission over the cell of side h, x and y from its middle; so that an edge keeps its place inside its cell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from tomopose.kernel_cache import njit
from tomopose.units import Array

HELD = 6
"""Numbers of a cell."""
SMOOTH = 1e-3
"""Largest third difference of transmission over the corners that counts as smooth.  Means are exact for cubics; a kink
that hides below it, between facets of a mesh, changes a pixel by a sixteenth of it."""


def fibonacci_lattice(n: int, k: int) -> Array:
    """Points (n, 2) of a cell of side 1 about its middle, (i / n, k i / n mod 1): no straight edge can follow them."""
    i = np.arange(n)
    return np.stack([(i + 0.5) / n - 0.5, (((i - n // 2) * k + n // 2) % n + 0.5) / n - 0.5], axis=1)


LATTICE_5, LATTICE_13 = fibonacci_lattice(5, 3), fibonacci_lattice(13, 8)
LATTICE_55, LATTICE_233 = fibonacci_lattice(55, 34), fibonacci_lattice(233, 144)


@njit(cache=True, nogil=True, inline="always")
def gather_value(M: np.ndarray, value: float, x: float, y: float) -> None:
    """Add a weighted value at (x, y), cell of side 1, to the moments M (6,)."""
    M[0] += value
    M[1] += value * x
    M[2] += value * y
    M[3] += value * x * y
    M[4] += value * x * x
    M[5] += value * y * y


@njit(cache=True, nogil=True, inline="always")
def add(
    out: np.ndarray, row: int, column: int, m: float, m_u: float, m_v: float, m_uv: float, m_uu: float, m_vv: float
) -> None:
    out[0, row, column] += m
    out[1, row, column] += m_u
    out[2, row, column] += m_v
    out[3, row, column] += m_uv
    out[4, row, column] += m_uu
    out[5, row, column] += m_vv


@njit(cache=True, nogil=True)
def add_moments(
    out: np.ndarray, row: int, column: int, weight: float, f: int, M: np.ndarray, xy: float, xx: float
) -> None:
    """Add weight x the surface with moments M over a cell of side 1 / f.

    xy, xx: the points' own means of x y and x^2 (= y^2), 0 and 1/12 where they fill the cell.
    """
    add(
        out,
        row,
        column,
        weight * M[0],
        weight * 12 * f * M[1],
        weight * 12 * f * M[2],
        weight * 144 * f * f * (M[3] - M[0] * xy),
        weight * 360 * f * f * (M[4] - M[0] * xx),
        weight * 360 * f * f * (M[5] - M[0] * xx),
    )


@njit(cache=True, nogil=True, inline="always")
def _smooth(I: np.ndarray, seen: np.ndarray, j: int, i: int) -> bool:
    """Whether the pixel with lower corner (j, i) and its eight neighbours see the same surfaces, and no third
    difference between them exceeds `most`."""
    here = seen[j, i]
    j_0, j_1, i_0, i_1 = max(j - 1, 0), min(j + 2, I.shape[0] - 1), max(i - 1, 0), min(i + 2, I.shape[1] - 1)
    for a in range(j_0, j_1 + 1):
        for b in range(i_0, i_1 + 1):
            if seen[a, b] != here:
                return False
    if here == 0:
        return True
    if j_1 - j_0 < 3 or i_1 - i_0 < 3:
        return False
    for k in range(2):
        if abs(I[j - 1, i + k] - 3 * I[j, i + k] + 3 * I[j + 1, i + k] - I[j + 2, i + k]) > SMOOTH:
            return False
        if abs(I[j + k, i - 1] - 3 * I[j + k, i] + 3 * I[j + k, i + 1] - I[j + k, i + 2]) > SMOOTH:
            return False
    return True


@register_jitable
def bows(f: int) -> Any:
    """Mean over cell b of x (1 - x) / 2: what bilinear interpolation between the corners misses per unit of
    curvature."""
    bow, h = np.empty(f), 1.0 / f
    for b in range(f):
        lo, hi = b * h, (b + 1) * h
        bow[b] = ((hi**2 - lo**2) / 4 - (hi**3 - lo**3) / 6) / h
    return bow


@njit(cache=True, nogil=True)
def fill_pixel(
    out: np.ndarray,
    j: int,
    i: int,
    f: int,
    weight: float,
    bow: np.ndarray,
    f_00: float,
    f_01: float,
    f_10: float,
    f_11: float,
    I_uu: float,
    I_vv: float,
) -> None:
    """Add weight x the cells of pixel (j, i) from f_vu, the transmission at its corners, and its curvatures.

    bow: `bows(f)`.
    """
    h = 1.0 / f
    twist = f_11 - f_10 - f_01 + f_00
    for a in range(f):
        y = (a + 0.5) * h
        for b in range(f):
            x = (b + 0.5) * h
            I_u, I_v = f_01 - f_00 + y * twist, f_10 - f_00 + x * twist
            value = f_00 + x * (f_01 - f_00) + y * I_v - bow[b] * I_uu - bow[a] * I_vv
            add(
                out,
                j * f + a,
                i * f + b,
                weight * value,
                weight * (I_u + (x - 0.5) * I_uu),
                weight * (I_v + (y - 0.5) * I_vv),
                weight * twist,
                weight * I_uu,
                weight * I_vv,
            )


@njit(cache=True, nogil=True, inline="always")
def _add_to_cells(out: np.ndarray, row: int, column: int, f: int, weight: float) -> None:
    """Add weight to the mean of the f x f cells from (row, column) on."""
    for a in range(f):
        for b in range(f):
            out[0, row + a, column + b] += weight


@njit(cache=True, nogil=True)
def fill_smooth(
    I: np.ndarray, seen: np.ndarray, f: int, j_0: int, j_1: int, weight: float, out: np.ndarray, rough: np.ndarray
) -> None:
    """Add weight x moments of the cells of smooth pixels in rows j_0 to j_1 to `out`; mark the others in `rough`."""
    bow = bows(f)
    for j in range(j_0, j_1):
        for i in range(I.shape[1] - 1):
            rough[j, i] = not _smooth(I, seen, j, i)
            if rough[j, i]:
                continue
            if seen[j, i] == 0:
                _add_to_cells(out, j * f, i * f, f, weight)
                continue
            f_00, f_01, f_10, f_11 = I[j, i], I[j, i + 1], I[j + 1, i], I[j + 1, i + 1]
            I_uu = 0.25 * (I[j, i - 1] - f_00 - f_01 + I[j, i + 2] + I[j + 1, i - 1] - f_10 - f_11 + I[j + 1, i + 2])
            I_vv = 0.25 * (I[j - 1, i] - f_00 - f_10 + I[j + 2, i] + I[j - 1, i + 1] - f_01 - f_11 + I[j + 2, i + 1])
            fill_pixel(out, j, i, f, weight, bow, f_00, f_01, f_10, f_11, I_uu, I_vv)
