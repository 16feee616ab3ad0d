"""Lengths of material along the lines from the source through points, by a grid of projected triangles.

In the image of a view a triangle of the mesh is a triangle, and 1 / w, the inverse depth, is linear on it: a line meets
it where its pixel lies in it.  Three signed areas decide that.  They are computed from corners shifted to the pixel, so
that the two triangles at an edge give exactly opposite numbers, and a line that meets an edge meets one of them, never
both or none.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from tomopose.kernel_cache import njit
from tomopose.units import Array

MOST_CELLS = 256
"""Cells along a side of the grid; the number of triangles sets how many are used."""


@njit(cache=True, nogil=True)
def _cells(u: np.ndarray, v: np.ndarray, faces: np.ndarray, G: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(first of each cell (G^2 + 1,), triangles by cell, (u_0, v_0, cells per px in u, in v))."""
    box = np.array([u.min(), v.min(), 0.0, 0.0])
    box[2] = G / max(u.max() - box[0], 1e-12) * (1 - 1e-9)
    box[3] = G / max(v.max() - box[1], 1e-12) * (1 - 1e-9)
    reach = np.empty((len(faces), 4), dtype=np.int32)
    count = np.zeros(G * G + 1, dtype=np.int64)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        reach[f, 0] = int((min(u[a], u[b], u[c]) - box[0]) * box[2])
        reach[f, 1] = int((max(u[a], u[b], u[c]) - box[0]) * box[2])
        reach[f, 2] = int((min(v[a], v[b], v[c]) - box[1]) * box[3])
        reach[f, 3] = int((max(v[a], v[b], v[c]) - box[1]) * box[3])
        for i in range(reach[f, 0], reach[f, 1] + 1):
            for j in range(reach[f, 2], reach[f, 3] + 1):
                count[i * G + j + 1] += 1
    first = np.cumsum(count)
    at = first[:-1].copy()
    held = np.empty(first[-1], dtype=np.int32)
    for f in range(len(faces)):
        for i in range(reach[f, 0], reach[f, 1] + 1):
            for j in range(reach[f, 2], reach[f, 3] + 1):
                held[at[i * G + j]] = f
                at[i * G + j] += 1
    return first, held, box


@njit(cache=True, nogil=True)
def _on_left(a_u: float, a_v: float, b_u: float, b_v: float) -> int:
    """1 or -1: on which side of a -> b the origin lies; the reversed edge always gives the opposite."""
    area = a_u * b_v - a_v * b_u
    if area > 0.0:
        return 1
    if area < 0.0:
        return -1
    return 1 if (a_v < b_v or (a_v == b_v and a_u < b_u)) else -1


@njit(cache=True, nogil=True)
def _view(P: np.ndarray, points: np.ndarray, faces: np.ndarray, x: np.ndarray, L: np.ndarray, w_in: np.ndarray) -> None:
    """Write lengths L (m,), mm, and windings w_in (m,) of one view."""
    n = len(points)
    u, v, w = np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        p = points[k]
        w[k] = P[2, 0] * p[0] + P[2, 1] * p[1] + P[2, 2] * p[2] + P[2, 3]
        u[k] = (P[0, 0] * p[0] + P[0, 1] * p[1] + P[0, 2] * p[2] + P[0, 3]) / w[k]
        v[k] = (P[1, 0] * p[0] + P[1, 1] * p[1] + P[1, 2] * p[2] + P[1, 3]) / w[k]
    G = min(max(int(np.sqrt(len(faces) / 2.0)), 1), MOST_CELLS)
    first, held, box = _cells(u, v, faces, G)
    M = np.ascontiguousarray(P[:, :3])
    back = np.linalg.inv(M)
    leaving = 1.0 if np.linalg.det(M) > 0 else -1.0
    for k in range(len(x)):
        q = x[k]
        depth = P[2, 0] * q[0] + P[2, 1] * q[1] + P[2, 2] * q[2] + P[2, 3]
        a = (P[0, 0] * q[0] + P[0, 1] * q[1] + P[0, 2] * q[2] + P[0, 3]) / depth
        b = (P[1, 0] * q[0] + P[1, 1] * q[1] + P[1, 2] * q[2] + P[1, 3]) / depth
        column, row = (a - box[0]) * box[2], (b - box[1]) * box[3]
        L[k], w_in[k] = 0.0, 0.0
        if not (0.0 <= column < G and 0.0 <= row < G):
            continue
        cell = int(column) * G + int(row)
        total, nearer = 0.0, 0.0
        for h in range(first[cell], first[cell + 1]):
            f = faces[held[h]]
            u_0, v_0, u_1, v_1 = u[f[0]] - a, v[f[0]] - b, u[f[1]] - a, v[f[1]] - b
            u_2, v_2 = u[f[2]] - a, v[f[2]] - b
            side = _on_left(u_1, v_1, u_2, v_2)
            if _on_left(u_2, v_2, u_0, v_0) != side or _on_left(u_0, v_0, u_1, v_1) != side:
                continue
            e_0, e_1, e_2 = u_1 * v_2 - v_1 * u_2, u_2 * v_0 - v_2 * u_0, u_0 * v_1 - v_0 * u_1
            area = e_0 + e_1 + e_2
            if area == 0.0:
                continue
            hit = area / (e_0 / w[f[0]] + e_1 / w[f[1]] + e_2 / w[f[2]])
            total += leaving * side * hit
            if hit < depth:
                nearer -= leaving * side
        d = back @ np.array([a, b, 1.0])
        L[k], w_in[k] = total * np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2), nearer


@njit(cache=True, nogil=True)
def _views(
    P: np.ndarray, points: np.ndarray, faces: np.ndarray, x: np.ndarray, L: np.ndarray, winding: np.ndarray
) -> None:
    for j in range(len(P)):
        _view(P[j], points, faces, x, L[j], winding[j])


def material_paths(P: Array, points: Array, faces: np.ndarray, x: Array) -> tuple[Array, Array]:
    """(L, winding), (n, m) each, of the lines from the source of each view through points.

    P:       (n, 3, 4), |P[2, :3]| = 1, w > 0 at every corner of the mesh.
    points, faces: a closed mesh, (p, 3) mm and (f, 3), counter-clockwise seen from outside.
    x:       (m, 3) mm.
    L:       length of material on the whole line, mm;  winding: 1 where x lies in the material, 0 outside; anything
             else says that shells overlap or look inwards.
    """
    P, points, x = (np.ascontiguousarray(a, dtype=np.float64) for a in (P, points, x))
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    L, winding = np.empty((len(P), len(x))), np.empty((len(P), len(x)))
    workers = min(os.cpu_count() or 1, max(len(P) // 16, 1))
    edges = np.linspace(0, len(P), workers + 1).astype(int)
    with ThreadPoolExecutor(workers) as pool:
        parts = [slice(a, b) for a, b in pairwise(edges)]
        list(pool.map(lambda s: _views(P[s], points, faces, x, L[s], winding[s]), parts))
    return L, winding
