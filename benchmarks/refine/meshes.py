"""The solids of objects.py as triangle meshes, their line integrals by gVirtualXray: another simulator's images.

gVirtualXray casts the rays (path lengths through each mesh, float32, by OpenGL); scanner, object and pixels are put
into its terms here, from the matrices alone.  Needs `pip install "tomopose[gvxr]"`; without a screen it renders
through EGL (docs/concepts/virtual-ct.md).
"""

from __future__ import annotations

import functools
import os
from typing import Any

import numpy as np
from objects import Panel, Solid

MM_PER_CM = 10.0
SUBDIVISIONS = 5
"""Of an icosahedron: its faces lie within 1.5e-4 of the radius of the ball."""
SEGMENTS = 512
"""Of a cylinder: its sides lie within 2e-5 of the radius."""


@functools.cache
def ball_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the unit ball: an icosahedron, its faces divided by four again and again."""
    g = (1 + np.sqrt(5)) / 2
    x = np.array([[0, a, b * g] for a in (-1, 1) for b in (-1, 1)], dtype=float)
    x = np.concatenate([np.roll(x, k, axis=1) for k in range(3)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    # three vertices at the least distance from one another are a face, turned so that its normal points out
    near = np.linalg.norm(x[:, None] - x, axis=-1) < 1.2
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    faces = np.array([t for t in triples if near[t[0], t[1]] and near[t[1], t[2]] and near[t[0], t[2]]])
    inward = np.linalg.det(x[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(SUBDIVISIONS):
        a, b, c = (x[faces[:, k]] for k in range(3))
        middles = [(p + q) / np.linalg.norm(p + q, axis=1, keepdims=True) for p, q in ((a, b), (b, c), (c, a))]
        corners = np.stack([a, b, c, *middles], axis=1).reshape(-1, 3)
        quarters = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
        whole = (6 * np.arange(len(faces))[:, None, None] + quarters).reshape(-1, 3)
        _, first, new = np.unique(np.round(corners, 9), axis=0, return_index=True, return_inverse=True)
        x, faces = corners[first], new.ravel()[whole]
    return x, faces


@functools.cache
def cylinder_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the cylinder of radius 1, -1 < z < 1."""
    a, k = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS, np.arange(SEGMENTS)
    ring = np.stack([np.cos(a), np.sin(a)], axis=1)
    ends = [np.column_stack([ring, np.full(SEGMENTS, z)]) for z in (-1.0, 1.0)]
    x = np.concatenate([*ends, [[0, 0, -1.0], [0, 0, 1.0]]])
    after, n = (k + 1) % SEGMENTS, SEGMENTS
    faces = [
        np.stack([k, after, n + after], axis=1),
        np.stack([k, n + after, n + k], axis=1),
        np.stack([after, k, np.full(n, 2 * n)], axis=1),
        np.stack([n + k, n + after, np.full(n, 2 * n + 1)], axis=1),
    ]
    return x, np.concatenate(faces)


def mesh_of(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, mm, and faces of a solid."""
    x, faces = ball_mesh() if solid.kind == "ellipsoid" else cylinder_mesh()
    R = np.eye(3) if solid.turn is None else solid.turn
    return x * np.asarray(solid.half) @ R.T + np.asarray(solid.centre), faces


@functools.cache
def renderer() -> Any:
    """The gvxr module with a context without a window."""
    from gvxrPython3 import gvxr

    gvxr.useLogFile(os.devnull)
    gvxr.createWindow(-1, 0, "EGL")
    gvxr.usePointSource()
    gvxr.setMonoChromaticPerPixelAtSDD(0.08, "MeV", 1)
    return gvxr


def line_integrals(P: np.ndarray, solids: list[Solid], panel: Panel, fine: int = 2) -> np.ndarray:
    """(n, n_v, n_u), each pixel the mean over fine x fine rays; as objects.line_integrals."""
    gvxr = renderer()
    gvxr.removePolygonMeshesFromSceneGraph()
    for k, solid in enumerate(solids):
        x, faces = mesh_of(solid)
        name = f"solid {k}"
        gvxr.makeTriangularMesh(name, x.astype(np.float32).ravel(), faces.astype(np.int32).ravel(), "mm")
        gvxr.addPolygonMeshAsInnerSurface(name)
        gvxr.setElement(name, "Al")
        gvxr.setDensity(name, 2.7, "g/cm3")
    gvxr.setDetectorNumberOfPixels(fine * panel.n_u, fine * panel.n_v)
    out = np.zeros((len(P), panel.n_v, panel.n_u))
    for j, Pj in enumerate(P):
        M_inv = np.linalg.inv(Pj[:, :3])
        s = -M_inv @ Pj[:, 3]
        U, V, middle = (panel.d_SD * M_inv @ np.array(x) for x in (
            (1, 0, 0), (0, 1, 0), ((panel.n_u - 1) / 2, (panel.n_v - 1) / 2, 1)
        ))  # fmt: skip
        gvxr.setSourcePosition(*s, "mm")
        gvxr.setDetectorPosition(*(s + middle), "mm")
        gvxr.setDetectorUpVector(*(V / np.linalg.norm(V)))
        gvxr.setDetectorRightVector(*(U / np.linalg.norm(U)))
        gvxr.setDetectorPixelSize(panel.p_u / fine, panel.p_v / fine, "mm")
        for k, solid in enumerate(solids):
            L = MM_PER_CM * np.asarray(gvxr.computeLBuffer(f"solid {k}"), dtype=np.float64)
            out[j] += solid.mu * L.reshape(panel.n_v, fine, panel.n_u, fine).mean(axis=(1, 3))
    return out
