"""Where a part lies: transforms from part coordinates to frame W, by points, by datums (3-2-1) or by best fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.measurement.features import Feature
from tomopose.units import Array, float_array


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """x_W = R @ x_part + t.  R (3, 3), t (3,) mm; rule: how it was found."""

    R: Array
    t: Array
    rule: str = "none"

    def __post_init__(self) -> None:
        R, t = np.asarray(self.R, dtype=np.float64), np.asarray(self.t, dtype=np.float64)
        if R.shape != (3, 3) or t.shape != (3,):
            raise ShapeError(f"an alignment is R (3, 3) and t (3,); got {R.shape} and {t.shape}")
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise InputError("R of an alignment is no rotation; a scale or a mirror image has no place in it")
        object.__setattr__(self, "R", float_array(R))
        object.__setattr__(self, "t", float_array(t))

    @classmethod
    def none(cls) -> Alignment:
        return cls(R=np.eye(3), t=np.zeros(3))

    def points(self, x: Any) -> Array:
        """Points (..., 3) of the part, in W."""
        return np.asarray(x, dtype=np.float64) @ self.R.T + self.t

    def directions(self, n: Any) -> Array:
        """Directions (..., 3) of the part, in W."""
        return np.asarray(n, dtype=np.float64) @ self.R.T

    def to_json(self) -> dict[str, Any]:
        return {"rule": self.rule, "R": self.R, "t_mm": self.t, "rotation_vector_rad": log_rotation(self.R)}


def from_points(x_part: Array, x_W: Array) -> Alignment:
    """Least-squares rigid motion of points (n, 3) onto points (n, 3), by singular values.

    Kabsch, Acta Cryst. A32 (1976) 922.  InputError where the points lie on a line.
    """
    a, b = x_part - x_part.mean(axis=0), x_W - x_W.mean(axis=0)
    if np.linalg.matrix_rank(a, tol=1e-9 * max(float(np.abs(a).max()), 1e-300)) < 2:
        raise InputError(f"{len(a)} points on a line fix no orientation; give points beside it")
    u, _, vt = np.linalg.svd(a.T @ b)
    R = (u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt).T
    return Alignment(R=R, t=x_W.mean(axis=0) - R @ x_part.mean(axis=0), rule="points, least squares")


def from_datums(nominal: tuple[Array, Array, Array], normals: tuple[Array, Array, Array],
                planes: tuple[Feature, Feature, Feature]) -> Alignment:
    """3-2-1 from three planes (ISO 5459): the first fixes two rotations and a height, the second one rotation and a
    place, the third the last place.

    nominal, normals: points (3,) and outward normals (3,) of the planes in the part; planes: as measured in W, their
    directions outward too.  InputError where two planes are nearly parallel.
    """

    def triad(first: Array, second: Array) -> Array:
        e_1 = first / np.linalg.norm(first)
        e_2 = second - (second @ e_1) * e_1
        if np.linalg.norm(e_2) < 0.1 * np.linalg.norm(second):
            raise InputError("the first two datum planes are nearly parallel; choose others")
        e_2 /= np.linalg.norm(e_2)
        return np.stack([e_1, e_2, np.cross(e_1, e_2)])

    R = triad(planes[0].direction, planes[1].direction).T @ triad(normals[0], normals[1])
    N = np.stack([p.direction for p in planes])
    if abs(np.linalg.det(N)) < 0.05:
        raise InputError("the three datum planes meet in no point; choose planes of three directions")
    # Each measured plane passes through the place of its nominal point.
    places = [float((p.point - R @ x) @ p.direction) for p, x in zip(planes, nominal, strict=True)]
    return Alignment(R=R, t=np.linalg.solve(N, np.array(places)), rule="datum, 3-2-1")


def best_fit(start: Alignment, x_part: Array, normals: Array, distance: Array) -> Alignment:
    """One Gauss-Newton step, point to plane with Huber weights, that moves a reference towards a measured surface.

    x_part (n, 3), normals (n, 3) of the reference in the part; distance (n,): measured surface beyond the reference
    along the normal, mm.
    """
    x, n = start.points(x_part), start.directions(normals)
    centre = x.mean(axis=0)
    J = np.hstack([np.cross(x - centre, n), n])
    scale = 1.4826 * float(np.median(np.abs(distance - np.median(distance)))) or 1.0
    w = np.minimum(1.0, 1.345 * scale / np.maximum(np.abs(distance), 1e-300))
    gram = (J * w[:, None]).T @ J
    if np.linalg.cond(gram) > 1e12:
        raise InputError("best fit: the compared points leave a motion free, as a plane, a sphere or a cylinder does")
    step = np.linalg.solve(gram, (J * w[:, None]).T @ distance)
    turn = exp_rotation(step[:3])
    return Alignment(R=turn @ start.R, t=turn @ (start.t - centre) + centre + step[3:], rule="best fit")
