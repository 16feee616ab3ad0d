"""Probing without a mesh: edges straight along given normals, as a coordinate measuring machine probes.

The points come from a nominal feature (patterns below) or from the vertices of a reference mesh; nothing but the volume
about them is read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tomopose.errors import InputError
from tomopose.measurement.features.shapes import frame_along
from tomopose.measurement.surface.edges import Edges, EdgeSettings, search_edges
from tomopose.units import Array, float_array
from tomopose.values import require_types, value
from tomopose.volume import Volume


@value
class Probing:
    """points: (n, 3) probed, mm in W, nan without an edge;  start, normals: (n, 3) as given;  edges: details."""

    points: Array
    start: Array
    normals: Array
    edges: Edges

    def __post_init__(self) -> None:
        for name in ("points", "start", "normals"):
            object.__setattr__(self, name, float_array(getattr(self, name)))

    @property
    def good(self) -> np.ndarray:
        return self.edges.good


@require_types
def probe(
    volume: Volume,
    points: npt.ArrayLike,
    normals: npt.ArrayLike,
    *,
    settings: EdgeSettings | None = None,
    search_mm: float | None = None,
    contrast: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Probing:
    """Probe from points (n, 3), mm in W, along normals (n, 3) that point from material to background.

    search_mm: how far the surface may lie from the points; the settings' distance in voxels unless given.
    contrast:  grey levels between material and background; the median of the edges' own unless given.

    Raises ShapeError, or InputError where no edge is found at all.
    """
    s = settings or EdgeSettings()
    if search_mm is not None:
        s = replace(s, search_distance=search_mm / float(volume.grid.spacing.min()))
    start, n = np.asarray(points, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    edges = search_edges(volume, start, n, s, contrast=contrast, progress=progress)
    if not edges.good.any():
        raise InputError(f"none of {len(start)} probed points met an edge: {edges.flag_counts()}")
    n = n / np.linalg.norm(n, axis=1)[:, None]
    return Probing(points=start + edges.offset[:, None] * n, start=start, normals=n, edges=edges)


# -- patterns of points on nominal features: (points, outward normals) -------------------------------------------------


def sphere_pattern(
    centre: npt.ArrayLike, radius: float, n: int, *, axis: npt.ArrayLike = (0, 0, 1), cap: float = np.pi
) -> tuple[Array, Array]:
    """n points spread evenly over the cap of a sphere within the angle `cap`, rad, of `axis`; pi for all of it."""
    k = np.arange(n) + 0.5
    z = 1.0 - k / n * (1.0 - np.cos(cap))
    angle = k * np.pi * (1.0 + np.sqrt(5.0))
    rho = np.sqrt(np.maximum(1.0 - z**2, 0.0))
    normals = np.column_stack([rho * np.cos(angle), rho * np.sin(angle), z]) @ frame_along(np.asarray(axis, float))
    return np.asarray(centre, dtype=np.float64) + radius * normals, normals


def cylinder_pattern(
    point: npt.ArrayLike, direction: npt.ArrayLike, radius: float, length: float, n: int, *, half_angle: float = 0.0
) -> tuple[Array, Array]:
    """About n points on a cylinder, or a cone widening along its direction, of `length` mm about `point`."""
    frame = frame_along(np.asarray(direction, dtype=np.float64))
    around = max(round(np.sqrt(n * 2 * np.pi * radius / length)), 6)
    along = max(round(n / around), 2)
    z = (np.arange(along) + 0.5) / along * length - length / 2
    # Rows are turned against each other by the golden angle, so that no line of points runs along the axis.
    a = (np.arange(around) / around * 2 * np.pi + np.arange(along)[:, None] * np.pi * (3 - np.sqrt(5))).ravel()
    z = np.repeat(z, around)
    radial = np.column_stack([np.cos(a), np.sin(a), np.zeros(len(a))])
    local = radial * (radius + z * np.tan(half_angle))[:, None] + np.outer(z, [0, 0, 1.0])
    normal = radial * np.cos(half_angle) - np.array([0, 0, np.sin(half_angle)])
    return np.asarray(point, dtype=np.float64) + local @ frame, normal @ frame


def plane_pattern(
    point: npt.ArrayLike, normal: npt.ArrayLike, u: npt.ArrayLike, v: npt.ArrayLike, n: int
) -> tuple[Array, Array]:
    """About n points on the rectangle point +- u +- v, (3,) half sides in mm, with the outward normal given."""
    u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    n_u = max(round(np.sqrt(n * np.linalg.norm(u) / np.linalg.norm(v))), 2)
    n_v = max(round(n / n_u), 2)
    s, t = ((np.arange(k) + 0.5) / k * 2 - 1 for k in (n_u, n_v))
    points = (s[:, None, None] * u + t[None, :, None] * v).reshape(-1, 3)
    out = np.asarray(normal, dtype=np.float64)
    return np.asarray(point, dtype=np.float64) + points, np.broadcast_to(out / np.linalg.norm(out), points.shape).copy()


def circle_pattern(centre: npt.ArrayLike, direction: npt.ArrayLike, radius: float, n: int) -> tuple[Array, Array]:
    """n points on a circle about `direction`, with normals away from its centre."""
    frame = frame_along(np.asarray(direction, dtype=np.float64))
    a = 2 * np.pi * np.arange(n) / n
    normals = np.cos(a)[:, None] * frame[0] + np.sin(a)[:, None] * frame[1]
    return np.asarray(centre, dtype=np.float64) + radius * normals, normals


def line_pattern(
    point: npt.ArrayLike, direction: npt.ArrayLike, normal: npt.ArrayLike, length: float, n: int
) -> tuple[Array, Array]:
    """n points on a line of `length` mm about `point`, with the normal given, made perpendicular to the line."""
    along = frame_along(np.asarray(direction, dtype=np.float64))[2]
    out = np.asarray(normal, dtype=np.float64)
    out = out - (out @ along) * along
    size = float(np.linalg.norm(out))
    if size < 1e-6:
        raise InputError("the normal of a line runs along it; give the direction from material to air")
    s = ((np.arange(n) + 0.5) / n - 0.5) * length
    x = np.asarray(point, dtype=np.float64) + s[:, None] * along
    return x, np.broadcast_to(out / size, x.shape).copy()
