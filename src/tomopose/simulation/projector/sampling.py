"""Transmission and signature of single rays, and of the rays through the pixels' corners."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable

from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.simulation.physics.attenuation import attenuated
from tomopose.simulation.physics.spectrum import Beam
from tomopose.simulation.projector.rays import LARGEST, Compiled, SolidArrays, trace
from tomopose.simulation.projector.view import Arrays, View, shadow_boxes
from tomopose.units import Array

BLOCK = 4
"""Between every fourth corner rays are interpolated where all around sees the same, smoothly."""
EVEN = 5e-4
"""Largest third difference of transmission over coarse corners that counts as smooth."""


class KernelScene(NamedTuple):
    """What the kernels take of a scene's solids (or of none), its beam and its view.

    eye (4, 3): source s, middle O of pixel (0, 0), steps U and V, all in W, mm: one array, since each costs compile
    time.  boxes (m, 2, 2): shadows of the solids on the panel, px.
    """

    solids: SolidArrays
    beam: Arrays
    eye: Array
    boxes: Array


class WorkSpace(NamedTuple):
    """Work space of `trace`: each band of rows has its own.  L (m,): path lengths of the last ray, per material."""

    T: np.ndarray
    S: np.ndarray
    L: np.ndarray
    active: np.ndarray


NO_SOLIDS = SolidArrays(
    primitives=np.empty((0, 16)), ops=np.empty(0, dtype=np.int64), runs=np.empty((0, 3), dtype=np.int64),
    spheres=np.empty((0, 4)),
)  # fmt: skip


def kernel_scene(compiled: Compiled | None, beam: Beam, view: View, T_FW: dict[Frame, RigidTransform]) -> KernelScene:
    """The kernels' values of one frame; T_FW: each frame's transform to W."""
    if compiled is None:
        solids, boxes = NO_SOLIDS, np.empty((0, 2, 2))
    else:
        solids = compiled.arrays(T_FW)
        boxes = shadow_boxes(list(zip(compiled.frame, compiled.corners, strict=True)), view, T_FW)
    return KernelScene(
        solids=solids, beam=beam.arrays, eye=np.stack([view.source, view.O, view.U, view.V]), boxes=boxes
    )


@register_jitable
def work_space(c: KernelScene, depth: int) -> WorkSpace:
    """Work space for solids whose programs need that depth."""
    return WorkSpace(
        np.empty((depth + 3, LARGEST)),
        np.empty((depth + 3, LARGEST + 1), dtype=np.int64),
        np.empty(c.beam[1].shape[1]),
        np.empty(len(c.boxes), dtype=np.bool_),
    )


@njit(cache=True, nogil=True, inline="always")
def lengths(c: KernelScene, work: WorkSpace, u: float, v: float) -> Any:
    """The signature of the ray through pixel coordinates (u, v); its path lengths are in work.L."""
    nothing = True
    for k in range(len(work.active)):
        box = c.boxes[k]
        work.active[k] = box[0, 0] <= u <= box[1, 0] and box[0, 1] <= v <= box[1, 1]
        nothing = nothing and not work.active[k]
    if nothing:
        work.L[:] = 0.0
        return np.int64(0)
    eye = c.eye
    dx = eye[1, 0] + u * eye[2, 0] + v * eye[3, 0] - eye[0, 0]
    dy = eye[1, 1] + u * eye[2, 1] + v * eye[3, 1] - eye[0, 1]
    dz = eye[1, 2] + u * eye[2, 2] + v * eye[3, 2] - eye[0, 2]
    h = 1 / np.sqrt(dx * dx + dy * dy + dz * dz)
    s_x, s_y, s_z = eye[0, 0], eye[0, 1], eye[0, 2]
    return trace(c.solids, work.active, s_x, s_y, s_z, h * dx, h * dy, h * dz, work.T, work.S, work.L)


@njit(cache=True, nogil=True)
def at(c: KernelScene, work: WorkSpace, u: float, v: float) -> Any:
    """(transmission, signature) at pixel coordinates (u, v)."""
    signature = lengths(c, work, u, v)
    return 1.0 if signature == 0 else attenuated(c.beam, work.L), signature


@njit(cache=True, nogil=True, inline="always")
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


@njit(cache=True, nogil=True, inline="always")
def _cubic(x: float) -> Any:
    """Weights of four samples at -1, 0, 1, 2 by which a cubic through them gives the value at x."""
    return (
        -x * (x - 1) * (x - 2) / 6,
        (x + 1) * (x - 1) * (x - 2) / 2,
        -(x + 1) * x * (x - 2) / 2,
        (x + 1) * x * (x - 1) / 6,
    )


@njit(cache=True, nogil=True, inline="always")
def _interpolated(rough: np.ndarray, J: int, K: int, w_y: Arrays, w_x: Arrays) -> float:
    """The value within coarse corners (J, K) and (J + 1, K + 1) by those weights."""
    total = 0.0
    for a in range(4):
        for b in range(4):
            total += w_y[a] * w_x[b] * rough[J - 1 + a, K - 1 + b]
    return total


@njit(cache=True, nogil=True)
def corners(
    c: KernelScene,
    work: WorkSpace,
    u_0: int,
    v_0: int,
    step: int,
    mask: np.ndarray,
    rough: np.ndarray,
    rough_seen: np.ndarray,
    j_0: int,
    j_1: int,
    I: np.ndarray,
    seen: np.ndarray,
) -> bool:
    """Transmission and signature at every step-th of the pixels' corners, rows j_0 to j_1 of them; False where a list
    overflowed.

    Where step > 1, seen is 0 where nothing is met, or less than may be met.  rough, rough_seen: such corners, BLOCK
    apart, between which rays are interpolated; or arrays of no rows where every ray is to be cast.
    """
    fine = True
    even = np.zeros(I.shape[1] // BLOCK + 1, dtype=np.bool_)
    for j in range(j_0, j_1):
        J, y = j // BLOCK, (j % BLOCK) / BLOCK
        if rough.shape[0] > 0 and (j == j_0 or y == 0):
            for K in range(len(even)):
                even[K] = _even(rough, rough_seen, J, K)
        w_y = _cubic(y)
        for i in range(I.shape[1]):
            I[j, i], seen[j, i] = 1.0, 0
            K = i // BLOCK
            if even[K]:
                w_x = _cubic((i % BLOCK) / BLOCK)
                I[j, i], seen[j, i] = _interpolated(rough, J, K, w_y, w_x), rough_seen[J, K]
            elif mask[step * j, step * i]:
                I[j, i], seen[j, i] = at(c, work, u_0 + step * i - 0.5, v_0 + step * j - 0.5)
                if seen[j, i] < 0:
                    fine = False
                met = 0
                for k in range(len(work.active) if step > 1 else 0):
                    met += work.active[k]
                if step > 1 and met != work.S[-1, -1]:
                    seen[j, i] = 0
    return fine
