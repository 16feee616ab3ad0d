"""Grey levels on both sides of an edge, shared with neighbouring edges.

A step fitted with its plateaus free pays for their noise: over a window of 4 sigma on both sides the place scatters a
third more than with known plateaus.  Drift of grey values (beam hardening, scatter, cupping) is slow over some voxels,
so the median of neighbouring edges' plateaus is local enough and far quieter; a mean would be drawn down by the few
next to an edge of the part.  With plateaus a', b' in place of a, b, the
normal equations of the fit move the place by

    ds = -(h_sa (a' - a) + h_sb (b' - b)) / h_ss.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from tomopose.units import Array

MOST = 400
"""Neighbours looked at; a radius of 3 voxels holds about 60."""
SAME_SIDE = 0.7
"""Cosine between normals from which two edges look the same way: not the other side of a wall, not round a corner."""


def neighbour_medians(points: Array, normals: Array, values: Array, radius: float) -> tuple[Array, Array]:
    """Medians (n, c) of values (n, c) over the points (n, 3) within radius, mm, that look the same way, own ones
    included, and how many they are (n,)."""
    low = points.min(axis=0) - radius
    cell = np.floor((points - low) / radius).astype(np.int64)
    size = cell.max(axis=0) + 2
    key = (cell[:, 2] * size[1] + cell[:, 1]) * size[0] + cell[:, 0]
    order = np.argsort(key, kind="stable")
    return _medians(points[order], normals[order], values[order], key[order], size, radius, np.argsort(order))


@njit(cache=True)
def _first(key: Any, wanted: Any) -> Any:
    """First index of sorted key at or above wanted."""
    low, high = 0, key.shape[0]
    while low < high:
        middle = (low + high) // 2
        if key[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, parallel=True)
def _medians(x: Any, n: Any, values: Any, key: Any, size: Any, radius: Any, place: Any) -> Any:
    """As `neighbour_medians`, of points sorted by the key of their cell; place: where each original point is now."""
    m, c = values.shape
    median, count = np.empty((m, c)), np.empty(m)
    for o in prange(m):
        i = place[o]
        near, found = np.empty((c, MOST)), 0
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                # The three cells of a row follow one another.
                row = key[i] + (dz * size[1] + dy) * size[0]
                k = _first(key, row - 1)
                while k < m and key[k] <= row + 1 and found < MOST:
                    square = (x[k, 0] - x[i, 0]) ** 2 + (x[k, 1] - x[i, 1]) ** 2 + (x[k, 2] - x[i, 2]) ** 2
                    alike = n[k, 0] * n[i, 0] + n[k, 1] * n[i, 1] + n[k, 2] * n[i, 2]
                    if square <= radius * radius and alike >= SAME_SIDE:
                        for a in range(c):
                            near[a, found] = values[k, a]
                        found += 1
                    k += 1
        for a in range(c):
            median[o, a] = np.median(near[a, :found])
        count[o] = found
    return median, count
