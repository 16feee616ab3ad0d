"""Exact distances of points to a triangle mesh, by a tree of boxes over its triangles.

The nearest place of a triangle is on its face, an edge or a corner; the sign is that of the offset along the face's
normal, the sum of the two faces' normals, or the corner's normal weighted by angles (Baerentzen and Aanaes, IEEE Trans.
Vis. Comput. Graph. 11 (2005) 243): with these it is right wherever the mesh is closed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from tomopose.kernel_cache import njit
from tomopose.units import Array

LEAF = 6
"""Triangles in a box that is not divided further."""
DEPTH = 64


@njit(cache=True)
def build_tree(low: Array, high: Array, middle: Array) -> Any:
    """Boxes of triangles with corners low, high and middle (m, 3), each divided at the median of its longest side.

    Returns order (m,), and for each node: box (N, 6), first and last + 1 in order (N, 2), its second child (N,); the
    first child follows its parent, and a leaf's second child is -1.
    """
    m = low.shape[0]
    order = np.arange(m)
    most = 4 * (m // LEAF + 1) + 1
    box, span = np.empty((most, 6)), np.empty((most, 2), dtype=np.int64)
    second = np.full(most, -1, dtype=np.int64)
    # (first, last + 1, parent that must know where its second child is, or -1)
    stack = [(0, m, -1)]
    n = 0
    while len(stack) > 0:
        first, last, parent = stack.pop()
        if parent >= 0:
            second[parent] = n
        span[n, 0], span[n, 1] = first, last
        axis, widest = 0, -1.0
        for a in range(3):
            bottom, top, m_low, m_high = np.inf, -np.inf, np.inf, -np.inf
            for k in range(first, last):
                f = order[k]
                bottom, top = min(bottom, low[f, a]), max(top, high[f, a])
                m_low, m_high = min(m_low, middle[f, a]), max(m_high, middle[f, a])
            box[n, a], box[n, 3 + a] = bottom, top
            if m_high - m_low > widest:
                axis, widest = a, m_high - m_low
        if last - first > LEAF:
            part = order[first:last].copy()
            order[first:last] = part[np.argsort(middle[part, axis])]
            half = (first + last) // 2
            stack.append((half, last, n))
            stack.append((first, half, -1))
        n += 1
    return order, box[:n].copy(), span[:n].copy(), second[:n].copy()


@njit(cache=True, inline="always")
def _box_distance(box: Array, node: int, x: float, y: float, z: float) -> Any:
    """Squared distance of a point to a node's box, 0 inside."""
    dx = max(box[node, 0] - x, 0.0, x - box[node, 3])
    dy = max(box[node, 1] - y, 0.0, y - box[node, 4])
    dz = max(box[node, 2] - z, 0.0, z - box[node, 5])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True)
def _nearest(t: Array, x: float, y: float, z: float) -> Any:
    """Nearest place of triangle t (9,), its corners one after the other: offset to the point (3), and which part it
    lies on: 0 face, 1 to 3 edge opposite no corner but ab, bc, ca, 4 to 6 corner a, b, c."""
    ax, ay, az = t[0], t[1], t[2]
    ux, uy, uz = t[3] - ax, t[4] - ay, t[5] - az
    vx, vy, vz = t[6] - ax, t[7] - ay, t[8] - az
    px, py, pz = x - ax, y - ay, z - az
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    if d1 <= 0.0 and d2 <= 0.0:
        return px, py, pz, 4
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    d3, d4 = d1 - uu, d2 - uv
    if d3 >= 0.0 and d4 <= d3:
        return px - ux, py - uy, pz - uz, 5
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s = d1 / (d1 - d3)
        return px - s * ux, py - s * uy, pz - s * uz, 1
    d5, d6 = d1 - uv, d2 - vv
    if d6 >= 0.0 and d5 <= d6:
        return px - vx, py - vy, pz - vz, 6
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s = d2 / (d2 - d6)
        return px - s * vx, py - s * vy, pz - s * vz, 3
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        s = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return px - ux - s * (vx - ux), py - uy - s * (vy - uy), pz - uz - s * (vz - uz), 2
    total = va + vb + vc
    s, r = vb / total, vc / total
    return px - s * ux - r * vx, py - s * uy - r * vy, pz - s * uz - r * vz, 0


@njit(cache=True)
def _nearest_of(corners: Array, first: int, last: int, x: float, y: float, z: float) -> Any:
    """Of the triangles first .. last - 1 the nearest: square of its distance, number, part and offset as `_nearest`."""
    best, where, part = np.inf, 0, 0
    bx, by, bz = 0.0, 0.0, 0.0
    for k in range(first, last):
        dx, dy, dz, on = _nearest(corners[k], x, y, z)
        square = dx * dx + dy * dy + dz * dz
        if square < best:
            best, where, part, bx, by, bz = square, k, on, dx, dy, dz
    return best, where, part, bx, by, bz


@njit(cache=True, parallel=True)
def tree_distances(
    points: Array, corners: Array, order: np.ndarray, box: Array, span: np.ndarray, second: np.ndarray, normals: Array
) -> Any:
    """(n,) signed distances of points (n, 3) to triangles, and which of them, in the tree's order, is nearest: corners
    (m, 9) and normals (m, 7, 3), of the face, its edges ab, bc, ca and its corners, both in the tree's order."""
    n = points.shape[0]
    out, triangle = np.empty(n), np.empty(n, dtype=np.int64)
    for i in prange(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nodes, apart = np.empty(DEPTH, dtype=np.int64), np.empty(DEPTH)
        nodes[0], apart[0], waiting = 0, _box_distance(box, 0, x, y, z), 1
        best, where, part = np.inf, 0, 0
        bx, by, bz = 0.0, 0.0, 0.0
        while waiting > 0:
            waiting -= 1
            node = nodes[waiting]
            if apart[waiting] >= best:
                continue
            other = second[node]
            if other < 0:
                here = _nearest_of(corners, span[node, 0], span[node, 1], x, y, z)
                if here[0] < best:
                    best, where, part, bx, by, bz = here
                continue
            near, far = node + 1, other
            d_near, d_far = _box_distance(box, near, x, y, z), _box_distance(box, far, x, y, z)
            if d_far < d_near:
                near, far, d_near, d_far = far, near, d_far, d_near
            if d_far < best:
                nodes[waiting], apart[waiting] = far, d_far
                waiting += 1
            if d_near < best:
                nodes[waiting], apart[waiting] = near, d_near
                waiting += 1
        along = bx * normals[where, part, 0] + by * normals[where, part, 1] + bz * normals[where, part, 2]
        out[i], triangle[i] = (np.sqrt(best) if along >= 0.0 else -np.sqrt(best)), where
    return out, triangle
