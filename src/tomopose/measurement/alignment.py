"""Where a part lies: transforms from part coordinates to frame W, by points, by datums (3-2-1) or by best fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.errors import InputError, ShapeError
from tomopose.geometry.point_motion import rigid_motion
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.measurement.features.shapes import frame_along
from tomopose.units import Array, float_array
from tomopose.values import value


@value
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

    def points(self, x: npt.ArrayLike) -> Array:
        """Points (..., 3) of the part, in W."""
        return np.asarray(x, dtype=np.float64) @ self.R.T + self.t

    def directions(self, n: npt.ArrayLike) -> Array:
        """Directions (..., 3) of the part, in W."""
        return np.asarray(n, dtype=np.float64) @ self.R.T

    def to_json(self) -> dict[str, Any]:
        return {"rule": self.rule, "R": self.R, "t_mm": self.t, "rotation_vector_rad": log_rotation(self.R)}


def from_points(x_part: Array, x_W: Array) -> Alignment:
    """Least-squares rigid motion of points (n, 3) onto points (n, 3).  InputError where the points lie on a line."""
    R, t = rigid_motion(x_part, x_W)
    return Alignment(R=R, t=t, rule="points, least squares")


@dataclass(frozen=True, kw_only=True)
class Datum:
    """What a feature fixes: a point (3,), a direction (3,) or None, and the directions (k, 3) in which it places the
    part: one for a plane (its normal), two for an axis, three for a point."""

    point: Array
    direction: Array | None
    places: Array


def datum(kind: str, point: npt.ArrayLike, direction: npt.ArrayLike | None) -> Datum:
    """A feature as a datum; direction is ignored for spheres and calottes."""
    x = np.asarray(point, dtype=np.float64)
    if kind in ("sphere", "calotte"):
        return Datum(point=x, direction=None, places=np.eye(3))
    frame = frame_along(np.asarray(direction, dtype=np.float64))
    places = {"plane": frame[2:], "circle": frame}.get(kind, frame[:2])
    return Datum(point=x, direction=frame[2], places=places)


def from_datums(nominal: tuple[Datum, Datum, Datum], measured: tuple[Datum, Datum, Datum]) -> Alignment:
    """3-2-1 (ISO 5459): the first datum fixes two rotations, the second or third the last; then each places the part in
    what those before it leave free.

    nominal: in the part;  measured: in W, directions of the same sense.  The first needs a direction (plane or axis).
    The last rotation comes from the first of these that is not along it: direction of the second, way from the first
    axis to the second point, direction of the third, way from the second point to the third.
    InputError where the datums leave a motion free.
    """
    R = _turn(measured).T @ _turn(nominal)
    t, free = np.zeros(3), np.eye(3)
    for m, n in zip(measured, nominal, strict=True):
        if not len(free):
            break
        # t moves only along what is still free: least squares of what this datum asks for.
        asked = m.places @ (m.point - R @ n.point - t)
        A = m.places @ free.T
        u, s, vt = np.linalg.svd(A, full_matrices=True)
        rank = int(np.count_nonzero(s > LEAST_SINE))
        t = t + free.T @ (vt[:rank].T @ ((u[:, :rank].T @ asked) / s[:rank]))
        free = vt[rank:] @ free
    if len(free):
        raise InputError(
            f"the three datums leave the part free to move along {np.round(free[0], 3).tolist()}; choose others"
        )
    return Alignment(R=R, t=t, rule="datum, 3-2-1")


LEAST_SINE = 0.05
"""Sine of the angle between directions below which they count as parallel."""


def _turn(datums: tuple[Datum, Datum, Datum]) -> Array:
    """Rows e_1, e_2, e_3 of the frame that the datums span."""
    first, second, third = datums
    if first.direction is None:
        raise InputError("the first datum has no direction; begin with a plane or an axis")
    e_1 = first.direction
    ways = [
        second.direction,
        second.point - first.point if len(first.places) > 1 else None,
        third.direction,
        third.point - second.point,
    ]
    for way in ways:
        if way is None:
            continue
        across = way - (way @ e_1) * e_1
        if np.linalg.norm(across) > LEAST_SINE * np.linalg.norm(way):
            e_2 = across / np.linalg.norm(across)
            return np.stack([e_1, e_2, np.cross(e_1, e_2)])
    raise InputError("the datums leave the rotation about the first one free; choose others")


def best_fit(start: Alignment, x_part: Array, normals: Array, distance: Array) -> Alignment:
    """One Gauss-Newton step, point to plane with Huber weights, that moves a reference towards a measured surface.

    x_part (n, 3), normals (n, 3) of the reference in the part; distance (n,): measured surface beyond the reference
    along the normal, mm.
    """
    x, n = start.points(x_part), start.directions(normals)
    centre = x.mean(axis=0)
    J = np.hstack([np.cross(x - centre, n), n])
    scale = MAD_TO_SIGMA * float(np.median(np.abs(distance - np.median(distance)))) or 1.0
    w = np.minimum(1.0, 1.345 * scale / np.maximum(np.abs(distance), 1e-300))
    gram = (J * w[:, None]).T @ J
    if np.linalg.cond(gram) > 1e12:
        raise InputError("best fit: the compared points leave a motion free, as a plane, a sphere or a cylinder does")
    step = np.linalg.solve(gram, (J * w[:, None]).T @ distance)
    turn = exp_rotation(step[:3])
    return Alignment(R=turn @ start.R, t=turn @ (start.t - centre) + centre + step[3:], rule="best fit")
