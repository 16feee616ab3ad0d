"""The ideal detector image of scenes that hold meshes: the same cells as `projector`, filled by drawing triangles.

The rays through the pixels' corners come first.  Pixels that are not smooth list the triangles that touch them, and
each of their cells is sampled on a Fibonacci lattice, the finer the steeper the transmission there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.simulation.objects.mesh import MeshSolid
from tomopose.simulation.physics.attenuation import attenuated
from tomopose.simulation.physics.spectrum import Beam
from tomopose.simulation.projector.cells import (
    HELD,
    LATTICE_5,
    LATTICE_13,
    LATTICE_55,
    LATTICE_233,
    add_moments,
    bows,
    fill_pixel,
    fill_smooth,
    gather_value,
)
from tomopose.simulation.projector.raster import fill, gather, projected, sample, touching
from tomopose.simulation.projector.rays import LARGEST, Compiled
from tomopose.simulation.projector.sampling import KernelScene, WorkSpace, kernel_scene, lengths, work_space
from tomopose.simulation.projector.view import Arrays, View, Window, in_bands

FLAT, STEEP, STEEPEST = 2e-3, 2e-2, 0.1
"""How far the transmission over a pixel may lie from the bilinear one of its corners to count as flat; and from where
on the second and the third lattice are used."""


@njit(cache=True, nogil=True, inline="always")
def _reach(c: KernelScene, u: float, v: float) -> float:
    """Length (mm) of u U + v V + O - s: what one unit of q is worth."""
    eye = c.eye
    x = eye[1, 0] + u * eye[2, 0] + v * eye[3, 0] - eye[0, 0]
    y = eye[1, 1] + u * eye[2, 1] + v * eye[3, 1] - eye[0, 1]
    z = eye[1, 2] + u * eye[2, 2] + v * eye[3, 2] - eye[0, 2]
    return float(np.sqrt(x * x + y * y + z * z))


@njit(cache=True, nogil=True)
def _transmission(c: KernelScene, work: WorkSpace, Q: np.ndarray, L: np.ndarray, u: float, v: float) -> Any:
    """(transmission, signature of the solids) of a ray that has the signed q sums Q (m,) in the meshes."""
    signature = lengths(c, work, u, v)
    if signature == 0 and not Q.any():
        return 1.0, signature
    d = _reach(c, u, v)
    for m in range(len(Q)):
        L[m] = work.L[m] + max(Q[m], 0.0) * d
    return attenuated(c.beam, L), signature


@njit(cache=True, nogil=True)
def _corners(
    c: KernelScene,
    depth: int,
    P: Arrays,
    u_0: float,
    v_0: float,
    j_0: int,
    j_1: int,
    Q: np.ndarray,
    I: np.ndarray,
    seen: np.ndarray,
) -> bool:
    """Transmission and signature of the samples in rows j_0 to j_1; False where a list of crossings overflowed."""
    work, L = work_space(c, depth), np.empty(Q.shape[2])
    fill(P, j_0, j_1, Q, seen)
    for j in range(j_0, j_1):
        for i in range(I.shape[1]):
            I[j, i], signature = _transmission(c, work, Q[j, i], L, u_0 + i, v_0 + j)
            if signature < 0:
                return False
            seen[j, i] += signature
    return True


class Touched(NamedTuple):
    """The triangles that touch each rough pixel: lists[start[j, i]] and the next number[j, i] - 1; see `touching`."""

    rough: np.ndarray
    start: np.ndarray
    number: np.ndarray
    lists: np.ndarray


class Gathered(NamedTuple):
    """What `sample` needs of one pixel's triangles, and the sign of the projection."""

    edges: np.ndarray
    planes: np.ndarray
    columns: np.ndarray
    sign: float


@njit(cache=True, nogil=True)
def _ray(
    c: KernelScene,
    work: WorkSpace,
    k: int,
    near: Gathered,
    Q: np.ndarray,
    L: np.ndarray,
    x: float,
    y: float,
    u_0: float,
    v_0: float,
) -> float:
    """Transmission at the sample (x, y) of the grid, through the k gathered triangles and the solids."""
    Q[:] = 0.0
    sample(k, near.edges, near.planes, near.columns, near.sign, x, y, Q)
    value, _ = _transmission(c, work, Q, L, u_0 + x, v_0 + y)
    return float(value)


@njit(cache=True, nogil=True)
def _rough_cells(
    c: KernelScene,
    depth: int,
    P: Arrays,
    u_0: float,
    v_0: float,
    I: np.ndarray,
    touched: Touched,
    f: int,
    weight: float,
    j_0: int,
    j_1: int,
    out: np.ndarray,
) -> None:
    """Add weight x moments of the cells of rough pixels in rows j_0 to j_1 to `out`."""
    work, h = work_space(c, depth), 1.0 / f
    bow = bows(f)
    Q, L, M = np.empty(len(work.L)), np.empty(len(work.L)), np.empty(HELD)
    most = 1
    for j in range(j_0, j_1):
        most = max(most, touched.number[j].max())
    near = Gathered(np.empty((most, 3, 6)), np.empty((most, 11)), np.empty(most, dtype=np.int64), P[6])
    for j, i in np.argwhere(touched.rough[j_0:j_1]):
        j += j_0
        k, first = touched.number[j, i], touched.start[j, i]
        gather(P, touched.lists[first : first + k], near.edges, near.planes, near.columns)
        f_00, f_01, f_10, f_11 = I[j, i], I[j, i + 1], I[j + 1, i], I[j + 1, i + 1]
        off, bump = 0.0, 0.0
        for q in range(5):
            x, y = LATTICE_5[q, 0] + 0.5, LATTICE_5[q, 1] + 0.5
            value = _ray(c, work, k, near, Q, L, i + x, j + y, u_0, v_0)
            value -= (1 - y) * ((1 - x) * f_00 + x * f_01) + y * ((1 - x) * f_10 + x * f_11)
            off, bump = max(off, abs(value)), bump + value / 5
        if off < FLAT:
            # The mean of x (1 - x) / 2 is 1 / 12.
            fill_pixel(out, j, i, f, weight, bow, f_00, f_01, f_10, f_11, -6 * bump, -6 * bump)
            continue
        points = LATTICE_13 if off < STEEP else LATTICE_55 if off < STEEPEST else LATTICE_233
        n, xy = len(points), (points[:, 0] * points[:, 1]).mean()
        for cell in range(f * f):
            a, b = cell // f, cell % f
            M[:] = 0.0
            for q in range(n):
                x, y = points[q]
                value = _ray(c, work, k, near, Q, L, i + (b + x + 0.5) * h, j + (a + y + 0.5) * h, u_0, v_0)
                gather_value(M, value / n, x, y)
            add_moments(out, j * f + a, i * f + b, weight, f, M, xy, (1 - 1 / n**2) / 12)


def add_mesh_transmission(
    out: np.ndarray,
    window: Window,
    compiled: Compiled | None,
    meshes: tuple[MeshSolid, ...],
    materials: tuple[str, ...],
    beam: Beam,
    view: View,
    T_FW: dict[Frame, RigidTransform],
    *,
    f: int,
    weight: float = 1.0,
    threads: int = 1,
) -> None:
    """Add weight x transmission of meshes and solids to `out`, cells as `projector.add_transmission` describes them.

    materials: names of the beam's columns.
    """
    c = kernel_scene(compiled, beam, view, T_FW)
    depth = 1 if compiled is None else compiled.depth
    u_0, v_0 = window.u_0 - 0.5, window.v_0 - 0.5
    bodies = [(m.mesh, T_FW[m.frame], materials.index(m.material)) for m in meshes]
    P = projected(bodies, view, (u_0, v_0)).arrays
    n_v, n_u = window.n_v, window.n_u
    Q, I = np.zeros((n_v + 1, n_u + 1, len(materials))), np.empty((n_v + 1, n_u + 1))
    seen, rough = np.zeros(I.shape, dtype=np.int64), np.empty((n_v, n_u), dtype=np.bool_)
    fine = [True]

    def corners(lo: int, hi: int) -> None:
        if not _corners(c, depth, P, u_0, v_0, lo, hi, Q, I, seen):
            fine[0] = False

    in_bands(corners, n_v + 1, threads)
    if not fine[0]:
        raise InputError(f"a ray crosses more than {LARGEST} surfaces of one solid; split the solid in several")
    in_bands(lambda lo, hi: fill_smooth(I, seen, f, lo, hi, weight, out, rough), n_v, threads)
    count, start = np.zeros((n_v, n_u), dtype=np.int64), np.zeros((n_v, n_u), dtype=np.int64)
    nothing = np.empty(0, dtype=np.int64)
    in_bands(lambda lo, hi: touching(P, rough, lo, hi, count, start, nothing), n_v, threads)
    start.ravel()[1:] = np.cumsum(count.ravel())[:-1]
    lists = np.empty(int(count.sum()), dtype=np.int64)
    count[:] = 0
    in_bands(lambda lo, hi: touching(P, rough, lo, hi, count, start, lists), n_v, threads)
    touched = Touched(rough=rough, start=start, number=count, lists=lists)
    in_bands(
        lambda lo, hi: _rough_cells(c, depth, P, u_0, v_0, I, touched, f, weight, lo, hi, out),
        n_v,
        threads,
    )
