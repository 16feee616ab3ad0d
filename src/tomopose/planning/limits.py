"""What a calibration pose may be: travel, table angles, field of view, magnification, collisions, time."""

from __future__ import annotations

import math
from dataclasses import field

import numpy as np

from tomopose.errors import InputError, OutOfReachError
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.trajectory.feasibility import TravelLimits, ball_in_view, collisions
from tomopose.units import Array
from tomopose.values import value


def _paper_travel() -> TravelLimits:
    tilt = math.radians(5.0)
    return TravelLimits.symmetric(x=10.0, y=10.0, z=10.0, rx=tilt, ry=tilt, rz=tilt)


@value
class PlanLimits:
    """travel:        of the manipulator's axes (default +-10 mm and +-5 degrees, the paper's).
    table_angles:  rad, the angles that the table may take; (0,) keeps it still.
    ball_radius:   mm;  margin: px that the whole ball keeps from the panel's edge.
    magnification: (least, most) of the ball, or None.
    moved_points:  (p, 3) mm in M, of what moves with the plate;  boxes: (low, high) pairs, mm in W, none may enter.
    image_time:    s an image;  speed: mm/s;  turn_speed: rad/s;  table_speed: rad/s;  settle: s a move;
    total_time:    s, or None: an upper limit on the whole run.
    """

    travel: TravelLimits = field(default_factory=_paper_travel)
    table_angles: tuple[float, ...] = (0.0,)
    ball_radius: float = 4.0
    margin: float = 10.0
    magnification: tuple[float, float] | None = None
    moved_points: Array | None = None
    boxes: tuple[tuple[Array, Array], ...] = ()
    image_time: float = 2.0
    speed: float = 2.0
    turn_speed: float = math.radians(2.0)
    table_speed: float = math.radians(10.0)
    settle: float = 1.0
    total_time: float | None = None

    def __post_init__(self) -> None:
        if not self.table_angles:
            raise InputError("a plan needs at least one table angle; (0,) keeps the table still")
        if not np.isfinite([*self.travel.low[:6], *self.travel.high[:6]]).all():
            raise InputError("a plan needs a finite travel of all six axes of the manipulator")
        for name in ("image_time", "speed", "turn_speed", "table_speed"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name)}; a positive number is needed")


def allowed(scanner: Scanner, poses: PoseSequence, *, T_HT: RigidTransform, t: Array, limits: PlanLimits) -> np.ndarray:
    """(n,) bool: in view with the whole ball, within the magnification, and without collision."""
    good = ball_in_view(scanner, T_HT=T_HT, poses=poses, t=t, radius=limits.ball_radius, margin=limits.margin)
    alpha = poses.alpha
    if limits.magnification is not None:
        x_H = (poses.T_MH.R @ t) + poses.T_MH.t
        T_TW = scanner.T_TW(alpha)
        x_W = (T_TW.R @ T_HT.apply(x_H)[:, :, None])[..., 0] + T_TW.t
        depth = scanner.d_SR - x_W[:, 0]
        low, high = limits.magnification
        with np.errstate(divide="ignore"):
            M = scanner.d_SD / depth
        good = good & (depth > 0) & (low <= M) & (high >= M)
    if limits.boxes:
        x_M = t[None] if limits.moved_points is None else np.concatenate([t[None], limits.moved_points])
        for low_corner, high_corner in limits.boxes:
            good = good & ~collisions(
                scanner, T_HT=T_HT, poses=poses, x_M=x_M, low=np.asarray(low_corner), high=np.asarray(high_corner)
            )
    return np.asarray(good)


LEVELS = (-1.0, 0.0, 1.0)
SHRINK, SHRINKS = 0.8, 10


def candidates(scanner: Scanner, *, T_HT: RigidTransform, t: Array, limits: PlanLimits) -> PoseSequence:
    """All combinations of the ends and the middle of the six axes, at every table angle: 729 each.

    A pose that is not allowed is drawn towards the middle of the travel until it is, or left out.  OutOfReachError
    where none is left.
    """
    low, high = limits.travel.low[:6], limits.travel.high[:6]
    middle, half = (low + high) / 2, (high - low) / 2
    levels = np.stack(np.meshgrid(*[LEVELS] * 6, indexing="ij"), axis=-1).reshape(-1, 6)
    axes = np.tile(middle + levels * half, (len(limits.table_angles), 1))
    alpha = np.repeat(np.asarray(limits.table_angles, dtype=np.float64), len(levels))
    open_rows = np.arange(len(axes))
    good = np.zeros(len(axes), dtype=bool)
    for _ in range(SHRINKS):
        poses = sequence(axes[open_rows], alpha[open_rows])
        good[open_rows] = allowed(scanner, poses, T_HT=T_HT, t=t, limits=limits)
        open_rows = np.flatnonzero(~good)
        if not open_rows.size:
            break
        axes[open_rows] = middle + SHRINK * (axes[open_rows] - middle)
    if not good.any():
        raise OutOfReachError(
            "no pose within the travel keeps the whole ball in the field of view, at the wanted magnification and "
            "clear of the boxes; move the ball or the field, or widen the limits",
            limits=limits,
        )
    return sequence(axes[good], alpha[good])


def sequence(axes: Array, alpha: Array) -> PoseSequence:
    """Set poses from x, y, z (mm) and the angles of R_x R_y R_z (rad), (n, 6), and table angles (n,)."""
    return PoseSequence.from_table(axes[:, :3], np.degrees(axes[:, 3:]), alpha=alpha, source="set")
