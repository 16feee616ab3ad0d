"""Pixels whose mean follows from the rays through their corners."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

SMOOTH = 2e-4
"""Largest third difference of transmission over the corners that counts as smooth."""


@njit(cache=True, nogil=True)
def _smooth(I: Any, seen: Any, j: int, i: int) -> bool:
    """Whether the pixel with lower corner (j, i) and its eight neighbours see the same surfaces, smoothly."""
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


@njit(cache=True, nogil=True, inline="always")
def add(out: Any, row: int, column: int, m: float, m_u: float, m_v: float, m_uv: float) -> None:
    out[0, row, column] += m
    out[1, row, column] += m_u
    out[2, row, column] += m_v
    out[3, row, column] += m_uv


@njit(cache=True, nogil=True)
def fill_smooth(I: Any, seen: Any, f: int, j_0: int, j_1: int, weight: float, out: Any, rough: Any) -> None:
    """Add weight x moments of the cells of smooth pixels in rows j_0 to j_1 to `out`; mark the others in `rough`."""
    h = 1.0 / f
    # Mean over cell b of x (1 - x) / 2: what bilinear interpolation between the corners misses per unit of curvature.
    bow = np.empty(f)
    for b in range(f):
        lo, hi = b * h, (b + 1) * h
        bow[b] = ((hi**2 - lo**2) / 4 - (hi**3 - lo**3) / 6) / h
    for j in range(j_0, j_1):
        for i in range(I.shape[1] - 1):
            rough[j, i] = not _smooth(I, seen, j, i)
            if rough[j, i]:
                continue
            if seen[j, i] == 0:
                for a in range(f):
                    for b in range(f):
                        out[0, j * f + a, i * f + b] += weight
                continue
            f_00, f_01, f_10, f_11 = I[j, i], I[j, i + 1], I[j + 1, i], I[j + 1, i + 1]
            I_uu = 0.25 * (I[j, i - 1] - f_00 - f_01 + I[j, i + 2] + I[j + 1, i - 1] - f_10 - f_11 + I[j + 1, i + 2])
            I_vv = 0.25 * (I[j - 1, i] - f_00 - f_10 + I[j + 2, i] + I[j - 1, i + 1] - f_01 - f_11 + I[j + 2, i + 1])
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
                    )
