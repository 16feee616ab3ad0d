"""CPU kernels: voxel-driven back-projection and ray-driven forward projection from 3 x 4 matrices.

Layouts.  A volume is [x, y, z] with a margin of one zero voxel below and two above on every axis (`MARGIN`), so that
a look-up needs no test; z is contiguous because a column of voxels falls on nearly one column of the detector.  An
image is [u, v] with a margin of two replicated pixels (`BORDER`); v is contiguous for the same reason.

Voxel-driven back-projection looks the image up bilinearly where a voxel's centre falls.  Replicating the rim by one
pixel is the bilinear look-up divided by the weights that lie on the detector, the column sum of SART; beyond it a view
contributes nothing.  Forward projection follows Joseph (IEEE Trans. Med. Imaging 1 (1982) 192): planes across the ray's
steepest axis, bilinear within each.  Both work for rays of any direction.  Geometry is float64 down to one block of
voxels or rays, data float32.

Indices.  No index is made from a number that was not first held, as a float, within the array that it addresses: a
voxel column that is seen edge-on, or a ray along a face, divides by almost nothing, and int() of such a quotient is
undefined.  NaN gives an empty range.  The vector blocks of back-projection take the layers that `seen_layers` holds,
and only where rounding in float32 cannot carry a look-up beyond the border (`STEEP`).

numba's cache looks at this file only: whoever changes vector.py saves this one as well.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from tomopose.engines.vector import W, back_block, back_block_inverse_square, forward_block

MARGIN = 3
BORDER = 2
TILE = 16
F32 = np.float32
STEEP = 2.0**20
"""Pixels times w_max / w_min of a column's layers up to which a vector block is used.

A block's float32 depth is off by 2 eps w_max at most, eps = 2^-24, its quotient u (counted from a pixel of the
detector) by u (2 eps w_max / w_min + 2 eps) < 4 eps n w_max / w_min: a quarter of a pixel at the limit.  The border
beyond the last seen place is one pixel wide.
"""


class Lookup(NamedTuple):
    """What back-projection looks up, and how: P (m, 3, 4), index to pixel; images (m, flat with border); n_u, n_v;
    scale; inverse_square: divide by w^2; vector: use the vector blocks."""

    P: Any
    images: Any
    n_u: int
    n_v: int
    scale: float
    inverse_square: bool
    vector: bool


class Support(NamedTuple):
    """Where a volume may differ from 0: inside, flat [x, y, z] without margins, 0 where it may not; layers, flat
    [x, y, 2], where that begins and ends in each column.  Both are empty where there is no such restriction."""

    inside: Any
    layers: Any


class Rays(NamedTuple):
    """A view and a grid: shape (n_x, n_y, n_z); spacing (x, y, z), mm; source and M_inv in voxel indices."""

    shape: tuple[int, int, int]
    spacing: Any
    source: Any
    M_inv: Any


class Work(NamedTuple):
    """One block of rays: rays (4 W,) float32, sums (W,) float32, steps (W,) mm."""

    rays: Any
    sums: Any
    steps: Any


@njit(cache=True, nogil=True)
def _clip_range(low: float, high: float, a: float, b: float) -> tuple[float, float]:
    """The part of (low, high) where a + b z > 0; empty, high <= low, where there is no such part or a is NaN."""
    if b > 0.0:
        low = max(low, -a / b)
    elif b < 0.0:
        high = min(high, -a / b)
    elif not a > 0.0:
        high = low
    return low, high


@njit(cache=True, nogil=True)
def _whole_between(low: float, high: float, n: int) -> tuple[int, int]:
    """k_0, k_1: the whole numbers low < k < high, 0 <= k < n, are k_0 <= k < k_1.  None where either is NaN."""
    if not low < high:
        return 0, 0
    low = min(max(low, -1.0), float(n))
    high = min(max(high, -1.0), float(n))
    return max(0, math.floor(low) + 1), min(n, math.ceil(high))


@njit(cache=True, nogil=True)
def seen_layers(P: Any, x: int, y: int, n_z: int, n_u: int, n_v: int) -> tuple[int, int]:
    """Layers z_0 <= z < z_1 of column (x, y) that fall strictly within one pixel of the detector.

    u > -1 is (P_0 + P_2) X > 0, and so on: four linear inequalities in z.  The two of u add up to (n_u + 1) w > 0, so
    that what lies behind the source is not seen.
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
    return _whole_between(low, high, n_z)


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
    detector: tuple[int, int],
    scale: float,
    inverse_square: bool,
) -> None:
    """Add one view to layers z_0 <= z < z_1 of a column that begins at column[at]; the column has at least W layers."""
    a_u = P[0, 0] * x + P[0, 1] * y + P[0, 3]
    a_v = P[1, 0] * x + P[1, 1] * y + P[1, 3]
    a_w = P[2, 0] * x + P[2, 1] * y + P[2, 3]
    n_u, n_v = detector
    row = n_v + 2 * BORDER
    w_0, w_1 = a_w + P[2, 2] * z_0, a_w + P[2, 2] * (z_1 - 1)
    if not max(w_0, w_1) * max(n_u, n_v) < STEEP * min(w_0, w_1):
        _back_column_plain(column, at, P, x, y, z_0, z_1, image, detector, scale, inverse_square)
        return
    middle = 0.5 * (z_0 + z_1 - 1)
    w = a_w + P[2, 2] * middle
    # Counting from a pixel near the column's middle keeps the float32 quotients of a block small, therefore exact.
    reciprocal = 1.0 / w
    u_ref = math.floor(min(max((a_u + P[0, 2] * middle) * reciprocal, -1.0), float(n_u)))
    v_ref = math.floor(min(max((a_v + P[1, 2] * middle) * reciprocal, -1.0), float(n_v)))
    a_u -= u_ref * a_w
    a_v -= v_ref * a_w
    b_u, b_v = P[0, 2] - u_ref * P[2, 2], P[1, 2] - v_ref * P[2, 2]
    base = (u_ref + BORDER) * row + v_ref + BORDER
    z = z_0
    while z < z_1:
        start = min(z, z_1 - W)
        start = max(start, 0)  # the column is shorter than a block above z_1: lanes beyond it are cut below
        if start + W > z_1:
            _back_column_plain(column, at, P, x, y, z, z_1, image, detector, scale, inverse_square)
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
    detector: tuple[int, int],
    scale: float,
    inverse_square: bool,
) -> None:
    """The same without vectors."""
    a_u = P[0, 0] * x + P[0, 1] * y + P[0, 3]
    a_v = P[1, 0] * x + P[1, 1] * y + P[1, 3]
    a_w = P[2, 0] * x + P[2, 1] * y + P[2, 3]
    n_u, n_v = detector
    row = n_v + 2 * BORDER
    for z in range(z_0, z_1):
        reciprocal = 1.0 / (a_w + P[2, 2] * z)
        u = min(max((a_u + P[0, 2] * z) * reciprocal, -1.0), float(n_u)) + BORDER
        v = min(max((a_v + P[1, 2] * z) * reciprocal, -1.0), float(n_v)) + BORDER
        i, j = int(u), int(v)
        f_u, f_v = F32(u - i), F32(v - j)
        p = i * row + j
        low = image[p] + f_v * (image[p + 1] - image[p])
        high = image[p + row] + f_v * (image[p + row + 1] - image[p + row])
        weight = F32(scale * reciprocal * reciprocal) if inverse_square else F32(scale)
        column[at + z] += weight * (low + f_u * (high - low))


@njit(cache=True, nogil=True, inline="always")
def _add_views(
    column: Any, at: int, look: Lookup, x: int, y: int, low: int, high: int, n_z: int, scale: float, counts: Any
) -> None:
    """Add scale times each view's look-up to layers low <= z < high of column (x, y), which begins at column[at].

    counts: (n_z + 1,) gets +1 where the layers begin that a view sees, and -1 where they end; empty: not counted.
    """
    detector = (look.n_u, look.n_v)
    for j in range(len(look.P)):
        z_0, z_1 = seen_layers(look.P[j], x, y, n_z, look.n_u, look.n_v)
        z_0, z_1 = max(z_0, low), min(z_1, high)
        if z_1 <= z_0:
            continue
        if counts.size:
            counts[z_0] += 1
            counts[z_1] -= 1
        if look.vector:
            _back_column_vector(
                column, at, look.P[j], x, y, z_0, z_1, look.images[j], detector, scale, look.inverse_square
            )
        else:
            _back_column_plain(
                column, at, look.P[j], x, y, z_0, z_1, look.images[j], detector, scale, look.inverse_square
            )


@njit(cache=True, nogil=True, inline="always")
def _add_mean(volume: Any, at: int, sums: Any, counts: Any, n_z: int, scale: float) -> None:
    """Add scale times sums / number of views that see the voxel to a column that begins at volume[at]."""
    seen = 0
    for z in range(n_z):
        seen += counts[z]
        if seen > 0:
            volume[at + z] += F32(scale) * sums[z] / F32(seen)


@njit(cache=True, nogil=True, inline="always")
def _hold_column(volume: Any, at: int, inside: Any, first: int, n_z: int, nonnegative: bool) -> None:
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
    volume: Any,
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


@njit(cache=True, nogil=True)
def steepest_axis(d_x: float, d_y: float, d_z: float) -> int:
    """0, 1 or 2: the axis along which a ray moves fastest in voxels; x before y before z where they tie."""
    if abs(d_x) >= abs(d_y) and abs(d_x) >= abs(d_z):
        return 0
    return 1 if abs(d_y) >= abs(d_z) else 2


@njit(cache=True, nogil=True)
def _across(axis: int) -> tuple[int, int]:
    """The two axes across `axis`, the smaller first."""
    return (1 if axis == 0 else 0), (1 if axis == 2 else 2)


@njit(cache=True, nogil=True)
def _direction(d: Any, M_inv: Any, u: int, v: int) -> None:
    """The direction of pixel (u, v)'s ray, in voxel indices, into d (3,)."""
    for i in range(3):
        d[i] = M_inv[i, 0] * u + M_inv[i, 1] * v + M_inv[i, 2]


@njit(cache=True, nogil=True)
def _length(d: Any, spacing: Any) -> float:
    """Length of a direction in voxel indices, mm."""
    return math.sqrt((d[0] * spacing[0]) ** 2 + (d[1] * spacing[1]) ** 2 + (d[2] * spacing[2]) ** 2)


@njit(cache=True, nogil=True)
def _strides(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Steps along x, y, z of a flat volume with margins; their sum is the place of voxel (0, 0, 0)."""
    s_y = shape[2] + MARGIN
    return (shape[1] + MARGIN) * s_y, s_y, 1


@njit(cache=True, nogil=True)
def _planes(low: float, high: float, a: float, slope: float, n: int) -> tuple[float, float]:
    """The part of (low, high) where -1 < a + k slope < n."""
    low, high = _clip_range(low, high, a + 1.0, slope)
    return _clip_range(low, high, n - a, -slope)


@njit(cache=True, nogil=True)
def _ray(source: Any, d: Any, axis: int, shape: Any) -> tuple[int, int, float, float, float, float]:
    """k_0, k_1, a, da, b, db of a ray: positions a + k da, b + k db in the planes k_0 <= k < k_1 across `axis`."""
    first, second = _across(axis)
    da, db = d[first] / d[axis], d[second] / d[axis]
    a, b = source[first] - source[axis] * da, source[second] - source[axis] * db
    low, high = _planes(-1.0, float(shape[axis]), a, da, shape[first])
    low, high = _planes(low, high, b, db, shape[second])
    k_0, k_1 = _whole_between(low, high, shape[axis])
    return k_0, k_1, a, da, b, db


@njit(cache=True, nogil=True)
def _place(position: float, n: int) -> tuple[int, Any]:
    """Whole and fractional part of a position held within [-1, n], where the volume's margin is zero."""
    held = min(max(position, -1.0), float(n)) + 1.0  # not negative: int() rounds towards zero
    i = int(held)
    return i - 1, F32(held - i)


@njit(cache=True, nogil=True)
def _line_integral(volume: Any, rays: Rays, d: Any) -> float:
    """Joseph's sum along the ray of direction d, any axis, mm times the volume's unit."""
    axis = steepest_axis(d[0], d[1], d[2])
    first, second = _across(axis)
    k_0, k_1, a, da, b, db = _ray(rays.source, d, axis, rays.shape)
    strides = _strides(rays.shape)
    start = strides[0] + strides[1] + strides[2]
    s_a, s_b = strides[first], strides[second]
    total: Any = F32(0.0)
    for k in range(k_0, k_1):
        i, f_a = _place(a + k * da, rays.shape[first])
        j, f_b = _place(b + k * db, rays.shape[second])
        p = start + k * strides[axis] + i * s_a + j * s_b
        low = volume[p] + f_b * (volume[p + s_b] - volume[p])
        high = volume[p + s_a] + f_b * (volume[p + s_a + s_b] - volume[p + s_a])
        total += low + f_a * (high - low)
    return total * (_length(d, rays.spacing) / abs(d[axis]))


@njit(cache=True, nogil=True)
def _common_axis(rays: Rays, u: int, v: int, count: int, d: Any) -> int:
    """The steepest axis, x or y, of the `count` rays from pixel (u, v) upwards along v; -1 where they do not share one.

    Directions change linearly with v: what is steepest, with one sign, at both ends is so in between.
    """
    _direction(d, rays.M_inv, u, v)
    axis = steepest_axis(d[0], d[1], d[2])
    forwards = d[axis] > 0.0
    _direction(d, rays.M_inv, u, v + count - 1)
    same = axis == steepest_axis(d[0], d[1], d[2]) and (d[axis] > 0.0) == forwards
    return axis if same and axis < 2 else -1


@njit(cache=True, nogil=True)
def _block_of_rays(
    volume: Any, rays: Rays, axis: int, u: int, v: int, count: int, image: Any, d: Any, work: Work
) -> None:
    """Joseph's sums of `count` <= W rays steepest along `axis` (x or y) into image[u, v : v + count]."""
    table = work.rays
    centre = 0.5 * (rays.shape[axis] - 1)
    k_0, k_1 = rays.shape[axis], 0
    for lane in range(count):
        _direction(d, rays.M_inv, u, v + lane)
        work.steps[lane] = _length(d, rays.spacing) / abs(d[axis])
        low, high, a, da, b, db = _ray(rays.source, d, axis, rays.shape)
        if high > low:
            k_0, k_1 = min(k_0, low), max(k_1, high)
        table[lane], table[W + lane] = a + centre * da, da
        table[2 * W + lane], table[3 * W + lane] = b + centre * db, db
    for lane in range(count, W):  # the block's unused lanes follow its last ray
        for i in range(4):
            table[i * W + lane] = table[i * W + count - 1]
    work.sums[:] = 0.0
    if k_1 > k_0:
        strides = _strides(rays.shape)
        other = 1 - axis
        forward_block(
            volume,
            strides[0] + strides[1] + strides[2],
            strides[axis],
            np.int32(strides[other]),
            table,
            k_0,
            k_1,
            F32(centre),
            F32(rays.shape[other]),
            F32(rays.shape[2]),
            work.sums,
            0,
        )
    for lane in range(count):
        image[u, v + lane] = work.sums[lane] * work.steps[lane]


@njit(cache=True, nogil=True)
def forward_columns(volume: Any, rays: Rays, image: Any, vector: bool, u_0: int, u_1: int) -> None:
    """Line integrals of one view into image[u, v], columns u_0 <= u < u_1, v without border.

    volume: flat, with margins.
    """
    n_v = image.shape[1]
    work = Work(np.zeros(4 * W, dtype=np.float32), np.zeros(W, dtype=np.float32), np.zeros(W))
    d = np.zeros(3)
    for u in range(u_0, u_1):
        for v in range(0, n_v, W):
            count = min(W, n_v - v)
            axis = _common_axis(rays, u, v, count, d) if vector else -1
            if axis >= 0:
                _block_of_rays(volume, rays, axis, u, v, count, image, d, work)
                continue
            for lane in range(count):
                _direction(d, rays.M_inv, u, v + lane)
                image[u, v + lane] = _line_integral(volume, rays, d)


@njit(cache=True, nogil=True)
def _scatter(volume: Any, rays: Rays, d: Any, value: float, axis: int, k_start: int, k_stop: int) -> None:
    """The transpose of `_line_integral` for planes k_start <= k < k_stop of a ray steepest along `axis`."""
    first, second = _across(axis)
    low, high, a, da, b, db = _ray(rays.source, d, axis, rays.shape)
    strides = _strides(rays.shape)
    start = strides[0] + strides[1] + strides[2]
    s_a, s_b = strides[first], strides[second]
    weight = F32(value * _length(d, rays.spacing) / abs(d[axis]))
    for k in range(max(low, k_start), min(high, k_stop)):
        i, f_a = _place(a + k * da, rays.shape[first])
        j, f_b = _place(b + k * db, rays.shape[second])
        p = start + k * strides[axis] + i * s_a + j * s_b
        volume[p] += weight * (F32(1.0) - f_a) * (F32(1.0) - f_b)
        volume[p + s_b] += weight * (F32(1.0) - f_a) * f_b
        volume[p + s_a] += weight * f_a * (F32(1.0) - f_b)
        volume[p + s_a + s_b] += weight * f_a * f_b


@njit(cache=True, nogil=True)
def scatter_planes(volume: Any, rays: Rays, image: Any, axis: int, k_start: int, k_stop: int) -> None:
    """The exact transpose of `forward_columns` for the rays steepest along `axis`, planes k_start <= k < k_stop.

    Threads own planes, so that no two write to one voxel and the order of additions is fixed.  image: [u, v] without
    border.
    """
    d = np.zeros(3)
    for u in range(image.shape[0]):
        for v in range(image.shape[1]):
            value = image[u, v]
            if value == 0.0:
                continue
            _direction(d, rays.M_inv, u, v)
            if steepest_axis(d[0], d[1], d[2]) == axis:
                _scatter(volume, rays, d, value, axis, k_start, k_stop)


@njit(cache=True, nogil=True)
def ray_lengths(rays: Rays, image: Any, u_0: int, u_1: int) -> None:
    """Length, mm, of every ray inside the grid's box, into image[u, v]: Joseph's row sums to within half a plane."""
    d = np.zeros(3)
    for u in range(u_0, u_1):
        for v in range(image.shape[1]):
            _direction(d, rays.M_inv, u, v)
            low, high = 0.0, np.inf
            for i in range(3):
                low, high = _clip_range(low, high, rays.source[i] + 0.5, d[i])
                low, high = _clip_range(low, high, rays.shape[i] - 0.5 - rays.source[i], -d[i])
            image[u, v] = max(high - low, 0.0) * _length(d, rays.spacing)
