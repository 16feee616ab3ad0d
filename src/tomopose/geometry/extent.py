"""How far points reach: the largest distance between any two of them."""

from __future__ import annotations

import numpy as np

from tomopose.units import Array

PAIRS = 200_000
"""Pairs compared at a time: a few MB, however many points there are."""


def largest_distance(points: Array) -> float:
    """The largest distance between two of n points (n, d), in their unit; 0 of a single one.

    Exact.  Points too near the middle to end the longest connection are left out first.
    """
    x = np.asarray(points, dtype=np.float64)
    if len(x) < 2:
        return 0.0
    radius = np.linalg.norm(x - x.mean(axis=0), axis=1)
    largest = float(np.linalg.norm(x - x[int(np.argmax(radius))], axis=1).max())
    outer = x[radius + radius.max() >= largest * (1 - 1e-12)]
    rows = max(1, PAIRS // len(outer))
    for start in range(0, len(outer), rows):
        away = outer[start : start + rows, None] - outer[None, start:]
        largest = max(largest, float(np.sqrt(np.einsum("ijk,ijk->ij", away, away).max())))
    return largest
