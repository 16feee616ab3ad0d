"""A serial robot that holds the part: the plan's poses as its joint values, and whether they keep to their strokes.

A robot's zero is no pose of a scan: home is its working pose, that of q_start.  The plan moves the part from there,
about the tool's origin and along the axes of W, and the robot's own pose is

    R_MH = R_HT^T R R_HT R_0,      t_MH = t_0 + R_HT^T t,

(R, t) the plan's motion, (R_0, t_0) the working pose in the robot's base H, R_HT the base's orientation on the table.
Joint values are followed from the working pose in turns of at most FOLLOWED: the robot keeps the branch of q_start
(elbow, wrist), which it could not change between two views without a large move.  A turning joint may take a whole turn
more or less if that brings it within its stroke.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.serial import SerialRobot, in_unit
from tomopose.units import Array

FOLLOWED = 0.5
"""rad: largest turn between two solutions of the inverse kinematics, as the solver's own largest step."""
TURN = 2 * np.pi
TOLERANCE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotAtWork:
    """robot: with the limits of every joint;  mount: base -> table, of a calibration; without it the tool's axes are
    those of W in the working pose, and its origin is that of W."""

    robot: SerialRobot
    mount: RigidTransform | None = None

    def __post_init__(self) -> None:
        require_limits(self.robot)

    @cached_property
    def home(self) -> RigidTransform:
        """T_MH of the working pose."""
        T = self.robot.forward(self.robot.q_start[None])
        return RigidTransform(R=T.R[0], t=T.t[0], source=Frame.M, target=Frame.H)

    @property
    def R_HT(self) -> Array:
        return np.asarray(self.home.R.T if self.mount is None else self.mount.R)

    @property
    def T_HT(self) -> RigidTransform:
        """The plan's mount: the axes of the table, about the tool's origin in the working pose."""
        t = np.zeros(3) if self.mount is None else self.mount.apply(self.home.t)
        return RigidTransform(R=np.eye(3), t=t, source=Frame.H, target=Frame.T)

    def commanded(self, R: Array, t: Array) -> RigidTransform:
        """T_MH in the robot's base of the plan's motions R (n, 3, 3), t (n, 3) mm."""
        R_HT, home = self.R_HT, self.home
        return RigidTransform(R=R_HT.T @ R @ R_HT @ home.R, t=home.t + t @ R_HT, source=Frame.M, target=Frame.H)

    def joint_values(self, R: Array, t: Array) -> tuple[Array, np.ndarray]:
        """(q (n, m) rad or mm, (n,) bool: whether the arm gets there) of the plan's motions."""
        turn = log_rotation(R)
        steps = np.maximum(np.ceil(np.linalg.norm(turn, axis=1) / FOLLOWED), 1.0)
        q, arrived = np.tile(self.robot.q_start, (len(R), 1)), np.ones(len(R), dtype=bool)
        for k in range(1, int(steps.max(initial=0.0)) + 1):
            rows = np.flatnonzero(arrived & (k <= steps))
            share = (k / steps[rows])[:, None]
            q[rows], arrived[rows] = self.robot.approached(
                self.commanded(exp_rotation(share * turn[rows]), share * t[rows]), q[rows]
            )
        return self._wound(q), arrived

    def _wound(self, q: Array) -> Array:
        """q with turning joints a whole number of turns on, the nearest that lies within the stroke."""
        out = q.copy()
        for k, joint in enumerate(self.robot.joints):
            if joint.kind == "turning" and joint.limits is not None:
                low, high = joint.limits
                few = np.ceil((low - TOLERANCE - q[:, k]) / TURN)
                many = np.floor((high + TOLERANCE - q[:, k]) / TURN)
                fits = few <= many
                out[fits, k] += TURN * np.clip(0.0, few[fits], many[fits])
        return out

    @cached_property
    def limits(self) -> Array:
        """(2, m) lowest and highest value of each joint, rad or mm."""
        return np.array([j.limits for j in self.robot.joints], dtype=np.float64).T

    def beyond(self, q: Array) -> Array:
        """(n, m): how far joint values are outside their strokes, rad or mm."""
        beyond: Array = np.maximum(np.maximum(self.limits[0] - q, q - self.limits[1]), 0.0)
        return beyond

    def reaches(self, R: Array, t: Array) -> np.ndarray:
        """(n,) bool: the robot takes the plan's motions with every joint in its stroke."""
        if not len(R):
            return np.zeros(0, dtype=bool)
        q, arrived = self.joint_values(R, t)
        return np.asarray(arrived & (self.beyond(q) <= TOLERANCE).all(axis=1))

    def what_blocks(self, R: Array, t: Array) -> str:
        """Why not all of these motions can be taken, in words."""
        q, arrived = self.joint_values(R, t)
        if not arrived.any():
            return f"the robot's arm does not get to any of {len(R)} poses about its working pose"
        beyond = self.beyond(q[arrived])
        k = int((beyond > TOLERANCE).sum(axis=0).argmax())
        values, unit = q[arrived, k], self.robot.joint_units[k]
        first, last, low, high = (in_unit(x, unit) for x in (values.min(), values.max(), *self.limits[:, k]))
        return (
            f"joint {k + 1} leaves its stroke in {int((beyond[:, k] > TOLERANCE).sum())} of {len(R)} poses: it would "
            f"go from {first:.4g} to {last:.4g} {unit} and may from {low:.4g} to {high:.4g} {unit}"
        )


def require_limits(robot: SerialRobot) -> None:
    """InputError where the stroke of a joint is not known, or the working pose is outside of one."""
    for k, (joint, q, unit) in enumerate(zip(robot.joints, robot.q_start, robot.joint_units, strict=True)):
        if joint.limits is None:
            raise InputError(
                f"joint {k + 1} of the robot has no limits_{unit}; without it nobody knows its stroke: add the lowest "
                "and the highest value that the controller allows"
            )
        if not joint.limits[0] <= q <= joint.limits[1]:
            here, low, high = (in_unit(x, unit) for x in (q, *joint.limits))
            raise InputError(
                f"joint {k + 1} of the robot is at {here:.4g} {unit} in its working pose (q_start_deg) and may "
                f"go from {low:.4g} to {high:.4g} {unit}"
            )
