"""Meshes from files: STL, PLY or OBJ in mm, and STEP."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.mesh.step import read_step
from tomopose.reading import read_bytes, reader, reading

MEMORY_PER_BYTE = 20
"""Bytes in memory for each byte of a file of triangles, while equal corners are joined."""


@reader("mesh")
def read_mesh(path: str | Path) -> Mesh:
    """A mesh from STL (binary or text), PLY (text or binary little-endian) or OBJ, in mm, or STEP; vertices are joined.

    FileError where the file is missing, of another kind or damaged; EngineMissingError for STEP without cascadio.
    """
    path = Path(path)
    if path.suffix.lower() in (".step", ".stp"):
        return read_step(path)
    content = read_bytes(path, per_byte=MEMORY_PER_BYTE)
    parse = {".stl": _read_stl, ".ply": _read_ply, ".obj": _read_obj}.get(path.suffix.lower())
    if parse is None:
        raise FileError(
            f"{path}: {path.suffix!r} is no mesh format that is read here; .stl, .ply, .obj and .step are", path=path
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


def _read_obj(content: bytes) -> Mesh:
    """Wavefront OBJ: `v x y z` and `f a b c ...`, numbered from 1 or from the end; polygons are cut into fans."""
    points, faces = [], []
    for line in content.decode("utf-8", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            points.append([float(v) for v in words[1:4]])
        elif words[:1] == ["f"]:
            number = [int(w.split("/")[0]) for w in words[1:]]
            corner = [k - 1 if k > 0 else len(points) + k for k in number]
            faces += [[corner[0], b, c] for b, c in pairwise(corner[1:])]
    if not faces:
        raise ValueError("the file holds no faces")
    unique, inverse = np.unique(np.array(points), axis=0, return_inverse=True)
    if not 0 <= np.min(faces) <= np.max(faces) < len(points):
        raise ValueError(f"faces name corners that {len(points)} vertices do not have")
    return Mesh(points=unique, faces=inverse[np.array(faces)])


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
