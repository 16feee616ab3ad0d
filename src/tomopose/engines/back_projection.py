"""Voxel-driven back-projection from 3 x 4 matrices.

The image is looked up bilinearly where a voxel's centre falls.  Replicating the rim by one pixel is the bilinear
look-up divided by the weights that lie on the detector, the column sum of SART; beyond it a view contributes nothing.
The vector blocks take the layers that `seen_layers` holds, and only where rounding in float32 cannot carry a look-up
beyond the border (`STEEP`).  Layouts and index rules: layout.py.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from tomopose.engines.layout import BORDER, F32, MARGIN, TILE, Lookup, Support, clip_range, whole_between
from tomopose.engines.vector import BLOCKS, W, back_blocks, back_blocks_inverse_square
from tomopose.kernel_cache import njit

Line: TypeAlias = tuple[float, float, float, float, float, float]
"""a_u, b_u, a_v, b_v, a_w, b_w of `column_image`."""

STEEP = 2.0**20
"""Pixels times w_max / w_min of a column's layers up to which a vector block is used.

With eps = 2^-24 the float32 depth of a call's layers is off by 2 eps w_max at most, the numerator of u (counted from
a pixel of the detector) by 2 eps n w_max, their quotient by 4 eps n w_max / w_min: a quarter of a pixel at the limit.
The border beyond the last seen place is one pixel wide.
"""


@njit(cache=True, nogil=True, inline="always")
def column_image(P: np.ndarray, j: int, x: int, y: int) -> Line:
    """Column (x, y) in view j: layer z is at u = (a_u + b_u z) / w, v = (a_v + b_v z) / w, w = a_w + b_w z."""
    return (
        P[j, 0, 0] * x + P[j, 0, 1] * y + P[j, 0, 3],
        P[j, 0, 2],
        P[j, 1, 0] * x + P[j, 1, 1] * y + P[j, 1, 3],
        P[j, 1, 2],
        P[j, 2, 0] * x + P[j, 2, 1] * y + P[j, 2, 3],
        P[j, 2, 2],
    )


@njit(cache=True, nogil=True)
def seen_layers(line: Line, n_z: int, n_u: int, n_v: int) -> tuple[int, int]:
    """Layers z_0 <= z < z_1 of a column that fall strictly within one pixel of the detector.

    u > -1 is (P_0 + P_2) X > 0, and so on: four linear inequalities in z.  The two of u add up to (n_u + 1) w > 0, so
    that what lies behind the source is not seen.
    """
    a_u, b_u, a_v, b_v, a_w, b_w = line
    # Most columns are seen whole: where both ends are, so is all between, and no division is needed.
    top = n_z - 1
    u, v, w = a_u + b_u * top, a_v + b_v * top, a_w + b_w * top
    if (
        a_u + a_w > 0.0
        and u + w > 0.0
        and n_u * a_w > a_u
        and n_u * w > u
        and a_v + a_w > 0.0
        and v + w > 0.0
        and n_v * a_w > a_v
        and n_v * w > v
    ):
        return 0, n_z
    low, high = clip_range(-1.0, float(n_z), a_u + a_w, b_u + b_w)
    low, high = clip_range(low, high, n_u * a_w - a_u, n_u * b_w - b_u)
    low, high = clip_range(low, high, a_v + a_w, b_v + b_w)
    low, high = clip_range(low, high, n_v * a_w - a_v, n_v * b_w - b_v)
    return whole_between(low, high, n_z)


@njit(cache=True, nogil=True)
def _back_column_vector(
    column: np.ndarray, at: int, line: Line, layers: tuple[int, int], look: Lookup, j: int, scale: float
) -> None:
    """Add view j to layers z_0 <= z < z_1 of a column that begins at column[at]; the column has at least W layers."""
    a_u, b_u, a_v, b_v, a_w, b_w = line
    z_0, z_1 = layers
    n_u, n_v = look.n_u, look.n_v
    row = n_v + 2 * BORDER
    w_0, w_1 = a_w + b_w * z_0, a_w + b_w * (z_1 - 1)
    if not max(w_0, w_1) * max(n_u, n_v) < STEEP * min(w_0, w_1):
        _back_column_plain(column, at, line, layers, look, j, scale)
        return
    middle = 0.5 * (z_0 + z_1 - 1)
    # Counting from a pixel near the column's middle keeps the float32 quotients of a block small, therefore exact.
    reciprocal = 1.0 / (a_w + b_w * middle)
    u_ref = math.floor(min(max((a_u + b_u * middle) * reciprocal, -1.0), float(n_u)))
    v_ref = math.floor(min(max((a_v + b_v * middle) * reciprocal, -1.0), float(n_v)))
    a_u, b_u = a_u - u_ref * a_w, b_u - u_ref * b_w
    a_v, b_v = a_v - v_ref * a_w, b_v - v_ref * b_w
    base = j * look.images.shape[1] + (u_ref + BORDER) * row + v_ref + BORDER
    z = z_0
    while z < z_1:
        start = min(z, z_1 - W)
        start = max(start, 0)  # the column is shorter than a block above z_1: lanes beyond it are cut below
        if start + W > z_1:
            _back_column_plain(column, at, line, (z, z_1), look, j, scale)
            return
        blocks = min((z_1 - start) // W, BLOCKS) if BLOCKS > 1 else 1
        u, v, w = a_u + b_u * start, a_v + b_v * start, a_w + b_w * start
        place = (F32(scale), F32(u), F32(b_u), F32(v), F32(b_v), F32(w), F32(b_w))
        if look.inverse_square:
            back_blocks_inverse_square(column, at + start, look.images, base, np.int32(row), (z - start, blocks), place)
        else:
            back_blocks(column, at + start, look.images, base, np.int32(row), (z - start, blocks), place)
        z = start + blocks * W


@njit(cache=True, nogil=True)
def _back_column_plain(
    column: np.ndarray, at: int, line: Line, layers: tuple[int, int], look: Lookup, j: int, scale: float
) -> None:
    """The same without vectors."""
    a_u, b_u, a_v, b_v, a_w, b_w = line
    images, row = look.images, look.n_v + 2 * BORDER
    for z in range(layers[0], layers[1]):
        reciprocal = 1.0 / (a_w + b_w * z)
        u = min(max((a_u + b_u * z) * reciprocal, -1.0), float(look.n_u)) + BORDER
        v = min(max((a_v + b_v * z) * reciprocal, -1.0), float(look.n_v)) + BORDER
        i, k = int(u), int(v)
        f_u, f_v = F32(u - i), F32(v - k)
        p = i * row + k
        low = images[j, p] + f_v * (images[j, p + 1] - images[j, p])
        high = images[j, p + row] + f_v * (images[j, p + row + 1] - images[j, p + row])
        weight = F32(scale * reciprocal * reciprocal) if look.inverse_square else F32(scale)
        column[at + z] += weight * (low + f_u * (high - low))


@njit(cache=True, nogil=True, inline="always")
def _add_views(
    column: np.ndarray,
    at: int,
    look: Lookup,
    x: int,
    y: int,
    low: int,
    high: int,
    n_z: int,
    scale: float,
    counts: np.ndarray,
) -> None:
    """Add scale times each view's look-up to layers low <= z < high of column (x, y), which begins at column[at].

    counts: (n_z + 1,) gets +1 where the layers begin that a view sees, and -1 where they end; empty: not counted.
    """
    for j in range(len(look.P)):
        line = column_image(look.P, j, x, y)
        z_0, z_1 = seen_layers(line, n_z, look.n_u, look.n_v)
        z_0, z_1 = max(z_0, low), min(z_1, high)
        if z_1 <= z_0:
            continue
        if counts.size:
            counts[z_0] += 1
            counts[z_1] -= 1
        if look.vector:
            _back_column_vector(column, at, line, (z_0, z_1), look, j, scale)
        else:
            _back_column_plain(column, at, line, (z_0, z_1), look, j, scale)


@njit(cache=True, nogil=True, inline="always")
def _add_mean(volume: np.ndarray, at: int, sums: np.ndarray, counts: np.ndarray, n_z: int, scale: float) -> None:
    """Add scale times sums / number of views that see the voxel to a column that begins at volume[at]."""
    seen = 0
    for z in range(n_z):
        seen += counts[z]
        if seen > 0:
            volume[at + z] += F32(scale) * sums[z] / F32(seen)


@njit(cache=True, nogil=True, inline="always")
def _hold_column(volume: np.ndarray, at: int, inside: np.ndarray, first: int, n_z: int, nonnegative: bool) -> None:
    """Zero outside the support (flat, this column from `first` on; empty: none), and where asked for nothing below."""
    if inside.size:
        for z in range(n_z):
            if not inside[first + z]:
                volume[at + z] = 0.0
    if nonnegative:
        for z in range(n_z):
            volume[at + z] = max(volume[at + z], F32(0.0))


@njit(cache=True, nogil=True)
def back_columns(
    volume: np.ndarray,
    shape: tuple[int, int, int],
    look: Lookup,
    mean: bool,
    nonnegative: bool,
    support: Support,
    x_0: int,
    x_1: int,
) -> None:
    """Add views to the columns x_0 <= x < x_1 of a volume.

    volume: flat, with margins; shape: (n_x, n_y, n_z).  Adds look.scale times the sum of the views' look-ups, or with
    `mean` times their mean over the views that see the voxel.
    """
    _n_x, n_y, n_z = shape
    s_y = n_z + MARGIN
    s_x = (n_y + MARGIN) * s_y
    many = mean and len(look.P) > 1
    sums = np.zeros(n_z, dtype=np.float32)
    counts = np.zeros(n_z + 1 if many else 0, dtype=np.int32)
    tiles = (n_y + TILE - 1) // TILE
    width = x_1 - x_0
    for place in range(tiles * width):
        y_0, x = (place // width) * TILE, x_0 + place % width
        for y in range(y_0, min(y_0 + TILE, n_y)):
            at = (x + 1) * s_x + (y + 1) * s_y + 1
            low, high = 0, n_z
            if support.inside.size:
                low, high = support.layers[2 * (x * n_y + y)], support.layers[2 * (x * n_y + y) + 1]
                if high <= low:
                    continue
            if many:
                sums[:] = 0.0
                counts[:] = 0
                _add_views(sums, 0, look, x, y, low, high, n_z, 1.0, counts)
                _add_mean(volume, at, sums, counts, n_z, look.scale)
            else:
                _add_views(volume, at, look, x, y, low, high, n_z, look.scale, counts)
            _hold_column(volume, at, support.inside, (x * n_y + y) * n_z, n_z, nonnegative)
