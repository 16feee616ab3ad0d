r"""The line integrals of a volume and their derivatives by six motions of the object, in one walk along each ray.

Joseph's sum of a ray is step * sum_k f(a_k, b_k) over the planes k across its steepest axis.  A motion of the object
moves the ray the other way, so that a_k and b_k change linearly in k.  Five sums per ray hold everything: of f, of its
slopes along a and b, and of both slopes times k.  The six derivatives follow from them by the chain rule, exactly for
the sum that the engine calculates, not only for the integral that it stands for.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from tomopose.engines.cpu import RAY_COLUMNS
from tomopose.engines.forward_projection import (
    across,
    common_axis,
    held_place,
    mm_length,
    ray_direction,
    ray_planes,
    steepest_axis,
    volume_strides,
)
from tomopose.engines.geometry import index_geometry
from tomopose.engines.layout import F32, Rays
from tomopose.engines.vector import W, derivative_block
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.kernel_cache import njit
from tomopose.units import Floats
from tomopose.volume import VoxelGrid

MOTIONS = 6
"""Translations along x, y, z of W (mm), then turns about x, y, z (rad), through the middle of the grid."""


class Bench(NamedTuple):
    """What one thread works with: rays (4 W,) float32, sums (5 W,) float32, d (3,), turned (3,), answers (6,)."""

    rays: np.ndarray
    sums: np.ndarray
    d: np.ndarray
    moved: np.ndarray
    answers: np.ndarray


@njit(cache=True, nogil=True)
def _chain(sums: np.ndarray, lane: int, rays: Rays, axis: int, centre: float, bench: Bench) -> float:
    """The ray's integral; its derivatives by (t, w) go into bench.answers.  bench.d: the ray's direction."""
    first, second = across(axis)
    d, moved = bench.d, bench.moved
    along = d[axis]
    da, db = d[first] / along, d[second] / along
    lever = centre - rays.source[axis]
    step = mm_length(d, rays.spacing) / abs(along)
    f, f_a, k_a = sums[lane], sums[W + lane], sums[2 * W + lane]
    f_b, k_b = sums[3 * W + lane], sums[4 * W + lane]
    for i in range(3):  # translation along i moves the source by -1 mm along i
        shift = -1.0 / rays.spacing[i]
        if i == axis:
            bench.answers[i] = -step * shift * (f_a * da + f_b * db)
        else:
            bench.answers[i] = step * shift * (f_a if i == first else f_b)
    for i in range(3):  # a turn about i: p -> p - e_i x p, for the source (from the middle) and for the direction
        j, k = (i + 1) % 3, (i + 2) % 3
        middle_j, middle_k = 0.5 * (rays.shape[j] - 1), 0.5 * (rays.shape[k] - 1)
        moved[i] = 0.0
        moved[j] = d[k] * rays.spacing[k] / rays.spacing[j]
        moved[k] = -d[j] * rays.spacing[j] / rays.spacing[k]
        turn_along = moved[axis] / along
        turn_a, turn_b = moved[first] / along - da * turn_along, moved[second] / along - db * turn_along
        moved[j] = (rays.source[k] - middle_k) * rays.spacing[k] / rays.spacing[j]
        moved[k] = -(rays.source[j] - middle_j) * rays.spacing[j] / rays.spacing[k]
        shift_a = moved[first] - moved[axis] * da + lever * turn_a
        shift_b = moved[second] - moved[axis] * db + lever * turn_b
        slopes = f_a * shift_a + k_a * turn_a + f_b * shift_b + k_b * turn_b
        bench.answers[3 + i] = step * (slopes - f * turn_along)
    integral: float = f * step
    return integral


@njit(cache=True, nogil=True)
def _five_sums(volume: np.ndarray, rays: Rays, axis: int, centre: float, bench: Bench) -> None:
    """The five sums of one ray of direction bench.d, any axis, into lane 0 of bench.sums."""
    first, second = across(axis)
    k_0, k_1, a, da, b, db = ray_planes(rays.source, bench.d, axis, rays.shape)
    strides = volume_strides(rays.shape)
    start = strides[0] + strides[1] + strides[2]
    s_a, s_b = strides[first], strides[second]
    f, f_a, k_a, f_b, k_b = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(k_0, k_1):
        i, q_a = held_place(a + k * da, rays.shape[first])
        j, q_b = held_place(b + k * db, rays.shape[second])
        p = start + k * strides[axis] + i * s_a + j * s_b
        rise_low, rise_high = volume[p + s_b] - volume[p], volume[p + s_a + s_b] - volume[p + s_a]
        low, high = volume[p] + q_b * rise_low, volume[p + s_a] + q_b * rise_high
        slope_a, slope_b = high - low, rise_low + q_a * (rise_high - rise_low)
        f += low + q_a * slope_a
        f_a += slope_a
        k_a += (k - centre) * slope_a
        f_b += slope_b
        k_b += (k - centre) * slope_b
    for i, total in enumerate((f, f_a, k_a, f_b, k_b)):
        bench.sums[i * W] = F32(total)


@njit(cache=True, nogil=True)
def _five_sums_of_block(
    volume: np.ndarray, rays: Rays, axis: int, centre: float, u: int, v: int, count: int, bench: Bench
) -> None:
    """The five sums of `count` <= W rays, steepest along `axis` (x or y), from pixel (u, v) upwards."""
    table = bench.rays
    k_0, k_1 = rays.shape[axis], 0
    for lane in range(count):
        ray_direction(bench.d, rays.M_inv, u, v + lane)
        low, high, a, da, b, db = ray_planes(rays.source, bench.d, axis, rays.shape)
        if high > low:
            k_0, k_1 = min(k_0, low), max(k_1, high)
        table[lane], table[W + lane] = a + centre * da, da
        table[2 * W + lane], table[3 * W + lane] = b + centre * db, db
    for lane in range(count, W):
        for i in range(4):
            table[i * W + lane] = table[i * W + count - 1]
    bench.sums[:] = 0.0
    if k_1 > k_0:
        strides = volume_strides(rays.shape)
        start = strides[0] + strides[1] + strides[2]
        ends = (F32(centre), F32(rays.shape[1 - axis]), F32(rays.shape[2]))
        row = np.int32(strides[1 - axis])
        derivative_block(volume, start, strides[axis], row, table, (k_0, k_1), ends, bench.sums)


@njit(cache=True, nogil=True)
def derivative_columns(
    volume: np.ndarray, rays: Rays, image: np.ndarray, J: np.ndarray, vector: bool, u_0: int, u_1: int
) -> None:
    """Line integrals of one view into image[u, v] and derivatives into J[6, u, v], columns u_0 <= u < u_1.

    volume: flat, with margins (layout.py of the engines).
    """
    n_v = image.shape[1]
    bench = Bench(
        np.zeros(4 * W, dtype=np.float32), np.zeros(5 * W, dtype=np.float32), np.zeros(3), np.zeros(3), np.zeros(6)
    )
    for u in range(u_0, u_1):
        for v in range(0, n_v, W):
            count = min(W, n_v - v)
            axis = common_axis(rays, u, v, count, bench.d) if vector else -1
            if axis >= 0:
                _five_sums_of_block(volume, rays, axis, 0.5 * (rays.shape[axis] - 1), u, v, count, bench)
            for lane in range(count):
                ray_direction(bench.d, rays.M_inv, u, v + lane)
                own, place = axis, lane
                if axis < 0:
                    own, place = steepest_axis(bench.d[0], bench.d[1], bench.d[2]), 0
                    _five_sums(volume, rays, own, 0.5 * (rays.shape[own] - 1), bench)
                image[u, v + lane] = _chain(bench.sums, place, rays, own, 0.5 * (rays.shape[own] - 1), bench)
                for i in range(6):
                    J[i, u, v + lane] = bench.answers[i]


def integrals_with_derivatives(
    state: np.ndarray,
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    views: Sequence[int],
    *,
    threads: int = 2,
    vector: bool = True,
) -> tuple[Floats, Floats]:
    """(m, n_v, n_u) line integrals and (m, 6, n_v, n_u) derivatives by the object's motion, float32, v contiguous.

    state: a volume as the CPU engine holds it.  The motion takes a point x of W to c + R(w)(x - c) + t, c the middle
    of the grid; derivatives are by (t, w), mm and rad, at 0.
    """
    geometry, flat = index_geometry(matrices, grid), state.reshape(-1)
    lines = np.empty((len(views), matrices.n_u, matrices.n_v), dtype=np.float32)
    J = np.empty((len(views), MOTIONS, matrices.n_u, matrices.n_v), dtype=np.float32)

    def part(task: tuple[int, int]) -> None:
        at, u_0 = task
        j = views[at]
        rays = Rays(shape=grid.n_xyz, spacing=grid.spacing, source=geometry.source[j], M_inv=geometry.M_inv[j])
        derivative_columns(flat, rays, lines[at], J[at], vector, u_0, min(u_0 + 4 * RAY_COLUMNS, matrices.n_u))

    tasks = [(at, u_0) for at in range(len(views)) for u_0 in range(0, matrices.n_u, 4 * RAY_COLUMNS)]
    with ThreadPoolExecutor(threads, thread_name_prefix="tomopose-refine") as pool:
        list(pool.map(part, tasks))
    return lines.transpose(0, 2, 1), J.transpose(0, 1, 3, 2)
