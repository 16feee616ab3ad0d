"""CPU kernels: voxel-driven back-projection and ray-driven forward projection from 3 x 4 matrices.

Layouts.  A volume is [x, y, z] with a margin of one zero voxel below and two above on every axis (`MARGIN`), so that
a look-up needs no test; z is contiguous because a column of voxels falls on nearly one column of the detector.  An
image is [u, v] with a margin of two replicated pixels (`BORDER`); v is contiguous for the same reason.

Voxel-driven back-projection looks the image up bilinearly where a voxel's centre falls.  Replicating the rim by one
pixel is the bilinear look-up divided by the weights that lie on the detector, the column sum of SART; beyond it a view
has no say.  Forward projection follows Joseph (IEEE Trans. Med. Imaging 1 (1982) 192): planes across the ray's steepest
axis, bilinear within each.  Both work for rays of any direction.  Geometry is float64 down to one block of voxels or
rays, data float32.

numba's cache looks at this file only: whoever changes vector.py saves this one as well.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from tomopose.engines.vector import W, back_block, back_block_inverse_square, forward_block

MARGIN = 3
BORDER = 2
TILE = 16
F32 = np.float32


@njit(cache=True, nogil=True)
def _clip_range(low: float, high: float, a: float, b: float) -> tuple[float, float]:
    """The part of (low, high) where a + b z > 0."""
    if b > 0.0:
        low = max(low, -a / b)
    elif b < 0.0:
        high = min(high, -a / b)
    elif a <= 0.0:
        high = low
    return low, high


@njit(cache=True, nogil=True)
def seen_layers(P: Any, x: int, y: int, n_z: int, n_u: int, n_v: int) -> tuple[int, int]:
    """Layers z_0 <= z < z_1 of column (x, y) that fall strictly within one pixel of the detector, w > 0 taken as given.

    u > -1 is (P_0 + P_2) X > 0, and so on: four linear inequalities in z.
    """
    a_u, b_u = P[0, 0] * x + P[0, 1] * y + P[0, 3], P[0, 2]
    a_v, b_v = P[1, 0] * x + P[1, 1] * y + P[1, 3], P[1, 2]
    a_w, b_w = P[2, 0] * x + P[2, 1] * y + P[2, 3], P[2, 2]
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
    low, high = _clip_range(-1.0, float(n_z), a_u + a_w, b_u + b_w)
    low, high = _clip_range(low, high, n_u * a_w - a_u, n_u * b_w - b_u)
    low, high = _clip_range(low, high, a_v + a_w, b_v + b_w)
    low, high = _clip_range(low, high, n_v * a_w - a_v, n_v * b_w - b_v)
    return max(0, math.floor(low) + 1), min(n_z, math.ceil(high))


@njit(cache=True, nogil=True)
def _back_column_vector(
    column: Any,
    at: int,
    P: Any,
    x: int,
    y: int,
    z_0: int,
    z_1: int,
    image: Any,
    row: int,
    scale: float,
    inverse_square: bool,
) -> None:
    """Add one view to layers z_0 <= z < z_1 of a column that begins at column[at]; the column has at least W layers."""
    a_u = P[0, 0] * x + P[0, 1] * y + P[0, 3]
    a_v = P[1, 0] * x + P[1, 1] * y + P[1, 3]
    a_w = P[2, 0] * x + P[2, 1] * y + P[2, 3]
    middle = 0.5 * (z_0 + z_1 - 1)
    w = a_w + P[2, 2] * middle
    # Counting from a pixel near the column's middle keeps the float32 quotients of a block small, hence exact.
    reciprocal = 1.0 / w
    u_ref = math.floor((a_u + P[0, 2] * middle) * reciprocal)
    v_ref = math.floor((a_v + P[1, 2] * middle) * reciprocal)
    a_u -= u_ref * a_w
    a_v -= v_ref * a_w
    b_u, b_v = P[0, 2] - u_ref * P[2, 2], P[1, 2] - v_ref * P[2, 2]
    base = (u_ref + BORDER) * row + v_ref + BORDER
    z = z_0
    while z < z_1:
        start = min(z, z_1 - W)
        start = max(start, 0)  # the column is shorter than a block above z_1: lanes beyond it are cut below
        if start + W > z_1:
            _back_column_plain(column, at, P, x, y, z, z_1, image, row, scale, inverse_square)
            return
        first = z - start
        u, v, w = a_u + b_u * start, a_v + b_v * start, a_w + P[2, 2] * start
        if inverse_square:
            back_block_inverse_square(
                column,
                at + start,
                image,
                base,
                np.int32(row),
                np.int32(first),
                F32(scale),
                F32(u),
                F32(b_u),
                F32(v),
                F32(b_v),
                F32(w),
                F32(P[2, 2]),
            )
        else:
            back_block(
                column,
                at + start,
                image,
                base,
                np.int32(row),
                np.int32(first),
                F32(scale),
                F32(u),
                F32(b_u),
                F32(v),
                F32(b_v),
                F32(w),
                F32(P[2, 2]),
            )
        z = start + W


@njit(cache=True, nogil=True)
def _back_column_plain(
    column: Any,
    at: int,
    P: Any,
    x: int,
    y: int,
    z_0: int,
    z_1: int,
    image: Any,
    row: int,
    scale: float,
    inverse_square: bool,
) -> None:
    """The same without vectors."""
    a_u = P[0, 0] * x + P[0, 1] * y + P[0, 3]
    a_v = P[1, 0] * x + P[1, 1] * y + P[1, 3]
    a_w = P[2, 0] * x + P[2, 1] * y + P[2, 3]
    for z in range(z_0, z_1):
        reciprocal = 1.0 / (a_w + P[2, 2] * z)
        u, v = (a_u + P[0, 2] * z) * reciprocal + BORDER, (a_v + P[1, 2] * z) * reciprocal + BORDER
        i, j = int(u), int(v)
        f_u, f_v = F32(u - i), F32(v - j)
        p = i * row + j
        low = image[p] + f_v * (image[p + 1] - image[p])
        high = image[p + row] + f_v * (image[p + row + 1] - image[p + row])
        weight = F32(scale * reciprocal * reciprocal) if inverse_square else F32(scale)
        column[at + z] += weight * (low + f_u * (high - low))


@njit(cache=True, nogil=True)
def back_columns(
    volume: Any,
    shape: Any,
    P: Any,
    images: Any,
    detector: Any,
    scale: float,
    inverse_square: bool,
    mean: bool,
    nonnegative: bool,
    support: Any,
    layers: Any,
    vector: bool,
    x_0: int,
    x_1: int,
) -> None:
    """Add views to the columns x_0 <= x < x_1 of a volume.

    volume: flat, with margins; shape: (n_x, n_y, n_z); P: (m, 3, 4), index to pixel; images: (m, flat with border);
    detector: (n_u, n_v).  Adds scale times the sum of the views' look-ups, or with `mean` scale times their mean over
    the views that see the voxel; `inverse_square` weights each by 1/w^2.  support: flat [x, y, z] without margins, 0
    where a voxel has to stay 0, or empty; layers: flat [x, y, 2], where it begins and ends in each column.
    """
    _n_x, n_y, n_z = shape
    n_u, n_v = detector
    row = n_v + 2 * BORDER
    s_y = n_z + MARGIN
    s_x = (n_y + MARGIN) * s_y
    many = mean and len(P) > 1
    sums = np.zeros(n_z, dtype=np.float32)
    counts = np.zeros(n_z + 1, dtype=np.int32)
    for y_0 in range(0, n_y, TILE):
        for x in range(x_0, x_1):
            for y in range(y_0, min(y_0 + TILE, n_y)):
                at = (x + 1) * s_x + (y + 1) * s_y + 1
                low, high = 0, n_z
                if support.size:
                    low, high = layers[2 * (x * n_y + y)], layers[2 * (x * n_y + y) + 1]
                    if high <= low:
                        continue
                if many:
                    sums[:] = 0.0
                    counts[:] = 0
                for j in range(len(P)):
                    z_0, z_1 = seen_layers(P[j], x, y, n_z, n_u, n_v)
                    z_0, z_1 = max(z_0, low), min(z_1, high)
                    if z_1 <= z_0:
                        continue
                    if many:
                        counts[z_0] += 1
                        counts[z_1] -= 1
                    column, start = (sums, 0) if many else (volume, at)
                    factor = 1.0 if many else scale
                    if vector:
                        _back_column_vector(column, start, P[j], x, y, z_0, z_1, images[j], row, factor, inverse_square)
                    else:
                        _back_column_plain(column, start, P[j], x, y, z_0, z_1, images[j], row, factor, inverse_square)
                if many:
                    seen = 0
                    for z in range(n_z):
                        seen += counts[z]
                        if seen > 0:
                            volume[at + z] += F32(scale) * sums[z] / F32(seen)
                if support.size:
                    inside = (x * n_y + y) * n_z
                    for z in range(low, high):
                        if not support[inside + z]:
                            volume[at + z] = 0.0
                if nonnegative:
                    for z in range(n_z):
                        volume[at + z] = max(volume[at + z], F32(0.0))


@njit(cache=True, nogil=True)
def steepest_axis(d_x: float, d_y: float, d_z: float) -> int:
    """0, 1 or 2: the axis along which a ray moves fastest in voxels; x before y before z where they tie."""
    if abs(d_x) >= abs(d_y) and abs(d_x) >= abs(d_z):
        return 0
    return 1 if abs(d_y) >= abs(d_z) else 2


@njit(cache=True, nogil=True)
def _planes(low: float, high: float, a: float, slope: float, n: int) -> tuple[float, float]:
    """The part of (low, high) where -1 < a + k slope < n."""
    low, high = _clip_range(low, high, a + 1.0, slope)
    return _clip_range(low, high, n - a, -slope)


@njit(cache=True, nogil=True)
def _ray(source: Any, d: Any, axis: int, shape: Any) -> tuple[int, int, float, float, float, float]:
    """k_0, k_1, a, da, b, db of a ray: positions a + k da, b + k db in the planes k_0 <= k < k_1 across `axis`."""
    first, second = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
    da, db = d[first] / d[axis], d[second] / d[axis]
    a, b = source[first] - source[axis] * da, source[second] - source[axis] * db
    low, high = _planes(-1.0, float(shape[axis]), a, da, shape[first])
    low, high = _planes(low, high, b, db, shape[second])
    return max(0, math.floor(low) + 1), min(shape[axis], math.ceil(high)), a, da, b, db


@njit(cache=True, nogil=True)
def _walk(
    volume: Any,
    start: int,
    s_k: int,
    s_a: int,
    s_b: int,
    k_0: int,
    k_1: int,
    a: float,
    da: float,
    b: float,
    db: float,
) -> float:
    """Joseph's sum along one ray, any axis."""
    total: Any = F32(0.0)
    for k in range(k_0, k_1):
        # + 1.0 keeps the arguments of int() positive: the positions are above -1
        p_a, p_b = a + k * da + 1.0, b + k * db + 1.0
        i, j = int(p_a), int(p_b)
        f_a, f_b = F32(p_a - i), F32(p_b - j)
        p = start + k * s_k + (i - 1) * s_a + (j - 1) * s_b
        low = volume[p] + f_b * (volume[p + s_b] - volume[p])
        high = volume[p + s_a] + f_b * (volume[p + s_a + s_b] - volume[p + s_a])
        total += low + f_a * (high - low)
    return total


@njit(cache=True, nogil=True)
def forward_columns(
    volume: Any, shape: Any, spacing: Any, source: Any, M_inv: Any, image: Any, vector: bool, u_0: int, u_1: int
) -> None:
    """Line integrals of one view into image[u, v], columns u_0 <= u < u_1, v without border.

    volume: flat, with margins; source, M_inv in voxel indices; spacing: (x, y, z), mm.
    """
    _n_x, n_y, n_z = shape
    s_y = n_z + MARGIN
    s_x = (n_y + MARGIN) * s_y
    strides = (s_x, s_y, 1)
    start = s_x + s_y + 1
    n_v = image.shape[1]
    rays = np.zeros(4 * W, dtype=np.float32)
    sums = np.zeros(W, dtype=np.float32)
    steps = np.zeros(W)
    d, e = np.zeros(3), np.zeros(3)
    for u in range(u_0, u_1):
        v = 0
        while v < n_v:
            count = min(W, n_v - v)
            # Directions change linearly with v: what is steepest, with one sign, at both ends is so in between.
            for i in range(3):
                d[i] = M_inv[i, 0] * u + M_inv[i, 1] * v + M_inv[i, 2]
                e[i] = d[i] + M_inv[i, 1] * (count - 1)
            axis = steepest_axis(d[0], d[1], d[2])
            together = (
                vector and axis < 2 and axis == steepest_axis(e[0], e[1], e[2]) and (d[axis] > 0.0) == (e[axis] > 0.0)
            )
            k_0, k_1 = shape[0] + shape[1] + shape[2], 0
            for lane in range(count):
                for i in range(3):
                    d[i] = M_inv[i, 0] * u + M_inv[i, 1] * (v + lane) + M_inv[i, 2]
                own = steepest_axis(d[0], d[1], d[2])
                length = math.sqrt((d[0] * spacing[0]) ** 2 + (d[1] * spacing[1]) ** 2 + (d[2] * spacing[2]) ** 2)
                steps[lane] = length / abs(d[own])
                low, high, a, da, b, db = _ray(source, d, own, shape)
                if together:
                    if high > low:
                        k_0, k_1 = min(k_0, low), max(k_1, high)
                    centre = 0.5 * (shape[own] - 1)
                    rays[lane], rays[W + lane] = a + centre * da, da
                    rays[2 * W + lane], rays[3 * W + lane] = b + centre * db, db
                else:
                    first, second = (1 if own == 0 else 0), (1 if own == 2 else 2)
                    total: Any = F32(0.0)
                    if high > low:
                        total = _walk(
                            volume, start, strides[own], strides[first], strides[second], low, high, a, da, b, db
                        )
                    image[u, v + lane] = total * steps[lane]
            if together:
                for lane in range(count, W):  # the block's unused lanes follow its last ray
                    for i in range(4):
                        rays[i * W + lane] = rays[i * W + count - 1]
                sums[:] = 0.0
                if k_1 > k_0:
                    other = 1 - axis
                    forward_block(
                        volume,
                        start,
                        strides[axis],
                        np.int32(strides[other]),
                        rays,
                        k_0,
                        k_1,
                        F32(0.5 * (shape[axis] - 1)),
                        F32(shape[other]),
                        F32(n_z),
                        sums,
                        0,
                    )
                for lane in range(count):
                    image[u, v + lane] = sums[lane] * steps[lane]
            v += count


@njit(cache=True, nogil=True)
def scatter_planes(
    volume: Any, shape: Any, spacing: Any, source: Any, M_inv: Any, image: Any, axis: int, k_start: int, k_stop: int
) -> None:
    """The exact transpose of `forward_columns` for the rays steepest along `axis`, planes k_start <= k < k_stop.

    Threads own planes, so that no two write to one voxel and the order of additions is fixed.  image: [u, v] without
    border.
    """
    _n_x, n_y, n_z = shape
    s_y = n_z + MARGIN
    s_x = (n_y + MARGIN) * s_y
    strides = (s_x, s_y, 1)
    start = s_x + s_y + 1
    first, second = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
    s_k, s_a, s_b = strides[axis], strides[first], strides[second]
    d = np.zeros(3)
    for u in range(image.shape[0]):
        for v in range(image.shape[1]):
            value = image[u, v]
            if value == 0.0:
                continue
            for i in range(3):
                d[i] = M_inv[i, 0] * u + M_inv[i, 1] * v + M_inv[i, 2]
            if steepest_axis(d[0], d[1], d[2]) != axis:
                continue
            low, high, a, da, b, db = _ray(source, d, axis, shape)
            length = math.sqrt((d[0] * spacing[0]) ** 2 + (d[1] * spacing[1]) ** 2 + (d[2] * spacing[2]) ** 2)
            weight = F32(value * length / abs(d[axis]))
            for k in range(max(low, k_start), min(high, k_stop)):
                p_a, p_b = a + k * da + 1.0, b + k * db + 1.0
                i, j = int(p_a), int(p_b)
                f_a, f_b = F32(p_a - i), F32(p_b - j)
                p = start + k * s_k + (i - 1) * s_a + (j - 1) * s_b
                volume[p] += weight * (F32(1.0) - f_a) * (F32(1.0) - f_b)
                volume[p + s_b] += weight * (F32(1.0) - f_a) * f_b
                volume[p + s_a] += weight * f_a * (F32(1.0) - f_b)
                volume[p + s_a + s_b] += weight * f_a * f_b


@njit(cache=True, nogil=True)
def ray_lengths(shape: Any, spacing: Any, source: Any, M_inv: Any, image: Any, u_0: int, u_1: int) -> None:
    """Length, mm, of every ray inside the grid's box, into image[u, v]: Joseph's row sums to within half a plane."""
    d = np.zeros(3)
    for u in range(u_0, u_1):
        for v in range(image.shape[1]):
            low, high = 0.0, np.inf
            for i in range(3):
                d[i] = M_inv[i, 0] * u + M_inv[i, 1] * v + M_inv[i, 2]
                low, high = _clip_range(low, high, source[i] + 0.5, d[i])
                low, high = _clip_range(low, high, shape[i] - 0.5 - source[i], -d[i])
            length = math.sqrt((d[0] * spacing[0]) ** 2 + (d[1] * spacing[1]) ** 2 + (d[2] * spacing[2]) ** 2)
            image[u, v] = max(high - low, 0.0) * length
