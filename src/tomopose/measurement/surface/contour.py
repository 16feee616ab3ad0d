"""The start surface: one grey level as a triangle mesh, by VTK's flying edges, slab by slab.

Neighbouring slabs share a layer of voxels; the vertices on it are computed from the same numbers on both sides and are
joined.  Vertices come back as fractional array indices (iz, iy, ix): voxel centres have whole numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tomopose.errors import EngineMissingError, InputError
from tomopose.units import Array

INSTALL_LINE = 'pip install "tomopose[metrology]"'


def _vtk() -> Any:
    try:
        from vtkmodules.util import numpy_support
        from vtkmodules.vtkCommonDataModel import vtkImageData
        from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D
    except ImportError as error:
        raise EngineMissingError("VTK is needed for the start surface", install_line=INSTALL_LINE) from error
    return numpy_support, vtkImageData, vtkFlyingEdges3D


def contour(
    values: np.ndarray, level: float, *, slab_layers: int = 128, progress: Callable[[int, int], None] | None = None
) -> tuple[Array, np.ndarray]:
    """Vertices (n, 3), indices (iz, iy, ix), and triangles (m, 3) of the surface of one grey level.

    Raises InputError where no voxel pair crosses the level, EngineMissingError without VTK.
    """
    engine = _vtk()
    n_z = values.shape[0]
    starts = list(range(0, max(n_z - 1, 1), slab_layers))
    vertices, triangles = [], []
    total = 0
    seam: tuple[Array, np.ndarray] | None = None
    for done, z_0 in enumerate(starts):
        z_1 = min(z_0 + slab_layers, n_z - 1)
        part = np.ascontiguousarray(values[z_0 : z_1 + 1], dtype=np.float32)
        x, f = _flying_edges(part, level, engine)
        x[:, 0] += z_0
        number = np.arange(total, total + len(x))
        if seam is not None and len(x):
            number = _joined(x, number, seam, z_0)
        new = number >= total
        # What is joined leaves gaps in the numbering of this slab; close them.
        number[new] = total + np.arange(int(new.sum()))
        vertices.append(x[new])
        triangles.append(number[f])
        total += int(new.sum())
        top = np.flatnonzero(x[:, 0] == z_1)
        seam = x[top], number[top]
        if progress is not None:
            progress(done + 1, len(starts))
    faces = np.concatenate(triangles)
    if not len(faces):
        raise InputError(
            f"no surface: no voxels lie on both sides of grey level {level:g}, values reach from "
            f"{float(values.min()):g} to {float(values.max()):g}"
        )
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return np.concatenate(vertices), faces[distinct]


def _flying_edges(part: np.ndarray, level: float, engine: Any) -> tuple[Array, np.ndarray]:
    numpy_support, vtkImageData, vtkFlyingEdges3D = engine
    if min(part.shape) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp)
    image = vtkImageData()
    image.SetDimensions(part.shape[2], part.shape[1], part.shape[0])
    image.GetPointData().SetScalars(numpy_support.numpy_to_vtk(part.ravel(), deep=False))
    edges = vtkFlyingEdges3D()
    edges.SetInputData(image)
    edges.SetValue(0, level)
    edges.ComputeNormalsOff()
    edges.ComputeGradientsOff()
    edges.ComputeScalarsOff()
    edges.Update()
    mesh = edges.GetOutput()
    if mesh.GetNumberOfPolys() == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.intp)
    x = numpy_support.vtk_to_numpy(mesh.GetPoints().GetData()).astype(np.float64)[:, ::-1].copy()
    faces = numpy_support.vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.intp)
    return x, faces


def _joined(x: Array, number: np.ndarray, seam: tuple[Array, np.ndarray], z_0: int) -> np.ndarray:
    """The numbers of vertices, those on the lowest layer replaced by the numbers they have in the slab below."""
    low = np.flatnonzero(x[:, 0] == z_0)
    known = {(y, x_): n for (_, y, x_), n in zip(seam[0].tolist(), seam[1].tolist(), strict=True)}
    for k in low:
        number[k] = known.get((x[k, 1], x[k, 2]), number[k])
    return number


def main_components(vertices: Array, faces: np.ndarray, smallest_share: float) -> tuple[Array, np.ndarray, int]:
    """The mesh without pieces smaller than `smallest_share` of the area of the largest, and how many were dropped.

    vertices in any one unit of length.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(vertices)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    triangle = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    area = np.bincount(label[faces[:, 0]], weights=triangle, minlength=count)
    keep = area >= smallest_share * area.max()
    kept = keep[label] & (np.bincount(faces.ravel(), minlength=n) > 0)
    renumbered = np.cumsum(kept) - 1
    # A vertex that no triangle uses is a piece of no area; it is not counted as dropped.
    return vertices[kept], renumbered[faces[keep[label[faces[:, 0]]]]], int(np.count_nonzero((area > 0) & ~keep))
