"""Reference meshes: triangles with normals, sharp edges and elements, read from STL or PLY (mm).

An element is a connected part of the surface between sharp edges: a plane, a cylinder, a bore.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from tomopose.errors import FileError, InputError, ShapeError
from tomopose.reading import read_bytes, reader, reading
from tomopose.units import Array, float_array

MEMORY_PER_BYTE = 20
"""Bytes in memory for each byte of a file of triangles, while equal corners are joined."""
SHARP = np.radians(30.0)
"""Angle between neighbouring triangles from which their common edge is an edge of the part."""


@dataclass(frozen=True, kw_only=True, eq=False)
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
        return n / np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None]

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
        return out / np.maximum(np.linalg.norm(out, axis=1), 1e-300)[:, None]

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


@reader("mesh")
def read_mesh(path: str | Path) -> Mesh:
    """A mesh from STL (binary or text), PLY (text or binary little-endian), in mm, or STEP; equal vertices are joined.

    FileError where the file is missing, of another kind or damaged; EngineMissingError for STEP without cascadio.
    """
    path = Path(path)
    if path.suffix.lower() in (".step", ".stp"):
        from tomopose.measurement.mesh.step import read_step

        return read_step(path)
    content = read_bytes(path, per_byte=MEMORY_PER_BYTE)
    parse = {".stl": _read_stl, ".ply": _read_ply}.get(path.suffix.lower())
    if parse is None:
        raise FileError(
            f"{path}: {path.suffix!r} is no mesh format that is read here; .stl, .ply and .step are", path=path
        )
    with reading(path, "mesh"):  # a mesh's own errors do not name the file
        try:
            return parse(content)
        except InputError as error:
            raise FileError(f"{path} is no readable mesh: {error}", path=path) from error


def _read_stl(content: bytes) -> Mesh:
    count = struct.unpack_from("<I", content, 80)[0] if len(content) >= 84 else -1
    if len(content) == 84 + 50 * count:
        record = np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
        corners = np.frombuffer(content, dtype=record, offset=84)["v"].reshape(-1, 3)
    else:
        words = content.decode("ascii").split()
        rows = [k for k, w in enumerate(words) if w.lower() == "vertex"]
        corners = np.array([[float(v) for v in words[k + 1 : k + 4]] for k in rows])
        if len(corners) % 3 or not len(corners):
            raise ValueError(f"{len(corners)} vertices make no triangles")
    if not np.isfinite(corners).all():
        raise ValueError("a vertex is not finite")
    points, inverse = np.unique(corners.astype(np.float64), axis=0, return_inverse=True)
    faces = inverse.reshape(-1, 3)
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Mesh(points=points, faces=faces[whole])


PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "<i2",
    "ushort": "<u2",
    "int": "<i4",
    "uint": "<u4",
    "float": "<f4",
    "double": "<f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "float32": "<f4",
    "float64": "<f8",
}


def _read_ply(content: bytes) -> Mesh:
    end = content.index(b"end_header")
    body = content[content.index(b"\n", end) + 1 :]
    lines = [line.split() for line in content[:end].decode("ascii").splitlines()]
    if lines[0] != ["ply"]:
        raise ValueError("the first line is not 'ply'")
    kind = next((w[1] for w in lines if w[:1] == ["format"]), "")
    counts = {w[1]: int(w[2]) for w in lines if w[:1] == ["element"]}
    element, fields, lists = "", [], []
    for w in lines:
        if w[:1] == ["element"]:
            element = w[1]
        elif w[:1] == ["property"] and element == "vertex":
            fields.append((w[2], PLY_TYPES[w[1]]))
        elif w[:1] == ["property"] and element == "face":
            lists.append(w)
    n, m = counts["vertex"], counts["face"]
    if min(n, m) < 1 or max(n, m) > len(body):
        raise ValueError(f"{n} vertices and {m} faces are announced, {len(body)} bytes follow")
    if len(lists) != 1 or lists[0][1] != "list":
        raise ValueError("faces need one list of vertex indices and nothing else")
    if kind == "ascii":
        rows = body.decode("ascii").splitlines()
        names = [f[0] for f in fields]
        values = np.array([[float(v) for v in row.split()] for row in rows[:n]])
        points = values[:, [names.index(c) for c in "xyz"]]
        faces = np.array([[int(v) for v in row.split()] for row in rows[n : n + m]])
    elif kind == "binary_little_endian":
        vertex = np.dtype(fields)
        table = np.frombuffer(body, dtype=vertex, count=n)
        points = np.column_stack([table[c].astype(np.float64) for c in "xyz"])
        face = np.dtype([("n", PLY_TYPES[lists[0][2]]), ("v", PLY_TYPES[lists[0][3]], 3)])
        read = np.frombuffer(body, dtype=face, count=m, offset=n * vertex.itemsize)
        faces = np.column_stack([read["n"], read["v"]])
    else:
        raise ValueError(f"format {kind} is not read; ascii and binary_little_endian are")
    if (faces[:, 0] != 3).any():
        raise ValueError("all faces must be triangles")
    return Mesh(points=points, faces=faces[:, 1:])


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
