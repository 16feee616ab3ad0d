"""Ray-driven forward projection and its exact transpose, by 3 x 4 matrices.

Joseph (IEEE Trans. Med. Imaging 1 (1982) 192): planes across the ray's steepest axis, bilinear within each; for rays of
any direction.  Layouts and index rules: layout.py.
"""

from __future__ import annotations

import math

import numpy as np

from tomopose.engines.layout import F32, MARGIN, Rays, Work, clip_range, whole_between
from tomopose.engines.vector import W, forward_block
from tomopose.kernel_cache import njit


@njit(cache=True, nogil=True)
def steepest_axis(d_x: float, d_y: float, d_z: float) -> int:
    """0, 1 or 2: the axis along which a ray moves fastest in voxels; x before y before z where they tie."""
    if abs(d_x) >= abs(d_y) and abs(d_x) >= abs(d_z):
        return 0
    return 1 if abs(d_y) >= abs(d_z) else 2


@njit(cache=True, nogil=True)
def across(axis: int) -> tuple[int, int]:
    """The two axes across `axis`, the smaller first."""
    return (1 if axis == 0 else 0), (1 if axis == 2 else 2)


@njit(cache=True, nogil=True)
def ray_direction(d: np.ndarray, M_inv: np.ndarray, u: int, v: int) -> None:
    """The direction of pixel (u, v)'s ray, in voxel indices, into d (3,)."""
    for i in range(3):
        d[i] = M_inv[i, 0] * u + M_inv[i, 1] * v + M_inv[i, 2]


@njit(cache=True, nogil=True)
def mm_length(d: np.ndarray, spacing: np.ndarray) -> float:
    """Length of a direction in voxel indices, mm."""
    return math.sqrt((d[0] * spacing[0]) ** 2 + (d[1] * spacing[1]) ** 2 + (d[2] * spacing[2]) ** 2)


@njit(cache=True, nogil=True)
def volume_strides(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Steps along x, y, z of a flat volume with margins; their sum is the place of voxel (0, 0, 0)."""
    s_y = shape[2] + MARGIN
    return (shape[1] + MARGIN) * s_y, s_y, 1


@njit(cache=True, nogil=True)
def _planes(low: float, high: float, a: float, slope: float, n: int) -> tuple[float, float]:
    """The part of (low, high) where -1 < a + k slope < n."""
    low, high = clip_range(low, high, a + 1.0, slope)
    return clip_range(low, high, n - a, -slope)


@njit(cache=True, nogil=True)
def ray_planes(
    source: np.ndarray, d: np.ndarray, axis: int, shape: tuple[int, int, int]
) -> tuple[int, int, float, float, float, float]:
    """k_0, k_1, a, da, b, db of a ray: positions a + k da, b + k db in the planes k_0 <= k < k_1 across `axis`."""
    first, second = across(axis)
    da, db = d[first] / d[axis], d[second] / d[axis]
    a, b = source[first] - source[axis] * da, source[second] - source[axis] * db
    low, high = _planes(-1.0, float(shape[axis]), a, da, shape[first])
    low, high = _planes(low, high, b, db, shape[second])
    k_0, k_1 = whole_between(low, high, shape[axis])
    return k_0, k_1, a, da, b, db


@njit(cache=True, nogil=True)
def held_place(position: float, n: int) -> tuple[int, np.float32]:
    """Whole and fractional part of a position held within [-1, n], where the volume's margin is zero."""
    held = min(max(position, -1.0), float(n)) + 1.0  # not negative: int() rounds towards zero
    i = int(held)
    return i - 1, F32(held - i)


@njit(cache=True, nogil=True)
def _line_integral(volume: np.ndarray, rays: Rays, d: np.ndarray) -> float:
    """Joseph's sum along the ray of direction d, any axis, mm times the volume's unit."""
    axis = steepest_axis(d[0], d[1], d[2])
    first, second = across(axis)
    k_0, k_1, a, da, b, db = ray_planes(rays.source, d, axis, rays.shape)
    strides = volume_strides(rays.shape)
    start = strides[0] + strides[1] + strides[2]
    s_a, s_b = strides[first], strides[second]
    total = F32(0.0)
    for k in range(k_0, k_1):
        i, f_a = held_place(a + k * da, rays.shape[first])
        j, f_b = held_place(b + k * db, rays.shape[second])
        p = start + k * strides[axis] + i * s_a + j * s_b
        low = volume[p] + f_b * (volume[p + s_b] - volume[p])
        high = volume[p + s_a] + f_b * (volume[p + s_a + s_b] - volume[p + s_a])
        total += low + f_a * (high - low)
    integral: float = total * (mm_length(d, rays.spacing) / abs(d[axis]))
    return integral


@njit(cache=True, nogil=True)
def common_axis(rays: Rays, u: int, v: int, count: int, d: np.ndarray) -> int:
    """The steepest axis, x or y, of the `count` rays from pixel (u, v) upwards along v; -1 where they do not share one.

    Directions change linearly with v: what is steepest, with one sign, at both ends is so in between.
    """
    ray_direction(d, rays.M_inv, u, v)
    axis = steepest_axis(d[0], d[1], d[2])
    forwards = d[axis] > 0.0
    ray_direction(d, rays.M_inv, u, v + count - 1)
    same = axis == steepest_axis(d[0], d[1], d[2]) and (d[axis] > 0.0) == forwards
    return axis if same and axis < 2 else -1


@njit(cache=True, nogil=True)
def _block_of_rays(
    volume: np.ndarray, rays: Rays, axis: int, u: int, v: int, count: int, image: np.ndarray, d: np.ndarray, work: Work
) -> None:
    """Joseph's sums of `count` <= W rays steepest along `axis` (x or y) into image[u, v : v + count]."""
    table = work.rays
    centre = 0.5 * (rays.shape[axis] - 1)
    k_0, k_1 = rays.shape[axis], 0
    for lane in range(count):
        ray_direction(d, rays.M_inv, u, v + lane)
        work.steps[lane] = mm_length(d, rays.spacing) / abs(d[axis])
        low, high, a, da, b, db = ray_planes(rays.source, d, axis, rays.shape)
        if high > low:
            k_0, k_1 = min(k_0, low), max(k_1, high)
        table[lane], table[W + lane] = a + centre * da, da
        table[2 * W + lane], table[3 * W + lane] = b + centre * db, db
    for lane in range(count, W):  # the block's unused lanes follow its last ray
        for i in range(4):
            table[i * W + lane] = table[i * W + count - 1]
    work.sums[:] = 0.0
    if k_1 > k_0:
        strides = volume_strides(rays.shape)
        other = 1 - axis
        start = strides[0] + strides[1] + strides[2]
        ends = (F32(centre), F32(rays.shape[other]), F32(rays.shape[2]))
        forward_block(volume, start, strides[axis], np.int32(strides[other]), table, (k_0, k_1), ends, work.sums)
    for lane in range(count):
        image[u, v + lane] = work.sums[lane] * work.steps[lane]


@njit(cache=True, nogil=True)
def forward_columns(volume: np.ndarray, rays: Rays, image: np.ndarray, vector: bool, u_0: int, u_1: int) -> None:
    """Line integrals of one view into image[u, v], columns u_0 <= u < u_1, v without border.

    volume: flat, with margins.
    """
    n_v = image.shape[1]
    work = Work(np.zeros(4 * W, dtype=np.float32), np.zeros(W, dtype=np.float32), np.zeros(W))
    d = np.zeros(3)
    for u in range(u_0, u_1):
        for v in range(0, n_v, W):
            count = min(W, n_v - v)
            axis = common_axis(rays, u, v, count, d) if vector else -1
            if axis >= 0:
                _block_of_rays(volume, rays, axis, u, v, count, image, d, work)
                continue
            for lane in range(count):
                ray_direction(d, rays.M_inv, u, v + lane)
                image[u, v + lane] = _line_integral(volume, rays, d)


@njit(cache=True, nogil=True)
def _scatter(volume: np.ndarray, rays: Rays, d: np.ndarray, value: float, axis: int, k_start: int, k_stop: int) -> None:
    """The transpose of `_line_integral` for planes k_start <= k < k_stop of a ray steepest along `axis`."""
    first, second = across(axis)
    low, high, a, da, b, db = ray_planes(rays.source, d, axis, rays.shape)
    strides = volume_strides(rays.shape)
    start = strides[0] + strides[1] + strides[2]
    s_a, s_b = strides[first], strides[second]
    weight = F32(value * mm_length(d, rays.spacing) / abs(d[axis]))
    for k in range(max(low, k_start), min(high, k_stop)):
        i, f_a = held_place(a + k * da, rays.shape[first])
        j, f_b = held_place(b + k * db, rays.shape[second])
        p = start + k * strides[axis] + i * s_a + j * s_b
        volume[p] += weight * (F32(1.0) - f_a) * (F32(1.0) - f_b)
        volume[p + s_b] += weight * (F32(1.0) - f_a) * f_b
        volume[p + s_a] += weight * f_a * (F32(1.0) - f_b)
        volume[p + s_a + s_b] += weight * f_a * f_b


@njit(cache=True, nogil=True)
def scatter_planes(volume: np.ndarray, rays: Rays, image: np.ndarray, axis: int, k_start: int, k_stop: int) -> None:
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
            ray_direction(d, rays.M_inv, u, v)
            if steepest_axis(d[0], d[1], d[2]) == axis:
                _scatter(volume, rays, d, value, axis, k_start, k_stop)


@njit(cache=True, nogil=True)
def ray_lengths(rays: Rays, image: np.ndarray, u_0: int, u_1: int) -> None:
    """Length, mm, of every ray inside the grid's box, into image[u, v]: Joseph's row sums to within half a plane."""
    d = np.zeros(3)
    for u in range(u_0, u_1):
        for v in range(image.shape[1]):
            ray_direction(d, rays.M_inv, u, v)
            low, high = 0.0, np.inf
            for i in range(3):
                low, high = clip_range(low, high, rays.source[i] + 0.5, d[i])
                low, high = clip_range(low, high, rays.shape[i] - 0.5 - rays.source[i], -d[i])
            image[u, v] = max(high - low, 0.0) * mm_length(d, rays.spacing)
