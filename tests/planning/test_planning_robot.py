"""A scan planned for a robot: joints in their stroke, against joint values that are known without a solver."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_planning_predict import box_part

import tomopose as tp
from tomopose.errors import InputError, OutOfReachError, UnitError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.files import read_manipulator, write_manipulator
from tomopose.manipulator.serial import Joint, SerialRobot
from tomopose.manipulator.virtual import typical_robot
from tomopose.planning.part.settings import PartSettings
from tomopose.planning.part_scan.limits_file import ScanLimits, default_travel
from tomopose.planning.part_scan.paths import usual_paths
from tomopose.planning.part_scan.plan import plan_part_scan
from tomopose.planning.part_scan.robot_at_work import RobotAtWork
from tomopose.planning.part_scan.setting import Setting
from tomopose.planning.part_scan.stations import allowed, stations, turns
from tomopose.trajectory.completeness import source_path
from tomopose.trajectory.feasibility import TravelLimits

SCANNER = tp.Scanner(d_SD=1000.0, d_SR=400.0, p_u=1.6, p_v=1.5, u_0=23.3, v_0=20.1, n_u=47, n_v=43)
COARSE = PartSettings(mu=0.05, alpha_step=math.radians(15.0), tilt_step=math.radians(5.0))
ORDER = (2, 1, 0, 3, 4, 5)
"""The gantry's joints are its axes z, y, x, rx, ry, rz: its joint values need no inverse kinematics."""


def gantry(low: np.ndarray, high: np.ndarray) -> SerialRobot:
    """T = Trans(x, y, z) R_x R_y R_z in DH parameters; limits low, high (6,) of x, y, z (mm), rx, ry, rz (rad)."""
    twist, zero = (-90.0, 90.0, 0.0, -90.0, 90.0, 0.0), (0.0, 90.0, 0.0, 0.0, -90.0, 0.0)
    joints = tuple(
        Joint(
            a=0.0,
            alpha=math.radians(twist[k]),
            d=0.0,
            theta_offset=math.radians(zero[k]),
            kind="sliding" if k < 3 else "turning",
            limits=(float(low[axis]), float(high[axis])),
        )
        for k, axis in enumerate(ORDER)
    )
    return SerialRobot(joints=joints)


def wide() -> ScanLimits:
    travel = default_travel()
    low, high = travel.low.copy(), travel.high.copy()
    low[3:6], high[3:6] = -0.3, 0.3
    return ScanLimits(travel=TravelLimits(low=low, high=high))


def setting(**changed: object) -> Setting:
    given = {"scanner": SCANNER, "part": box_part(), "views": 5, "settings": COARSE, "limits": wide()}
    return Setting(**{**given, **changed})


def with_limits(robot: SerialRobot, half_deg: float) -> SerialRobot:
    half = math.radians(half_deg)
    joints = tuple(
        replace(j, limits=(float(q) - half, float(q) + half)) for j, q in zip(robot.joints, robot.q_start, strict=True)
    )
    return replace(robot, joints=joints)


def chain(robot: SerialRobot, q: np.ndarray) -> np.ndarray:
    """T_MH (4, 4) of joint values (m,), link by link as the DH table says."""
    T = np.eye(4)
    for joint, value in zip(robot.joints, q, strict=True):
        theta, d = (joint.theta_offset + value, joint.d) if joint.kind == "turning" else (joint.theta_offset, value)
        for R, t in ((R_z(theta), [0.0, 0.0, d]), (R_x(joint.alpha), [joint.a, 0.0, 0.0])):
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = R, t
            T = T @ step
    return T @ np.asarray(robot.tool)


def test_the_joints_of_a_gantry_are_the_axes_of_the_plan(rng: np.random.Generator) -> None:
    half = np.array([6.0, 5.0, 4.0, 0.2, 0.15, 0.25])
    machine = RobotAtWork(robot=gantry(-half, half))
    q = rng.uniform(-1.2, 1.2, (200, 6)) * half
    R = R_x(q[:, 3]) @ R_y(q[:, 4]) @ R_z(q[:, 5])
    joints, arrived = machine.joint_values(R, q[:, :3])
    assert arrived.all()
    np.testing.assert_allclose(joints, q[:, ORDER], atol=1e-9)
    np.testing.assert_array_equal(machine.reaches(R, q[:, :3]), (np.abs(q) <= half).all(axis=1))
    assert 0 < machine.reaches(R, q[:, :3]).sum() < 200


@pytest.mark.slow
def test_a_plan_with_a_gantry_keeps_to_its_strokes_as_to_travel() -> None:
    half = np.array([8.0, 8.0, 6.0, 0.12, 0.1, 0.05])
    free, held = setting(), setting(manipulator=gantry(-half, half))
    q = stations(replace(held.machine, manipulator=None), held.part, COARSE)
    within = (np.abs(q[:, :6]) <= half + 1e-9).all(axis=1)
    assert 0 < within.sum() < len(q)
    np.testing.assert_array_equal(allowed(held.machine, held.part, q, margin=2.0), within)
    plan = plan_part_scan(held)
    assert plan.poses.q is not None
    assert (np.abs(plan.poses.q) <= half[list(ORDER)] + 1e-9).all()
    np.testing.assert_allclose(plan.poses.q, plan.chosen.q[:, ORDER], atol=1e-9)
    assert not (np.abs(plan_part_scan(free).chosen.q[:, :6]) <= half).all()


def test_the_matrices_of_a_robots_plan_are_those_of_its_own_poses(rng: np.random.Generator) -> None:
    """Base, mount and tool lie anywhere: joint values -> chain by hand -> eq. (5) with the working pose as home."""
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = R_x(0.4) @ R_z(0.7), [5.0, -8.0, 60.0]
    robot = with_limits(replace(typical_robot(), tool=tool), 60.0)
    mount = RigidTransform(R=R_z(0.3) @ R_x(0.5), t=np.array([30.0, -700.0, 200.0]), source=Frame.H, target=Frame.T)
    at_work = RobotAtWork(robot=robot, mount=mount)
    machine = replace(setting().machine, manipulator=at_work, T_HT=at_work.T_HT)
    q = rng.uniform(-1, 1, (12, 7)) * [6, 6, 6, 0.3, 0.3, 0.4, 3.0]
    told = machine.commanded(q)
    assert told.q is not None
    T_MH = np.stack([chain(robot, row) for row in told.q])
    np.testing.assert_allclose(told.T_MH.matrix, T_MH, atol=1e-8)
    home = RigidTransform.from_matrix(chain(robot, robot.q_start), source=Frame.M, target=Frame.H)
    own = RigidTransform(R=T_MH[:, :3, :3], t=T_MH[:, :3, 3], source=Frame.M, target=Frame.H)
    P = eq5_matrices(SCANNER, T_HT=mount, T_MH=own, alpha=q[:, 6], home=home)
    np.testing.assert_allclose(P, machine.matrices(q), rtol=1e-9, atol=1e-6)


@pytest.mark.slow
def test_a_robot_without_a_table_turns_the_part_itself() -> None:
    """The six joints of an arm, the last one turning the part by up to a whole turn; the table stands still."""
    travel = default_travel()
    low, high = travel.low.copy(), travel.high.copy()
    low[3:], high[3:] = [-0.2, -0.2, -math.pi, 0.0], [0.2, 0.2, math.pi, 0.0]
    # q_2 + q_3 + q_5 = -90 deg: the last axis points upwards
    start, strokes = np.radians([0, -10, 30, 0, -110, 0]), np.radians([170, 120, 150, 190, 125, 350])
    joints = tuple(
        replace(j, limits=(-float(s), float(s))) for j, s in zip(typical_robot().joints, strokes, strict=True)
    )
    robot = replace(typical_robot(), q_start=start, joints=joints)
    np.testing.assert_allclose(chain(robot, start)[:3, 2], [0, 0, 1], atol=1e-12)
    task = setting(limits=ScanLimits(travel=TravelLimits(low=low, high=high)), manipulator=robot, views=6)
    plan = plan_part_scan(task)
    assert plan.poses.q is not None
    assert (np.abs(plan.poses.q) <= strokes + 1e-9).all()
    assert (plan.poses.alpha == 0).all()
    np.testing.assert_allclose(np.stack([chain(robot, q) for q in plan.poses.q]), plan.poses.T_MH.matrix, atol=1e-8)
    assert np.ptp(plan.chosen.q[:, 5]) > math.radians(180.0)
    circle = source_path(plan.machine.matrices(usual_paths(plan.machine, 12)["circular"]))
    assert np.ptp(circle[:, 2]) < 1e-6
    assert np.ptp(np.arctan2(circle[:, 1], circle[:, 0])) > math.radians(300.0)


def test_a_plate_without_limits_of_rz_turns_the_part_once() -> None:
    travel = default_travel()
    low, high = travel.low.copy(), travel.high.copy()
    low[5:], high[5:] = [-math.inf, 0.0], [math.inf, 0.5]
    machine = setting(limits=ScanLimits(travel=TravelLimits(low=low, high=high))).machine
    found = turns(machine, math.radians(30.0))
    np.testing.assert_allclose(np.diff(found), math.radians(30.0))
    assert len(found) == 12


def test_what_a_robot_cannot_do_is_said_in_words() -> None:
    robot = typical_robot()
    with pytest.raises(InputError, match="joint 1 of the robot has no limits_deg"):
        setting(manipulator=robot)
    outside = replace(robot, joints=tuple(replace(j, limits=(-0.05, 0.05)) for j in robot.joints))
    with pytest.raises(InputError, match="joint 1 of the robot is at 5 deg in its working pose"):
        setting(manipulator=outside)
    small = np.full(6, 1e-6)
    lifted = wide()
    low = lifted.travel.low.copy()
    low[2] = 5.0
    with pytest.raises(OutOfReachError, match=r"joint 1 leaves its stroke in \d+ of \d+ poses.*may from -1e-06 to"):
        plan_part_scan(
            setting(
                manipulator=gantry(-small, small),
                limits=ScanLimits(travel=TravelLimits(low=low, high=lifted.travel.high)),
            )
        )


def test_limits_of_joints_are_read_and_written(tmp_path: Path) -> None:
    half = np.array([8.0, 8.0, 6.0, 0.12, 0.1, 0.05])
    path = tmp_path / "robot.json"
    write_manipulator(path, gantry(-half, half))
    document = json.loads(path.read_text())
    assert document["joints"][0]["limits_mm"] == [-6.0, 6.0]
    assert document["joints"][3]["limits_deg"] == pytest.approx([-np.degrees(0.12), np.degrees(0.12)])
    found = read_manipulator(path)
    assert isinstance(found, SerialRobot)
    assert [j.limits for j in found.joints] == [pytest.approx(j.limits) for j in gantry(-half, half).joints]
    for changed, error, match in (
        ({"limits_deg": [170.0, -170.0]}, InputError, "lowest, highest"),
        ({"limits_deg": [-2.967, 2.967]}, UnitError, "whole degrees if they are rad"),
        ({"limits_mm": [-1.0, 1.0]}, UnitError, "a turning joint has limits_deg"),
        ({"limits_deg": [-170.0]}, InputError, "limits_deg"),
        ({"limits_deg": [-170.0, float("nan")]}, InputError, "limits_deg"),
    ):
        joints = [dict(j) for j in document["joints"]]
        joints[3] = {k: v for k, v in joints[3].items() if not k.startswith("limits")} | changed
        path.write_text(json.dumps({**document, "joints": joints}))
        with pytest.raises(error, match=match):
            read_manipulator(path)
