"""Grey levels on both sides of an edge, shared with neighbouring edges.

A step fitted with its plateaus free pays for their noise: over a window of 4 sigma on both sides the place scatters a
third more than with known plateaus.  Drift of grey values (beam hardening, scatter, cupping) is slow over some voxels,
so the trimmed mean of neighbouring edges' plateaus is local enough and far quieter (a median would be noisier than a
mean by a quarter, and centres with it; a tenth trimmed off at both ends costs 3 %).  Next to an edge of the part, where
plateaus fall within a voxel or two, an edge keeps its own and lends them to none: its neighbours lie on one side.
With plateaus a', b' in place of a, b, the normal equations of the fit move the place by

    ds = -(h_sa (a' - a) + h_sb (b' - b)) / h_ss.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.kernel_cache import njit
from tomopose.units import Array

ONE_SIDED = 0.15
"""Distance of the neighbours' centroid, as a share of the radius, from which they lie on one side."""
UNLIKE = 4.0
"""An edge whose plateau differs from its neighbours' by so many times the usual difference keeps its own."""
TRIMMED = 0.1
"""Share of the neighbours' plateaus that is left out at each end."""
MOST = 400
"""Neighbours looked at; a radius of 3 voxels holds about 60."""
SAME_SIDE = 0.7
"""Cosine between normals from which two edges look the same way: not the other side of a wall, not round a corner."""


def shared_plateaus(points: Array, normals: Array, own: Array, radius: float) -> tuple[Array, Array]:
    """Plateaus (n, 2) of edges at points (n, 3), mm, shared within radius, mm, and how many share them (n,).

    own: (n, 2) as fitted.  Edges at the rim of their neighbourhood, or unlike their neighbours, keep their own.
    """
    low = points.min(axis=0) - radius
    cell = np.floor((points - low) / radius).astype(np.int64)
    size = cell.max(axis=0) + 2
    key = (cell[:, 2] * size[1] + cell[:, 1]) * size[0] + cell[:, 0]
    order = np.argsort(key, kind="stable")
    x, n, values, key = points[order], normals[order], own[order], key[order]
    inner = _inner(x, n, key, size, radius)
    shared, count = _trimmed_means(x, n, values, key, size, radius, inner)
    unlike = np.abs(shared - values)
    usual = MAD_TO_SIGMA * np.median(unlike[inner], axis=0) if inner.any() else np.zeros(2)
    kept = ~inner | (unlike > UNLIKE * usual).any(axis=1)
    shared[kept], count[kept] = values[kept], 1.0
    back = np.argsort(order)
    return shared[back], count[back]


@njit(cache=True)
def _first(key: np.ndarray, wanted: int) -> Any:
    """First index of sorted key at or above wanted."""
    low, high = 0, key.shape[0]
    while low < high:
        middle = (low + high) // 2
        if key[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, inline="always")
def _near(x: Array, n: Array, i: int, k: int, radius: float) -> Any:
    """Whether point k lies within radius of point i and looks the same way."""
    square = (x[k, 0] - x[i, 0]) ** 2 + (x[k, 1] - x[i, 1]) ** 2 + (x[k, 2] - x[i, 2]) ** 2
    return square <= radius * radius and n[k, 0] * n[i, 0] + n[k, 1] * n[i, 1] + n[k, 2] * n[i, 2] >= SAME_SIDE


@njit(cache=True, parallel=True)
def _inner(x: Array, n: Array, key: np.ndarray, size: np.ndarray, radius: float) -> Any:
    """(n,) whether a point's neighbours lie all around it; points are sorted by the key of their cell."""
    m = x.shape[0]
    inner = np.zeros(m, dtype=np.bool_)
    for i in prange(m):
        total, found = np.zeros(3), 0
        for line in range(9):
            # The three cells of a row follow one another; nine rows surround a point.
            row = key[i] + ((line // 3 - 1) * size[1] + line % 3 - 1) * size[0]
            k = _first(key, row - 1)
            while k < m and key[k] <= row + 1:
                if _near(x, n, i, k, radius):
                    found += 1
                    total += x[k] - x[i]
                k += 1
        inner[i] = np.sqrt(np.sum(total * total)) <= ONE_SIDED * radius * found
    return inner


@njit(cache=True, parallel=True)
def _trimmed_means(
    x: Array, n: Array, values: Array, key: np.ndarray, size: np.ndarray, radius: float, lends: np.ndarray
) -> Any:
    """Trimmed means (n, c) of values (n, c) over the neighbours that lend, itself included, and their number (n,)."""
    m, c = values.shape
    mean, count = np.empty((m, c)), np.empty(m)
    for i in prange(m):
        near, found = np.empty((c, MOST)), 1
        for a in range(c):
            near[a, 0] = values[i, a]
        for line in range(9):
            row = key[i] + ((line // 3 - 1) * size[1] + line % 3 - 1) * size[0]
            k = _first(key, row - 1)
            while k < m and key[k] <= row + 1 and found < MOST:
                if k != i and lends[k] and _near(x, n, i, k, radius):
                    near[:, found] = values[k]
                    found += 1
                k += 1
        cut = int(TRIMMED * found)
        for a in range(c):
            mean[i, a] = np.mean(np.sort(near[a, :found])[cut : found - cut])
        count[i] = found
    return mean, count
