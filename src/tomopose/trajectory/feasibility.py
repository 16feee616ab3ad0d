"""Can the manipulator go there, does the object stay in view, does anything collide?

Each question has a function that answers it with arrays, and one that raises where the answer is no.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, OutOfReachError, OutOfViewError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array, float_array
from tomopose.values import value

AXES = ("x", "y", "z", "rx", "ry", "rz", "table angle")
TOLERANCE = 1e-9


@value
class TravelLimits:
    """Travel of each axis by itself: low and high (7,) of x, y, z (mm), the angles of R_x R_y R_z and the table (rad).

    A hexapod's axes depend on one another; the limits of its legs are those of the manipulator's own model.
    """

    low: Array
    high: Array

    def __post_init__(self) -> None:
        low, high = float_array(self.low), float_array(self.high)
        if low.shape != (7,) or high.shape != (7,):
            raise ShapeError(f"travel limits need 7 values ({', '.join(AXES)}); got {low.shape} and {high.shape}")
        if np.isnan(low).any() or np.isnan(high).any() or (low > high).any():
            raise InputError("a travel limit is not a number, or a low one is above its high one")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @classmethod
    def symmetric(
        cls,
        *,
        x: float = np.inf,
        y: float = np.inf,
        z: float = np.inf,
        rx: float = np.inf,
        ry: float = np.inf,
        rz: float = np.inf,
        alpha: float = np.inf,
    ) -> TravelLimits:
        """From half ranges, mm and rad; an axis that is left out is not limited."""
        high = np.array([x, y, z, rx, ry, rz, alpha])
        return cls(low=-high, high=high)


def travel(poses: PoseSequence) -> Array:
    """Axis values (n, 7) of poses: x, y, z (mm), angles of R_x R_y R_z and table angle (rad)."""
    return np.column_stack([poses.T_MH.t, poses.T_MH.angles, poses.alpha])


def beyond_travel(poses: PoseSequence, limits: TravelLimits) -> Array:
    """How far (n, 7) each axis goes beyond its travel, mm and rad; 0 inside."""
    values = travel(poses)
    return np.maximum(np.maximum(limits.low - values, values - limits.high), 0.0)


def require_reachable(poses: PoseSequence, limits: TravelLimits) -> None:
    """OutOfReachError, naming the worst pose and axis, where an axis goes beyond its travel."""
    beyond = beyond_travel(poses, limits)
    bad = np.flatnonzero((beyond > TOLERANCE).any(axis=1))
    if bad.size:
        k, axis = np.unravel_index(int(beyond.argmax()), beyond.shape)
        scale, unit = (1.0, "mm") if axis < 3 else (180 / np.pi, "deg")
        raise OutOfReachError(
            f"{bad.size} of {len(poses)} poses are out of reach; pose {poses.pose_id[k]!r} needs "
            f"{AXES[axis]} = {travel(poses)[k, axis] * scale:.4g} {unit}, the travel is "
            f"{limits.low[axis] * scale:.4g} to {limits.high[axis] * scale:.4g} {unit}",
            indices=bad.tolist(),
            limits=limits,
        )


def cylinder(radius: float, z_low: float, z_high: float, *, corners: int = 64) -> Array:
    """Points (2 corners, 3), mm, whose convex hull just holds an upright cylinder about z: what must stay in view.

    The polygon is circumscribed, so a view that shows all points shows the cylinder.
    """
    if not (radius > 0 and z_high > z_low):
        raise InputError(f"a cylinder of radius {radius:g} mm from z = {z_low:g} to {z_high:g} mm is not a cylinder")
    phi = 2 * np.pi * np.arange(corners) / corners
    rim = radius / np.cos(np.pi / corners) * np.column_stack([np.cos(phi), np.sin(phi)])
    return np.vstack([np.column_stack([rim, np.full(corners, z)]) for z in (z_low, z_high)])


def in_view(P: ArrayLike, x: Array, *, n_u: int, n_v: int, margin: float = 0.0) -> np.ndarray:
    """(n, m) bool: which of the points x (m, 3), mm, matrices P (n, 3, 4) put on the panel, `margin` px inside."""
    x_D = project(P, x)
    low, high = margin - 0.5, np.array([n_u, n_v]) - 0.5 - margin
    with np.errstate(invalid="ignore"):
        return np.asarray(((x_D >= low) & (x_D <= high)).all(axis=-1))


def require_in_view(P: ArrayLike, x: Array, *, n_u: int, n_v: int, margin: float = 0.0) -> None:
    """OutOfViewError, naming the views, where a point leaves the panel."""
    hidden = ~in_view(P, x, n_u=n_u, n_v=n_v, margin=margin)
    bad = np.flatnonzero(hidden.any(axis=1))
    if bad.size:
        worst = int(hidden.sum(axis=1).argmax())
        raise OutOfViewError(
            f"in {bad.size} of {len(hidden)} views the object leaves the field of view; the worst is view {worst}, "
            f"where {int(hidden[worst].sum())} of {len(x)} points are outside",
            indices=bad.tolist(),
        )


def ball_outline(
    scanner: Scanner, *, T_HT: RigidTransform, poses: PoseSequence, t: Array, radius: float
) -> tuple[Array, Array]:
    """Lowest and highest pixel (n, 2) each of the ball's silhouette, per pose; NaN where the ball reaches the source.

    A ball of radius r about c has the dual quadric Q* = [[r^2 - c c^T, -c], [-c^T, -1]]; its silhouette is the dual
    conic C* = P Q* P^T, and lines u = const touch it where C*_33 u^2 - 2 C*_13 u + C*_11 = 0 (Hartley and Zisserman,
    Multiple View Geometry, secs. 3.2 and 8.3).
    """
    T_HT.require(Frame.H, Frame.T)
    c_T = T_HT.apply((poses.T_MH.R @ np.asarray(t, dtype=np.float64)) + poses.T_MH.t)
    T_TW = scanner.T_TW(poses.alpha)
    c = (T_TW.R @ c_T[:, :, None])[..., 0] + T_TW.t
    c_S = scanner.T_WS.apply(c)
    Q = np.eye(3) * radius**2 - c_S[:, :, None] * c_S[:, None, :]
    C = scanner.K @ Q @ scanner.K.T
    with np.errstate(invalid="ignore"):
        root = np.sqrt(np.stack([C[:, k, 2] ** 2 - C[:, k, k] * C[:, 2, 2] for k in (0, 1)], axis=-1))
    centre, half = C[:, :2, 2] / C[:, 2:, 2], np.abs(root / C[:, 2:, 2])
    behind = c_S[:, 2] <= radius
    centre[behind] = np.nan
    return centre - half, centre + half


def ball_in_view(
    scanner: Scanner, *, T_HT: RigidTransform, poses: PoseSequence, t: Array, radius: float, margin: float = 0.0
) -> np.ndarray:
    """(n,) bool: in which poses the whole ball, t (3,) and radius in mm, is on the panel, `margin` px inside."""
    low, high = ball_outline(scanner, T_HT=T_HT, poses=poses, t=t, radius=radius)
    end = np.array([scanner.n_u, scanner.n_v]) - 0.5 - margin
    return np.asarray(((low >= margin - 0.5) & (high <= end)).all(axis=1))


def collisions(
    scanner: Scanner, *, T_HT: RigidTransform, poses: PoseSequence, x_M: Array, low: Array, high: Array
) -> np.ndarray:
    """(n,) bool: in which poses a point x_M (m, 3) of what moves enters a box of W, low (3,) to high (3,), mm.

    Points only: give them as densely as the box is thick.
    """
    x_T = T_HT.require(Frame.H, Frame.T).apply(poses.T_MH.apply(x_M).reshape(-1, 3)).reshape(len(poses), -1, 3)
    T_TW = scanner.T_TW(poses.alpha)
    x_W = np.einsum("nij,nmj->nmi", T_TW.R, x_T) + T_TW.t[:, None]
    return np.asarray(((x_W >= low) & (x_W <= high)).all(axis=2).any(axis=1))
