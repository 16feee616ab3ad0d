"""Candidate poses of a serial robot, for planning: about its working pose, wider than a hexapod could go.

A robot turns fully about its flange and tilts by tens of degrees; its zero is no pose of a scan.  The nominal mount is
taken such that the plate's axes (the tool's) are those of W in the working pose: z of the tool vertical, its origin,
the middle of the object, on the table's axis.

With the table still and one ball, all lengths of the robot, the ball's offset and the distance to the source can grow
together about the source without a change of any radiograph, whatever the poses: the scale of the object stays as good
as the links.  Table angles or a known distance between two balls determine it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.errors import OutOfReachError, TrajectoryError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.serial import SerialRobot, poses_from_joints
from tomopose.units import Array

DRAWS, SEED = 900, 20
SCAN_VIEWS, SCAN_TILT, SCAN_WAVES = 90, float(np.radians(8.0)), 7


@dataclass(frozen=True, kw_only=True)
class RobotWork:
    """Nominal mount, candidate poses and the scan that they are for, all with joint values."""

    T_HT: RigidTransform
    candidates: PoseSequence
    scan: PoseSequence


def robot_work(
    robot: SerialRobot, *, half_range: float, tilt: float, spin: float, table_angles: tuple[float, ...] = (0.0,)
) -> RobotWork:
    """Candidates within +-half_range (mm), tilts about x and y up to `tilt` and turns about z up to `spin` (rad),
    spread over the table angles (rad); the scan turns the object by +-spin, or with the table where it has several
    angles, and tilts it by 8 deg sin(7 angle).

    The working pose is that of the robot's q_start.  Poses out of its reach are left out.
    Raises OutOfReachError where the scan cannot be reached.
    """
    T_0 = robot.forward(robot.q_start[None])[0]
    T_HT = RigidTransform(R=T_0.R.T, t=-(T_0.R.T @ T_0.t), source=Frame.H, target=Frame.T)
    rng = np.random.default_rng(SEED)
    a = rng.uniform(-1.0, 1.0, (DRAWS, 3)) * [tilt, tilt, spin]
    drawn = _about(T_0, R_z(a[:, 2]) @ R_y(a[:, 1]) @ R_x(a[:, 0]), rng.uniform(-half_range, half_range, (DRAWS, 3)))
    alpha = np.asarray(table_angles, dtype=np.float64)[np.arange(DRAWS) % len(table_angles)]
    q, reached = _reachable(robot, drawn)
    turned_by_table = len(table_angles) > 1
    angle = np.arange(SCAN_VIEWS) * 2 * np.pi / SCAN_VIEWS if turned_by_table else np.linspace(-spin, spin, SCAN_VIEWS)
    wave = R_y(SCAN_TILT * np.sin(SCAN_WAVES * angle))
    turn = R_z(angle)
    R = np.swapaxes(turn, 1, 2) @ wave @ turn if turned_by_table else turn @ wave
    scan = robot.inverse(_about(T_0, R, np.zeros((SCAN_VIEWS, 3))))
    return RobotWork(
        T_HT=T_HT,
        candidates=poses_from_joints(robot, q, alpha=alpha[reached]),
        scan=poses_from_joints(robot, scan, alpha=angle if turned_by_table else np.zeros(SCAN_VIEWS)),
    )


def _about(T_0: RigidTransform, R: Array, t: Array) -> RigidTransform:
    """The working pose followed by turns R (n, 3, 3) about and shifts t (n, 3) along its own axes."""
    return RigidTransform(R=T_0.R @ R, t=T_0.t + t @ T_0.R.T, source=Frame.M, target=Frame.H)


def _reachable(robot: SerialRobot, T_MH: RigidTransform) -> tuple[Array, Any]:
    """Joint values (k, m) of the poses that can be reached, and their indices (k,)."""
    rows = np.arange(len(T_MH))
    while rows.size:
        try:
            return robot.inverse(T_MH[rows]), rows
        except TrajectoryError as error:  # out of reach, or singular
            rows = np.delete(rows, list(error.indices))
    raise OutOfReachError("the robot reaches no pose about its working pose; check q_start_deg and the travel")
