"""How the CPU engine stores volumes and images, and which voxels or planes a line of them holds.

Layouts.  A volume is [x, y, z] with a margin of one zero voxel below and two above on every axis (`MARGIN`), so that
a look-up needs no test; z is contiguous because a column of voxels falls on nearly one column of the detector.  An
image is [u, v] with a margin of two replicated pixels (`BORDER`); v is contiguous for the same reason.  Geometry is
float64 down to one block of voxels or rays, data float32.

Indices.  No index is made from a number that was not first held, as a float, within the array that it addresses: a
voxel column that is seen edge-on, or a ray along a face, divides by almost nothing, and int() of such a quotient is
undefined.  NaN gives an empty range.

numba's cache looks at a kernel's own file only: whoever changes this file or vector/ saves back_projection.py and
forward_projection.py as well.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tomopose.kernel_cache import njit

MARGIN = 3
BORDER = 2
TILE = 16
F32 = np.float32


class Lookup(NamedTuple):
    """What back-projection looks up, and how: P (m, 3, 4), index to pixel; images (m, flat with border); n_u, n_v;
    scale; inverse_square: divide by w^2; vector: use the vector blocks."""

    P: np.ndarray
    images: np.ndarray
    n_u: int
    n_v: int
    scale: float
    inverse_square: bool
    vector: bool


class Support(NamedTuple):
    """Where a volume may differ from 0: inside, flat [x, y, z] without margins, 0 where it may not; layers, flat
    [x, y, 2], where that begins and ends in each column.  Both are empty where there is no such restriction."""

    inside: np.ndarray
    layers: np.ndarray


class Rays(NamedTuple):
    """A view and a grid: shape (n_x, n_y, n_z); spacing (x, y, z), mm; source and M_inv in voxel indices."""

    shape: tuple[int, int, int]
    spacing: np.ndarray
    source: np.ndarray
    M_inv: np.ndarray


class Work(NamedTuple):
    """One block of rays: rays (4 W,) float32, sums (W,) float32, steps (W,) mm."""

    rays: np.ndarray
    sums: np.ndarray
    steps: np.ndarray


@njit(cache=True, nogil=True)
def clip_range(low: float, high: float, a: float, b: float) -> tuple[float, float]:
    """The part of (low, high) where a + b z > 0; empty, high <= low, where there is no such part or a is NaN."""
    if b > 0.0:
        low = max(low, -a / b)
    elif b < 0.0:
        high = min(high, -a / b)
    elif not a > 0.0:
        high = low
    return low, high


@njit(cache=True, nogil=True)
def whole_between(low: float, high: float, n: int) -> tuple[int, int]:
    """k_0, k_1: the whole numbers low < k < high, 0 <= k < n, are k_0 <= k < k_1.  None where either is NaN."""
    if not low < high:
        return 0, 0
    low = min(max(low, -1.0), float(n))
    high = min(max(high, -1.0), float(n))
    return max(0, math.floor(low) + 1), min(n, math.ceil(high))
