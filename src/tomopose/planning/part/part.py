"""The part: its closed mesh in W at home, and where the material is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.mesh.mesh_files import read_mesh
from tomopose.planning.part.material_paths import material_paths
from tomopose.units import Array

WINDING_POINTS = 600
WINDING_DEPTH = 1e-4
"""Share of the part's size by which points are moved to both sides of the surface to look where the material is."""
WRONG_SHARE = 0.02
"""Of those points that may lie wrong: next to edges a point that was moved leaves by another face."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """mesh: closed, mm in W at home, faces counter-clockwise seen from outside;  name: of its file."""

    mesh: Mesh
    name: str = "part"

    def __post_init__(self) -> None:
        if self.mesh.open_edges:
            raise InputError(
                f"{self.name}: the mesh is open: {self.mesh.open_edges} edges do not join two triangles, so inside and "
                "outside are not defined; repair it, or export it again with its vertices joined"
            )
        self.mesh.require_closed()

    @cached_property
    def hull(self) -> Array:
        """(h, 3) corners of the convex hull, mm: where they are, the whole part is."""
        from scipy.spatial import ConvexHull

        x = self.mesh.points
        hull: Array = x[ConvexHull(x).vertices]
        return hull

    @cached_property
    def hull_planes(self) -> Array:
        """(k, 4) planes of the hull: x lies in it where planes[:, :3] x + planes[:, 3] <= 0 for all of them, mm."""
        from scipy.spatial import ConvexHull

        planes: Array = np.unique(np.round(ConvexHull(self.hull).equations, 12), axis=0)
        return planes

    @property
    def centre(self) -> Array:
        """(3,) middle of the bounding box, mm."""
        centre: Array = (self.mesh.points.min(axis=0) + self.mesh.points.max(axis=0)) / 2
        return centre

    def winding(self, x: Array) -> Array:
        """(m,) 1 where points (m, 3), mm, lie in the material, 0 outside."""
        far = self.centre + np.array([3.1, 0.37, 0.59]) * self.mesh.size
        paths: Array = material_paths(_looking(far, self.centre)[None], self.mesh.points, self.mesh.faces, x)[1][0]
        return paths


def _looking(source: Array, at: Array) -> Array:
    """(3, 4) a projection from a source towards a point."""
    z = (at - source) / np.linalg.norm(at - source)
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return np.column_stack([R, -R @ source])


def surface_points(mesh: Mesh, n: int, seed: int) -> tuple[Array, Array]:
    """n points spread by area with their normals, (n, 3) each; normals follow the corners within smooth elements."""
    rng = np.random.default_rng(seed)
    area = np.linalg.norm(mesh.face_normals, axis=1)
    order = np.cumsum(area) / area.sum()
    faces = np.searchsorted(order, (np.arange(n) + rng.random(n)) / n).clip(0, len(area) - 1)
    a, b = np.sqrt(rng.random(n)), rng.random(n)
    share = np.column_stack([1 - a, a * (1 - b), a * b])
    x = np.einsum("nk,nkc->nc", share, mesh.points[mesh.faces[faces]])
    normal = np.einsum("nk,nkc->nc", share, _corner_normals(mesh)[faces])
    return x, normal / np.linalg.norm(normal, axis=1)[:, None]


def _corner_normals(mesh: Mesh) -> Array:
    """(m, 3, 3): normals at the corners of each triangle, from the triangles of the same smooth element."""
    key = mesh.elements[:, None].astype(np.int64) * len(mesh.points) + mesh.faces
    _, where = np.unique(key, return_inverse=True)
    where = where.reshape(-1, 3)
    total = np.zeros((where.max() + 1, 3))
    for k in range(3):
        np.add.at(total, where[:, k], mesh.face_normals)
    normals: Array = (total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None])[where]
    return normals


def require_simple(part: Part) -> None:
    """InputError where shells of the mesh overlap: lengths through them would count twice."""
    x, n = surface_points(part.mesh, WINDING_POINTS, 0)
    step = WINDING_DEPTH * part.mesh.size
    inside, outside = part.winding(x - step * n), part.winding(x + step * n)
    wrong = (np.abs(inside - 1) > 0.5) | (np.abs(outside) > 0.5)
    if wrong.mean() > WRONG_SHARE:
        raise InputError(
            f"{part.name}: at {100 * wrong.mean():.0f} % of its surface material lies on both sides or on the wrong "
            "one: shells of the mesh overlap; unite them first"
        )


def read_part(path: str | Path) -> Part:
    """A part from STL, PLY, OBJ or STEP, mm in W at home.

    Raises FileError where the file cannot be read, InputError where the mesh is open, looks inwards or overlaps itself.
    """
    part = Part(mesh=read_mesh(path), name=Path(path).name)
    require_simple(part)
    return part
