"""Triangle meshes seen from one point: path lengths on a grid of rays by filling triangles, in float64.

A point of a mesh is s + q (u U + v V + O - s): (u, v) is its pixel and 1/q is affine in (u, v) over a triangle.  On a
row of the grid an edge is met where a half-open rule says so, at a place that both of its triangles compute from the
same two corners in the same order.  Each triangle covers the samples between its rising and its falling edge, with
the sign of their order; as every edge of a closed surface rises for one triangle and falls for the other, entries and
exits cancel on every ray exactly, rounding and all: no ray slips through between two triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.errors import OutOfViewError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.simulation.objects.mesh import MeshSolid, TriangleMesh
from tomopose.simulation.projector.view import Arrays, View, Window, in_bands
from tomopose.units import Array

ROOM = 1e-6
"""px; far more than an edge's place is rounded by."""


@dataclass(frozen=True, kw_only=True)
class Projected:
    """Meshes on the panel.

    x, y (n,): corners, px from the grid's origin; h (n,): 1 / q.  faces (k, 3); column (k,): the material's column;
    mark (k,): what a crossing adds to a ray's signature.  sign: 1 where the panel's axes and the rays are
    right-handed, else -1.
    """

    x: Array
    y: Array
    h: Array
    faces: Any
    column: Any
    mark: Any
    sign: float

    @property
    def arrays(self) -> tuple[Any, ...]:
        return self.x, self.y, self.h, self.faces, self.column, self.mark, self.sign


def projected(
    meshes: list[tuple[TriangleMesh, RigidTransform, int]], view: View, origin: tuple[float, float]
) -> Projected:
    """Meshes (mesh, transform to W, material's column) on the panel; origin: the grid's (0, 0) in pixels (u, v)."""
    axes = np.column_stack([view.U, view.V, view.O - view.source])
    corners, faces, column, mark, n = [], [], [], [], 0
    for k, (mesh, T_FW, which) in enumerate(meshes):
        corners.append(np.linalg.solve(axes, (T_FW.apply(mesh.vertices) - view.source).T))
        faces.append(mesh.faces + n)
        column.append(np.full(len(mesh.faces), which))
        mark.append(np.full(len(mesh.faces), 64 ** (k % 10)))
        n += len(mesh.vertices)
    a = np.concatenate(corners, axis=1)
    if (a[2] <= 0).any():
        raise OutOfViewError("the object reaches behind the source; move it away from it or make it smaller")
    return Projected(
        x=a[0] / a[2] - origin[0],
        y=a[1] / a[2] - origin[1],
        h=1 / a[2],
        faces=np.concatenate(faces).astype(np.int64),
        column=np.concatenate(column).astype(np.int64),
        mark=np.concatenate(mark).astype(np.int64),
        sign=float(np.sign(np.linalg.det(axes))),
    )


@njit(cache=True, nogil=True, inline="always")
def held(x: float, low: int, high: int) -> float:
    """x within low .. high, as a float, before it becomes an index: int() of what an edge that is nearly level, or far
    off the panel, gives would be undefined.  NaN gives low."""
    if x >= high:
        return float(high)
    return x if x > low else float(low)


@njit(cache=True, nogil=True, inline="always")
def _edge(x: np.ndarray, y: np.ndarray, a: int, b: int) -> Any:
    """(lower y, upper y, y, x, slope, direction) of the edge from a to b: x(y) = x + (y - y_a) slope, from the corner
    with the smaller number; direction 1 where it rises."""
    rises = 1.0 if y[b] > y[a] else -1.0
    if a > b:
        a, b = b, a
    run = y[b] - y[a]
    slope = (x[b] - x[a]) / run if run != 0.0 else 0.0
    return min(y[a], y[b]), max(y[a], y[b]), y[a], x[a], slope, rises


@njit(cache=True, nogil=True, inline="always")
def _plane(x: np.ndarray, y: np.ndarray, h: np.ndarray, a: int, b: int, c: int) -> Any:
    """(h at corner a, slopes along x and y, least and largest h) of a triangle."""
    area = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
    h_x = h_y = 0.0
    if area != 0.0:
        h_x = ((h[b] - h[a]) * (y[c] - y[a]) - (h[c] - h[a]) * (y[b] - y[a])) / area
        h_y = ((x[b] - x[a]) * (h[c] - h[a]) - (x[c] - x[a]) * (h[b] - h[a])) / area
    return h[a], h_x, h_y, min(h[a], h[b], h[c]), max(h[a], h[b], h[c])


@njit(cache=True, nogil=True, inline="always")
def _sides(edges: Arrays, j: int) -> Any:
    """x of the rising and of the falling edge of a triangle on the line y = j that crosses both."""
    up = down = 0.0
    for e in edges:
        if e[0] <= j < e[1]:
            at = e[3] + (j - e[2]) * e[4]
            up, down = (at, down) if e[5] > 0 else (up, at)
    return up, down


@njit(cache=True, nogil=True, inline="always")
def _reach_in_row(edges: Arrays, j: int) -> Any:
    """(least, largest) x of a triangle's edges between the lines y = j and j + 1; (inf, -inf) where there are no such
    values."""
    left, right = np.inf, -np.inf
    for e in edges:
        # The ends of a level edge belong to the other two.
        if e[1] >= j and e[0] <= j + 1 and e[1] != e[0]:
            at_0 = e[3] + (max(e[0], min(e[1], float(j))) - e[2]) * e[4]
            at_1 = e[3] + (max(e[0], min(e[1], float(j + 1))) - e[2]) * e[4]
            left, right = min(left, at_0, at_1), max(right, at_0, at_1)
    return left, right


@njit(cache=True, nogil=True)
def fill(P: Arrays, j_0: int, j_1: int, Q: np.ndarray, seen: np.ndarray) -> None:
    """Signed sums of q (rows, columns, materials) and signatures of the grid's samples (i, j), rows j_0 to j_1."""
    x, y, h, faces, column, mark, sign = P
    n_u = Q.shape[1]
    for t in range(len(faces)):
        a, b, c = faces[t]
        lo, hi = min(y[a], y[b], y[c]), max(y[a], y[b], y[c])
        first, last = int(np.ceil(held(lo, j_0, j_1))), int(np.ceil(held(hi, j_0, j_1)))
        if first >= last or max(x[a], x[b], x[c]) < 0 or min(x[a], x[b], x[c]) > n_u:
            continue
        h_a, h_x, h_y, least, most = _plane(x, y, h, a, b, c)
        edges = (_edge(x, y, a, b), _edge(x, y, b, c), _edge(x, y, c, a))
        m, s = column[t], mark[t]
        for j in range(first, last):
            up, down = _sides(edges, j)
            left, right, way = (up, down, -sign) if up < down else (down, up, sign)
            here = h_a + (j - y[a]) * h_y
            for i in range(int(np.ceil(held(left, 0, n_u))), int(np.ceil(held(right, 0, n_u)))):
                Q[j, i, m] += way / min(max(here + (i - x[a]) * h_x, least), most)
                seen[j, i] += s


@njit(cache=True, nogil=True)
def touching(
    P: Arrays, wanted: np.ndarray, j_0: int, j_1: int, count: np.ndarray, start: np.ndarray, lists: np.ndarray
) -> None:
    """Count, or where `lists` is not empty write down, the triangles that touch each wanted pixel of rows j_0 to j_1.

    A pixel (i, j) reaches from sample (i, j) to (i + 1, j + 1).
    """
    x, y, _, faces, _, _, _ = P
    n_u = wanted.shape[1]
    for t in range(len(faces)):
        a, b, c = faces[t]
        lo, hi = min(y[a], y[b], y[c]), max(y[a], y[b], y[c])
        first, last = int(held(np.floor(lo), j_0, j_1)), int(held(np.floor(hi) + 1, j_0, j_1))
        if first >= last or max(x[a], x[b], x[c]) < 0 or min(x[a], x[b], x[c]) > n_u:
            continue
        edges = (_edge(x, y, a, b), _edge(x, y, b, c), _edge(x, y, c, a))
        for j in range(first, last):
            left, right = _reach_in_row(edges, j)
            if right < left:
                left, right = min(x[a], x[b], x[c]), max(x[a], x[b], x[c])
            for i in range(int(held(np.floor(left), 0, n_u)), int(held(np.floor(right) + 1, 0, n_u))):
                if not wanted[j, i]:
                    continue
                if len(lists):
                    lists[start[j, i] + count[j, i]] = t
                count[j, i] += 1


@njit(cache=True, nogil=True)
def gather(P: Arrays, triangles: np.ndarray, edges: np.ndarray, planes: np.ndarray, columns: np.ndarray) -> None:
    """What `sample` needs of the listed triangles: edges (k, 3, 6), planes (k, 11), columns (k,)."""
    x, y, h, faces, column, _, _ = P
    for k in range(len(triangles)):
        t = triangles[k]
        a, b, c = faces[t]
        columns[k] = column[t]
        edges[k, 0, :] = _edge(x, y, a, b)
        edges[k, 1, :] = _edge(x, y, b, c)
        edges[k, 2, :] = _edge(x, y, c, a)
        h_a, h_x, h_y, least, most = _plane(x, y, h, a, b, c)
        planes[k, :7] = (x[a], y[a], h_a, h_x, h_y, least, most)
        planes[k, 7:9] = min(x[a], x[b], x[c]), max(x[a], x[b], x[c])
        planes[k, 9:] = min(y[a], y[b], y[c]), max(y[a], y[b], y[c])


@njit(cache=True, nogil=True)
def sample(
    n: int, edges: np.ndarray, planes: np.ndarray, columns: np.ndarray, sign: float, x: float, y: float, Q: np.ndarray
) -> None:
    """Add the signed q of n gathered triangles at (x, y) to Q (m,)."""
    for k in range(n):
        # x on an edge is rounded: the box leaves room for it.
        if not (planes[k, 9] <= y < planes[k, 10] and planes[k, 7] - ROOM <= x <= planes[k, 8] + ROOM):
            continue
        way = 0.0
        for e in range(3):
            if edges[k, e, 0] <= y < edges[k, e, 1]:
                at = edges[k, e, 3] + (y - edges[k, e, 2]) * edges[k, e, 4]
                if at <= x:
                    # Half a turn for each edge to the left: one alone means that the triangle covers the sample.
                    way += edges[k, e, 5]
        if way != 0.0:
            a = planes[k]
            q = a[2] + (x - a[0]) * a[3] + (y - a[1]) * a[4]
            Q[columns[k]] -= sign * way / min(max(q, a[5]), a[6])


def mesh_path_image(
    meshes: tuple[MeshSolid, ...], view: View, T_FW: dict[Frame, RigidTransform], window: Window, *, threads: int = 1
) -> Array:
    """Path lengths (n_v, n_u), mm, through the meshes on the rays to the middles of the window's pixels.

    T_FW: each frame's transform to W.  Raises OutOfViewError where a mesh reaches behind the source.
    """
    P = projected([(m.mesh, T_FW[m.frame], 0) for m in meshes], view, (window.u_0, window.v_0)).arrays
    Q, seen = np.zeros((window.n_v, window.n_u, 1)), np.zeros((window.n_v, window.n_u), dtype=np.int64)
    in_bands(lambda lo, hi: fill(P, lo, hi, Q, seen), window.n_v, threads)
    along_u, along_v, twist = _reach(view, window)
    in_bands(lambda lo, hi: _scale(Q, along_u, along_v, twist, window.v_0, lo, hi), window.n_v, threads)
    return np.asarray(Q[:, :, 0])


def _reach(view: View, window: Window) -> tuple[Array, Array, Array]:
    """along_u (n_u,), along_v (n_v,), twist (n_u,): the square of the length of u U + v V + O - s, mm, is
    along_u + along_v + v twist."""
    u, v = window.u_0 + np.arange(window.n_u), window.v_0 + np.arange(window.n_v)
    g = view.O - view.source
    U, V = view.U, view.V
    return g @ g + 2 * (g @ U) * u + (U @ U) * u * u, 2 * (g @ V) * v + (V @ V) * v * v, 2 * (U @ V) * u


@njit(cache=True, nogil=True)
def _scale(
    Q: np.ndarray, along_u: np.ndarray, along_v: np.ndarray, twist: np.ndarray, v_0: int, j_0: int, j_1: int
) -> None:
    """Sums of q times the length of what q counts, in place, rows j_0 to j_1; most pixels see no mesh."""
    for j in range(j_0, j_1):
        for i in range(Q.shape[1]):
            if Q[j, i, 0] != 0.0:
                Q[j, i, 0] *= np.sqrt(along_u[i] + along_v[j] + twist[i] * (v_0 + j))
