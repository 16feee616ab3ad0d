"""gVirtualXray as a second engine: it casts the rays, all else is this package's own.

Its L-buffers (path lengths through each mesh, on a graphics card or on Mesa's software renderer) take the place of the
projector's rays.  How it starts without a screen is described in docs/concepts/virtual-ct.md.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from tomopose.errors import EngineFailedError, EngineMissingError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.objects.mesh import TriangleMesh
from tomopose.simulation.physics.spectrum import Beam
from tomopose.simulation.projector.view import View, Window
from tomopose.units import Array

TILE = 512
"""Side of the images asked for: textures of the software renderer stop at 2048."""
MM_PER_CM = 10.0
_started: list[Any] = []


def _engine() -> Any:
    """The gvxr module with a context without a window, opened once a process."""
    if _started:
        return _started[0]
    try:
        from gvxrPython3 import gvxr
    except ImportError as error:
        raise EngineMissingError(
            'engine = "gvxr" needs gvxr, which is not installed', install_line='pip install "tomopose[gvxr]"'
        ) from error
    try:
        # It writes its start-up messages to the terminal unless it is given another place.
        gvxr.useLogFile(os.devnull)
        gvxr.createWindow(-1, 0, "EGL")
        gvxr.usePointSource()
        gvxr.setMonoChromaticPerPixelAtSDD(0.08, "MeV", 1)
    except Exception as error:
        raise EngineFailedError(
            f"gvxr opens no EGL context ({error}); on Debian it needs libegl1, libegl-mesa0 and libgl1-mesa-dri"
        ) from error
    _started.append(gvxr)
    return gvxr


def path_images(
    bodies: list[tuple[Any, Any]], view: View, u_0: float, v_0: float, step: float, n_u: int, n_v: int
) -> Array:
    """(m, n_v, n_u) path lengths, mm, through m meshes (vertices in W, faces) at u_0 + step i, v_0 + step j (px)."""
    gvxr = _engine()
    gvxr.removePolygonMeshesFromSceneGraph()
    for k, (vertices, faces) in enumerate(bodies):
        name = f"body {k}"
        gvxr.makeTriangularMesh(
            name,
            np.ascontiguousarray(vertices, dtype=np.float32).ravel(),
            np.ascontiguousarray(faces, dtype=np.int32).ravel(),
            "mm",
        )
        gvxr.addPolygonMeshAsInnerSurface(name)
        gvxr.setElement(name, "Al")
        gvxr.setDensity(name, 2.7, "g/cm3")
    gvxr.setSourcePosition(*view.source, "mm")
    right, up = view.U / np.linalg.norm(view.U), view.V / np.linalg.norm(view.V)
    gvxr.setDetectorUpVector(*up)
    gvxr.setDetectorRightVector(*right)
    gvxr.setDetectorPixelSize(step * float(np.linalg.norm(view.U)), step * float(np.linalg.norm(view.V)), "mm")
    out = np.zeros((len(bodies), n_v, n_u))
    for j in range(0, n_v, TILE):
        for i in range(0, n_u, TILE):
            u, v = u_0 + step * (i + (TILE - 1) / 2), v_0 + step * (j + (TILE - 1) / 2)
            gvxr.setDetectorPosition(*(view.O + u * view.U + v * view.V), "mm")
            gvxr.setDetectorNumberOfPixels(TILE, TILE)
            rows, columns = min(TILE, n_v - j), min(TILE, n_u - i)
            for k in range(len(bodies)):
                tile = np.asarray(gvxr.computeLBuffer(f"body {k}"), dtype=np.float64)
                out[k, j : j + rows, i : i + columns] = tile[:rows, :columns] * MM_PER_CM
    return out


def add_gvxr_transmission(
    out: np.ndarray,
    window: Window,
    bodies: list[tuple[TriangleMesh, str, Frame]],
    materials: tuple[str, ...],
    beam: Beam,
    view: View,
    T_FW: dict[Frame, RigidTransform],
    *,
    f: int,
    weight: float = 1.0,
) -> None:
    """Add weight x transmission at the middle of each cell to out[0]; see `projector.add_transmission`.

    bodies: meshes with their material and frame; materials: names of the beam's columns.
    """
    placed = [(T_FW[frame].apply(mesh.vertices), mesh.faces) for mesh, _, frame in bodies]
    first = 0.5 / f - 0.5
    paths = path_images(placed, view, window.u_0 + first, window.v_0 + first, 1 / f, window.n_u * f, window.n_v * f)
    L = np.zeros((*paths.shape[1:], len(materials)))
    for path, (_, material, _) in zip(paths, bodies, strict=True):
        L[..., materials.index(material)] += path
    for j in range(len(L)):
        out[0, j] += weight * beam.transmission(L[j])
