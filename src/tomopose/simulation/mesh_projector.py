"""The ideal detector image of scenes that hold meshes: the same cells as `projector`, filled by drawing triangles.

The rays through the pixels' corners come first.  Pixels that are not smooth list the triangles that touch them, and
each of their cells is sampled on a Fibonacci lattice, the finer the steeper the transmission there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.attenuate import attenuated
from tomopose.simulation.mesh import MeshSolid
from tomopose.simulation.raster import fill, gather, projected, sample, touching
from tomopose.simulation.rays import LARGEST, Compiled
from tomopose.simulation.sampling import kernel_scene, lengths, work_space
from tomopose.simulation.smooth import add, fill_smooth
from tomopose.simulation.spectrum import Beam
from tomopose.simulation.view import View, Window, in_bands
from tomopose.units import Array

LATTICES = np.array([(5, 3), (13, 8), (89, 55)])
"""Fibonacci lattices (n, k) of a cell."""
STEEP = np.array([2e-3, 2.5e-2])
"""Differences of transmission over a pixel from which on the second and the third lattice are used."""


@njit(cache=True, nogil=True, inline="always")
def _reach(c: Any, u: float, v: float) -> float:
    """Length (mm) of u U + v V + O - s: what one unit of q is worth."""
    s, O, U, V = c[10], c[11], c[12], c[13]
    x = O[0] + u * U[0] + v * V[0] - s[0]
    y = O[1] + u * U[1] + v * V[1] - s[1]
    z = O[2] + u * U[2] + v * V[2] - s[2]
    return float(np.sqrt(x * x + y * y + z * z))


@njit(cache=True, nogil=True)
def _transmission(c: Any, work: Any, Q: Any, L: Any, u: float, v: float) -> Any:
    """(transmission, signature of the solids) of a ray that has the signed q sums Q (m,) in the meshes."""
    signature = lengths(c, work, u, v)
    d = _reach(c, u, v)
    for m in range(len(Q)):
        L[m] = work[2][m] + max(Q[m], 0.0) * d
    return attenuated(c[9], L), signature


@njit(cache=True, nogil=True)
def _corners(
    c: Any, depth: int, P: Any, u_0: float, v_0: float, j_0: int, j_1: int, Q: Any, I: Any, seen: Any
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


@njit(cache=True, nogil=True)
def _rough_cells(
    c: Any,
    depth: int,
    P: Any,
    u_0: float,
    v_0: float,
    I: Any,
    rough: Any,
    start: Any,
    count: Any,
    lists: Any,
    f: int,
    weight: float,
    j_0: int,
    j_1: int,
    out: Any,
) -> None:
    """Add weight x moments of the cells of rough pixels in rows j_0 to j_1 to `out`."""
    work, h = work_space(c, depth), 1.0 / f
    Q, L = np.empty(len(work[2])), np.empty(len(work[2]))
    most = 1
    for j in range(j_0, j_1):
        for i in range(rough.shape[1]):
            most = max(most, count[j, i])
    edges, planes, columns = np.empty((most, 3, 6)), np.empty((most, 7)), np.empty(most, dtype=np.int64)
    for j in range(j_0, j_1):
        for i in range(rough.shape[1]):
            if not rough[j, i]:
                continue
            k = count[j, i]
            gather(P, lists[start[j, i] : start[j, i] + k], edges, planes, columns)
            least = min(I[j, i], I[j, i + 1], I[j + 1, i], I[j + 1, i + 1])
            most_I = max(I[j, i], I[j, i + 1], I[j + 1, i], I[j + 1, i + 1])
            for a in range(f):
                for b in range(f):
                    for level in range(3):
                        if level > 0 and most_I - least < STEEP[level - 1]:
                            continue
                        n, step = LATTICES[level]
                        m = m_u = m_v = m_uv = 0.0
                        for q in range(n):
                            x, y = (q + 0.5) / n, (((q - n // 2) * step + n // 2) % n + 0.5) / n
                            Q[:] = 0.0
                            x_q, y_q = i + (b + x) * h, j + (a + y) * h
                            sample(k, edges, planes, columns, P[6], x_q, y_q, Q)
                            value, _ = _transmission(c, work, Q, L, u_0 + x_q, v_0 + y_q)
                            least, most_I = min(least, value), max(most_I, value)
                            m += value
                            m_u += value * (x - 0.5)
                            m_v += value * (y - 0.5)
                            m_uv += value * (x - 0.5) * (y - 0.5)
                        if level == 2 or most_I - least < STEEP[level]:
                            # Slopes per px of the least-squares bilinear surface: 12 / h times the first moments.
                            s = weight * 12 * f / n
                            add(out, j * f + a, i * f + b, weight * m / n, s * m_u, s * m_v, s * 12 * f * m_uv)
                            break


def add_mesh_transmission(
    out: Any,
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
    in_bands(
        lambda lo, hi: _rough_cells(c, depth, P, u_0, v_0, I, rough, start, count, lists, f, weight, lo, hi, out),
        n_v,
        threads,
    )
