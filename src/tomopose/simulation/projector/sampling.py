"""Transmission and signature of single rays, and of the rays through the pixels' corners."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.physics.attenuation import attenuated
from tomopose.simulation.physics.spectrum import Beam
from tomopose.simulation.projector.rays import LARGEST, Compiled, trace
from tomopose.simulation.projector.view import Arrays, View, shadow_boxes

BLOCK = 4
"""Between every fourth corner rays are interpolated where all around sees the same, smoothly."""
EVEN = 5e-4
"""Largest third difference of transmission over coarse corners that counts as smooth."""


def kernel_scene(compiled: Compiled | None, beam: Beam, view: View, T_FW: dict[Frame, RigidTransform]) -> Any:
    """What the kernels take of a scene's solids (or of none), its beam and its view; boxes of shadows come last."""
    parts: tuple[Any, ...]
    if compiled is None:
        none = np.empty(0, dtype=np.int64)
        parts = (none, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3)), none, np.zeros(1, dtype=np.int64))
        parts += (none, np.empty((0, 3)), np.empty(0))
        boxes = np.empty((0, 2, 2))
    else:
        R, t, centre = compiled.in_world(T_FW)
        parts = (compiled.kind, compiled.p, R, t, compiled.ops, compiled.first, compiled.material, centre)
        parts += (compiled.radius,)
        boxes = shadow_boxes(list(zip(compiled.frame, compiled.corners, strict=True)), view, T_FW)
    return (*parts, beam.arrays, view.source, view.O, view.U, view.V, boxes)


@njit(cache=True, nogil=True)
def work_space(c: Arrays, depth: int) -> Any:
    """(T, S, L, active) for `trace`: each band of rows has its own."""
    mu, boxes = c[9][1], c[14]
    return (
        np.empty((depth + 3, LARGEST)),
        np.empty((depth + 3, LARGEST + 1), dtype=np.int64),
        np.empty(mu.shape[1]),
        np.empty(len(boxes), dtype=np.bool_),
    )


@njit(cache=True, nogil=True)
def lengths(c: Arrays, work: Arrays, u: float, v: float) -> Any:
    """The signature of the ray through pixel coordinates (u, v); its path lengths are in work[2]."""
    kind, p, R, t, ops, first, material, centre, radius, _, s, O, U, V, boxes = c
    T, S, L, active = work
    nothing = True
    for k in range(len(active)):
        active[k] = boxes[k, 0, 0] <= u <= boxes[k, 1, 0] and boxes[k, 0, 1] <= v <= boxes[k, 1, 1]
        nothing = nothing and not active[k]
    if nothing:
        L[:] = 0.0
        return np.int64(0)
    dx, dy, dz = (
        O[0] + u * U[0] + v * V[0] - s[0],
        O[1] + u * U[1] + v * V[1] - s[1],
        O[2] + u * U[2] + v * V[2] - s[2],
    )
    h = 1 / np.sqrt(dx * dx + dy * dy + dz * dz)
    return trace(
        kind, p, R, t, ops, first, material, centre, radius, active, s[0], s[1], s[2], h * dx, h * dy, h * dz, T, S, L
    )


@njit(cache=True, nogil=True)
def at(c: Arrays, work: Arrays, u: float, v: float) -> Any:
    """(transmission, signature) at pixel coordinates (u, v)."""
    signature = lengths(c, work, u, v)
    return 1.0 if signature == 0 else attenuated(c[9], work[2]), signature


@njit(cache=True, nogil=True)
def coarse_corners(
    c: Arrays, depth: int, u_0: int, v_0: int, mask: np.ndarray, j_0: int, j_1: int, I: np.ndarray, seen: np.ndarray
) -> None:
    """Every BLOCK-th corner, rows j_0 to j_1 of them; seen is 0 where nothing is met, or less than may be met."""
    work = work_space(c, depth)
    for j in range(j_0, j_1):
        for i in range(I.shape[1]):
            I[j, i], seen[j, i] = 1.0, 0
            if mask[BLOCK * j, BLOCK * i]:
                I[j, i], seen[j, i] = at(c, work, u_0 + BLOCK * i - 0.5, v_0 + BLOCK * j - 0.5)
                possible = 0
                for k in range(len(work[3])):
                    possible += work[3][k]
                if possible != work[1][-1, -1]:
                    seen[j, i] = 0


@njit(cache=True, nogil=True)
def _even(I: np.ndarray, seen: np.ndarray, j: int, i: int) -> bool:
    """Whether cubic interpolation between coarse corners (j, i) and (j + 1, i + 1) denotes the rays there."""
    if j < 1 or i < 1 or j + 2 >= I.shape[0] or i + 2 >= I.shape[1] or seen[j, i] == 0:
        return False
    for a in range(j - 1, j + 3):
        for b in range(i - 1, i + 3):
            if seen[a, b] != seen[j, i]:
                return False
        if abs(I[a, i - 1] - 3 * I[a, i] + 3 * I[a, i + 1] - I[a, i + 2]) > EVEN:
            return False
    largest = 0.0
    for b in range(i - 1, i + 3):
        largest = max(largest, abs(I[j - 1, b] - 3 * I[j, b] + 3 * I[j + 1, b] - I[j + 2, b]))
    return largest <= EVEN


@njit(cache=True, nogil=True)
def all_corners(
    c: Arrays,
    depth: int,
    u_0: int,
    v_0: int,
    mask: np.ndarray,
    rough: np.ndarray,
    rough_seen: np.ndarray,
    j_0: int,
    j_1: int,
    I: np.ndarray,
    seen: np.ndarray,
) -> bool:
    """Transmission and signature at the pixels' corners, rows j_0 to j_1; False where a list overflowed.

    rough, rough_seen: coarse corners (`coarse_corners`), or arrays of no rows where every ray is to be cast.
    """
    work = work_space(c, depth)
    fine = True
    even = np.zeros(I.shape[1] // BLOCK + 1, dtype=np.bool_)
    for j in range(j_0, j_1):
        J, y = j // BLOCK, (j % BLOCK) / BLOCK
        if j == j_0 or y == 0:
            for K in range(len(even)):
                even[K] = rough.shape[0] > 0 and _even(rough, rough_seen, J, K)
        w_y = (
            -y * (y - 1) * (y - 2) / 6,
            (y + 1) * (y - 1) * (y - 2) / 2,
            -(y + 1) * y * (y - 2) / 2,
            (y + 1) * y * (y - 1) / 6,
        )
        for i in range(I.shape[1]):
            I[j, i], seen[j, i] = 1.0, 0
            K = i // BLOCK
            if even[K]:
                x = (i % BLOCK) / BLOCK
                w_x = (
                    -x * (x - 1) * (x - 2) / 6,
                    (x + 1) * (x - 1) * (x - 2) / 2,
                    -(x + 1) * x * (x - 2) / 2,
                    (x + 1) * x * (x - 1) / 6,
                )
                total = 0.0
                for a in range(4):
                    for b in range(4):
                        total += w_y[a] * w_x[b] * rough[J - 1 + a, K - 1 + b]
                I[j, i], seen[j, i] = total, rough_seen[J, K]
            elif mask[j, i]:
                I[j, i], seen[j, i] = at(c, work, u_0 + i - 0.5, v_0 + j - 0.5)
                if seen[j, i] < 0:
                    fine = False
    return fine
