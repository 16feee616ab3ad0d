"""STEP (ISO 10303) as a mesh, by the optional package cascadio (MIT, with OpenCASCADE, LGPL, inside).

cascadio triangulates to binary glTF, whose unit is the metre by its standard, whatever the STEP file's unit is; so the
unit is never in doubt.
"""

from __future__ import annotations

import json
import struct
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import EngineMissingError, FileError
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.reading import reader
from tomopose.units import Array

INSTALL_LINE = "pip install cascadio"
DEFLECTION, ANGLE = 0.002, 0.1
"""How far triangles may leave the surface, mm, and by how much neighbours may turn, rad."""
MM_PER_METRE = 1000.0
INDEX_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}


@reader("STEP file")
def read_step(path: str | Path, *, deflection: float = DEFLECTION) -> Mesh:
    """The solid in a STEP file as triangles, mm.

    deflection: how far triangles may leave the true surface, mm.
    FileError for a file that holds no solid, EngineMissingError without cascadio.
    """
    path = Path(path)
    try:
        cascadio: Any = import_module("cascadio")
    except ImportError as error:
        raise EngineMissingError(f"{path}: STEP is read by cascadio", install_line=INSTALL_LINE) from error
    with tempfile.TemporaryDirectory() as folder:
        glb = Path(folder) / "part.glb"
        cascadio.step_to_glb(str(path), str(glb), tol_linear=deflection, tol_angular=ANGLE)
        content = glb.read_bytes() if glb.exists() else b""
    try:
        corners = np.concatenate(_triangles(content))
    except (ValueError, KeyError, IndexError, TypeError, RecursionError, struct.error) as error:
        raise FileError(f"{path} holds no solid that could be read", path=path) from error
    # Faces of a solid share the points of their common edge, but each has its own copies.
    points, inverse = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = inverse.reshape(-1, 3)
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Mesh(points=points * MM_PER_METRE, faces=faces[whole])


def _triangles(content: bytes) -> list[Array]:
    """Corners (m, 3, 3), metres, of each mesh of a binary glTF file, where its nodes place it."""
    length = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + length])
    binary = content[20 + length + 8 :]
    found: list[Array] = []

    def visit(number: int, above: Array) -> None:
        node = document["nodes"][number]
        here = above @ _placement(node)
        for part in document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            x = _array(document, binary, part["attributes"]["POSITION"]).astype(np.float64)
            index = _array(document, binary, part["indices"]).reshape(-1, 3)
            found.append((x @ here[:3, :3].T + here[:3, 3])[index])
        for child in node.get("children", ()):
            visit(child, here)

    for root in document["scenes"][document.get("scene", 0)]["nodes"]:
        visit(root, np.eye(4))
    return found


def _placement(node: dict[str, Any]) -> Array:
    """(4, 4) of a node: its matrix (stored by columns), or translation, rotation (x, y, z, w) and scale."""
    from scipy.spatial.transform import Rotation

    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(np.float64)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix() * node.get("scale", (1, 1, 1))
    T[:3, 3] = node.get("translation", (0, 0, 0))
    return T


def _array(document: dict[str, Any], binary: bytes, number: int) -> Array:
    """Positions (n, 3) or indices (n,) of an accessor; both are stored without gaps."""
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind, width = ("<f4", 3) if accessor["type"] == "VEC3" else (INDEX_TYPES[accessor["componentType"]], 1)
    if view.get("byteStride", 4 * width if width == 3 else 0) not in (0, 4 * width):
        raise ValueError("interleaved arrays are not read")
    offset = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    flat = np.frombuffer(binary, dtype=kind, count=accessor["count"] * width, offset=offset)
    return flat.reshape(-1, 3) if width == 3 else flat
