"""How complete the data of a trajectory are: the condition of Tuy and Smith.

A point can be reconstructed stably from cone-beam data if every plane through it meets the source path (H. K. Tuy, SIAM
J. Appl. Math. 43 (1983) 546; B. D. Smith, IEEE Trans. Med. Imaging 4 (1985) 14).  Here the share of planes that do is
counted over evenly spread normals.  It is 1 where the data are complete.

What it does not say: the condition is about untruncated projections and a continuous path.  It counts a plane that is
met once like one that is met often, knows neither noise nor absorption, and takes views for dense.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, ShapeError
from tomopose.kernel_cache import njit
from tomopose.units import Array
from tomopose.values import require_types, value

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


@value
class Completeness:
    """points (m, 3), mm, in W at home; share (m,): part of the planes through each point that meet the source path."""

    points: Array
    share: Array

    @property
    def mean(self) -> float:
        return float(self.share.mean())

    @property
    def worst(self) -> int:
        """Index of the point with the smallest share."""
        return int(self.share.argmin())


def source_path(P: ArrayLike) -> Array:
    """Source positions (n, 3), mm, in the object's frame (W at home), of matrices P (n, 3, 4): P [s, 1] = 0."""
    P = np.asarray(getattr(P, "P", P), dtype=np.float64)
    return -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[..., 0]


def plane_normals(n: int) -> Array:
    """n unit vectors (n, 3), spread evenly over a half sphere: a Fibonacci lattice.  A plane's normal has no sign."""
    k = np.arange(n)
    z = (k + 0.5) / n
    r = np.sqrt(1 - z**2)
    return np.column_stack([r * np.cos(GOLDEN_ANGLE * k), r * np.sin(GOLDEN_ANGLE * k), z])


def object_points(radius: float, z_low: float, z_high: float, *, spacing: float) -> Array:
    """Points (m, 3), mm, of a cubic lattice through the origin inside an upright cylinder."""
    if not (radius > 0 and z_high > z_low and spacing > 0):
        raise InputError(f"no points: radius {radius:g}, z from {z_low:g} to {z_high:g}, spacing {spacing:g} mm")
    side = spacing * np.arange(-np.floor(radius / spacing), np.floor(radius / spacing) + 1)
    up = spacing * np.arange(np.ceil(z_low / spacing), np.floor(z_high / spacing) + 1)
    x = np.stack(np.meshgrid(side, side, up, indexing="ij"), axis=-1).reshape(-1, 3)
    inside: Array = x[np.hypot(x[:, 0], x[:, 1]) <= radius]
    return inside


@require_types
def tuy_completeness(path: Array, points: Array, *, n_planes: int = 2000) -> Completeness:
    """Share of planes through each point (m, 3) that meet the source path (n, 3), mm, both in the object's frame.

    Consecutive source positions are taken as joined, so that a plane meets the path where sources lie on both sides of
    it or on it: min_j n . (s_j - x) <= 0 <= max_j n . (s_j - x).  The share is counted over `n_planes` normals n; its
    own error is about 1 / sqrt(n_planes) of the missing part, or less.
    """
    path = np.ascontiguousarray(path, dtype=np.float64)
    points = np.ascontiguousarray(points, dtype=np.float64)
    for name, array in (("path", path), ("points", points)):
        if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
            raise ShapeError(f"{name} has shape {array.shape}; (n, 3) in mm is needed")
        if not np.isfinite(array).all():
            raise InputError(f"{name} holds values that are not finite")
    if n_planes < 1:
        raise InputError(f"n_planes is {n_planes}; at least one plane is needed")
    return Completeness(points=points, share=_share(path, points, plane_normals(n_planes)))


@njit(cache=True)
def _share(path: Array, points: Array, normals: Array) -> Array:
    share = np.empty(len(points))
    for i in range(len(points)):
        met = 0
        for k in range(len(normals)):
            a, b, c = normals[k]
            level = a * points[i, 0] + b * points[i, 1] + c * points[i, 2]
            above, below = False, False
            for j in range(len(path)):
                side = a * path[j, 0] + b * path[j, 1] + c * path[j, 2] - level
                above |= side >= 0
                below |= side <= 0
                if above and below:
                    met += 1
                    break
        share[i] = met / len(normals)
    return share
