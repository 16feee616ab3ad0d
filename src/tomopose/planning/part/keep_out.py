"""What the part must not touch: meshes fixed in W (tube, panel, frame of the machine) or on the table (plate, clamps).

The part is taken as its convex hull, so that what is called clear is clear; an obstacle as its triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.units import Array

MOST_CORNERS = 64
"""Of a triangle cut by the hull's faces: each face adds one at most, and few of them cut."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Obstacle:
    """A closed or open mesh, mm, in frame W, or T: in W at table angle 0, turning with the table."""

    name: str
    mesh: Mesh
    frame: Literal["W", "T"] = "W"


@njit(cache=True, nogil=True)
def _cut(polygon: np.ndarray, count: int, plane: np.ndarray, out: np.ndarray) -> int:
    """Corners of the polygon's part with plane[:3] . x + plane[3] <= 0 (Sutherland and Hodgman 1974); their number."""
    made = 0
    for i in range(count):
        a, b = polygon[i], polygon[(i + 1) % count]
        h_a = plane[0] * a[0] + plane[1] * a[1] + plane[2] * a[2] + plane[3]
        h_b = plane[0] * b[0] + plane[1] * b[1] + plane[2] * b[2] + plane[3]
        if h_a <= 0.0 and made < len(out):
            out[made] = a
            made += 1
        if (h_a <= 0.0) != (h_b <= 0.0) and made < len(out):
            out[made] = a + (b - a) * (h_a / (h_a - h_b))
            made += 1
    return made


@njit(cache=True, nogil=True)
def _any_inside(corners: np.ndarray, planes: np.ndarray) -> bool:
    """Whether a triangle, corners (n, 3, 3), has a point in the convex body planes (h, 4)."""
    one, other = np.empty((MOST_CORNERS, 3)), np.empty((MOST_CORNERS, 3))
    for k in range(len(corners)):
        one[:3] = corners[k]
        count = 3
        for plane in planes:
            count = _cut(one, count, plane, other)
            if count == 0:
                break
            one, other = other, one
        if count > 0:
            return True
    return False


def _surrounds(corners: Array, x: Array) -> bool:
    """Whether a closed surface, corners (n, 3, 3), winds about a point: solid angles (Van Oosterom, Strackee 1983)."""
    a, b, c = (corners[:, k] - x for k in range(3))
    l_a, l_b, l_c = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    det = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a))]
    angle = 2 * np.arctan2(det, l_a * l_b * l_c + dots[0] * l_c + dots[1] * l_a + dots[2] * l_b)
    return bool(abs(angle.sum()) > 2 * np.pi)


def hits(obstacle: Obstacle, hull: Array, planes: Array, motions: tuple[RigidTransform, RigidTransform]) -> np.ndarray:
    """(n,) bool: in which poses the convex hull of points (h, 3), part at home, meets the obstacle.

    planes: (k, 4) of that hull;  motions: (part at home in W -> W, table -> W) of n poses.
    """
    moved, T_TW = motions
    x, faces = obstacle.mesh.points, obstacle.mesh.faces
    n = len(moved.t)
    out = np.zeros(n, dtype=bool)
    for j in range(n):
        x_W = x if obstacle.frame == "W" else x @ T_TW.R[j].T + T_TW.t[j]
        at_home = (x_W - moved.t[j]) @ moved.R[j]
        corners = np.ascontiguousarray(at_home[faces])
        out[j] = _any_inside(corners, planes) or _surrounds(corners, hull.mean(axis=0))
    return out
