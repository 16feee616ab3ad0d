"""Reference meshes: triangles with normals, sharp edges and elements, mm.

An element is a connected part of the surface between sharp edges: a plane, a cylinder, a bore.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.units import Array, float_array
from tomopose.values import value

SHARP = np.radians(30.0)
"""Angle between neighbouring triangles from which their common edge is an edge of the part."""


@value
class Mesh:
    """points (n, 3) mm; faces (m, 3), counter-clockwise seen from outside."""

    points: Array
    faces: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", float_array(self.points))
        faces = np.array(self.faces, dtype=np.intp)
        faces.setflags(write=False)
        object.__setattr__(self, "faces", faces)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ShapeError(f"a mesh is points (n, 3) and faces (m, 3); got {self.points.shape} and {faces.shape}")
        if not len(faces) or faces.min() < 0 or faces.max() >= len(self.points):
            raise InputError(f"a mesh of {len(self.points)} points has {len(faces)} triangles that do not fit it")
        if not np.isfinite(self.points).all():
            raise InputError("a mesh has points that are not finite")

    @cached_property
    def face_normals(self) -> Array:
        """(m, 3) not normalised: twice the area long."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    @cached_property
    def _unit_face_normals(self) -> Array:
        n = self.face_normals
        result: Array = n / np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None]
        return result

    @cached_property
    def normals(self) -> Array:
        """(n, 3) unit, weighted by the triangles' angles at the vertex."""
        n, out = self._unit_face_normals, np.zeros_like(self.points)
        for k in range(3):
            p, q, r = (self.points[self.faces[:, (k + j) % 3]] for j in range(3))
            u, v = q - p, r - p
            angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("ij,ij->i", u, v))
            for a in range(3):
                out[:, a] += np.bincount(self.faces[:, k], weights=angle * n[:, a], minlength=len(out))
        result: Array = out / np.maximum(np.linalg.norm(out, axis=1), 1e-300)[:, None]
        return result

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Each triangle's three edges ab, bc, ca as one number (3 m,), the same for both triangles that share it, and
        the order (3 m,) that sorts them; edge k of triangle f is entry 3 f + k."""
        ends = np.sort(np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
        key = ends[:, 0].astype(np.int64) * len(self.points) + ends[:, 1]
        return key, np.argsort(key, kind="stable")

    @property
    def open_edges(self) -> int:
        """Edges that do not join exactly two triangles."""
        key, order = self._edges
        begins = np.flatnonzero(np.diff(key[order], prepend=-1))
        return int(np.count_nonzero(np.diff(begins, append=len(key)) != 2))

    @cached_property
    def elements(self) -> np.ndarray:
        """(m,) number of the element that each triangle belongs to."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        pair, sharp = self._neighbours()
        joined = pair[~sharp]
        m = len(self.faces)
        graph = coo_matrix((np.ones(len(joined), dtype=np.int8), (joined[:, 0], joined[:, 1])), shape=(m, m))
        return np.asarray(connected_components(graph, directed=False)[1])

    @cached_property
    def on_edge(self) -> np.ndarray:
        """(n,) True for vertices on a sharp edge."""
        key = self._edges[0][self._shared[0][self._neighbours()[1]]]
        mask = np.zeros(len(self.points), dtype=bool)
        mask[key // len(self.points)] = True
        mask[key % len(self.points)] = True
        return mask

    @property
    def _shared(self) -> tuple[np.ndarray, np.ndarray]:
        """Entries of `_edges` of both sides of each edge that two triangles share."""
        key, order = self._edges
        first = np.flatnonzero(key[order][:-1] == key[order][1:])
        return order[first], order[first + 1]

    def _neighbours(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of triangles (k, 2) that share an edge, and whether the edge is sharp."""
        one, other = self._shared
        pair = np.column_stack([one // 3, other // 3])
        n = self._unit_face_normals
        return pair, np.einsum("ij,ij->i", n[pair[:, 0]], n[pair[:, 1]]) < np.cos(SHARP)

    @cached_property
    def pseudo_normals(self) -> Array:
        """(m, 7, 3) of each triangle: its own unit normal, those of its edges ab, bc, ca (the sum of both neighbours'),
        and of its corners.  Lengths do not matter."""
        n, (one, other) = self._unit_face_normals, self._shared
        out = np.empty((len(self.faces), 7, 3))
        out[:, 0], out[:, 4:] = n, self.normals[self.faces]
        both = np.repeat(n, 3, axis=0)
        both[one] += n[other // 3]
        both[other] += n[one // 3]
        out[:, 1:4] = both.reshape(-1, 3, 3)
        return out

    @property
    def size(self) -> float:
        """Diagonal of the bounding box, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def require_closed(self) -> Mesh:
        """The mesh, if it is watertight with its triangles facing outwards; InputError otherwise."""
        if self.open_edges:
            raise InputError(
                f"the reference mesh is not watertight: {self.open_edges} edges do not join two triangles; repair "
                "it, or export it again with its vertices joined"
            )
        a = self.points[self.faces[:, 0]] - self.points.mean(axis=0)
        if np.einsum("ij,ij->i", a, self.face_normals).sum() <= 0:
            raise InputError("the reference mesh is inside out: its triangles run clockwise from outside; turn them")
        return self


def signed_distances(points: Array, mesh: Mesh) -> Array:
    """(n,) signed distances, mm, of points (n, 3) to the nearest place of a closed mesh; positive outside.

    Exact.  ShapeError for points of another shape, InputError for a mesh that is not closed or faces inwards.
    """
    return nearest_triangles(points, mesh)[0]


def nearest_triangles(points: Array, mesh: Mesh) -> tuple[Array, np.ndarray]:
    """As `signed_distances`, and which triangle (n,) is the nearest."""
    from tomopose.measurement.mesh.distance import build_tree, tree_distances

    x = np.ascontiguousarray(points, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ShapeError(f"points are (n, 3); got {x.shape}")
    if not np.isfinite(x).all():
        raise InputError(f"{int((~np.isfinite(x)).any(axis=1).sum())} of {len(x)} points are not finite; drop them")
    mesh.require_closed()
    corners = mesh.points[mesh.faces]
    order, box, span, second = build_tree(corners.min(axis=1), corners.max(axis=1), corners.mean(axis=1))
    distance, where = tree_distances(
        x, corners[order].reshape(-1, 9), order, box, span, second, mesh.pseudo_normals[order]
    )
    return distance, order[where]
