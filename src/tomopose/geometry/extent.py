"""How far points reach: the largest distance between any two of them."""

from __future__ import annotations

import numpy as np

from tomopose.units import Array

BLOCK = 128
"""Neighbours that are compared with others at a time: 16,384 pairs, however many points there are."""


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
    # neighbours in blocks: two blocks whose points cannot be farther apart than what was found are not compared
    blocks = [outer[k : k + BLOCK] for k in range(0, len(outer), BLOCK)]
    middle = np.array([b.mean(axis=0) for b in blocks])
    reach = np.array([np.linalg.norm(b - m, axis=1).max() for b, m in zip(blocks, middle, strict=True)])
    for k, block in enumerate(blocks):
        bound = np.linalg.norm(middle[k:] - middle[k], axis=1) + reach[k:] + reach[k]
        for j in np.argsort(-bound):
            if bound[j] < largest * (1 - 1e-12):
                break
            away = block[:, None] - blocks[k + j][None]
            largest = max(largest, float(np.sqrt(np.einsum("ijk,ijk->ij", away, away).max())))
    return largest
