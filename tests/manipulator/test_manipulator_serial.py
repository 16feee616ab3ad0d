"""Serial robots: both DH forms, exact Jacobians, inverse kinematics, logs that contradict themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tomopose.errors import InputError, OutOfReachError, ShapeError, TrajectoryError
from tomopose.geometry.rotations import R_x, R_z, log_rotation, rotation_angle_between
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.serial import Joint, SerialRobot, poses_from_joints
from tomopose.manipulator.virtual import typical_robot


def some_joints(robot: SerialRobot, rng: np.random.Generator, n: int = 9) -> np.ndarray:
    return robot.q_start + rng.uniform(-0.3, 0.3, (n, len(robot.joints)))


def test_planar_arm_by_hand() -> None:
    """Two links of 300 and 200 mm, elbow at a right angle: the textbook's planar arm in DH form."""
    arm = SerialRobot(joints=(Joint(a=300.0, alpha=0.0, d=0.0), Joint(a=200.0, alpha=0.0, d=0.0)))
    T = arm.forward(np.radians([[30.0, 90.0]]))
    x = 300 * np.cos(np.radians(30)) + 200 * np.cos(np.radians(120))
    y = 300 * np.sin(np.radians(30)) + 200 * np.sin(np.radians(120))
    np.testing.assert_allclose(T.t[0], [x, y, 0], atol=1e-9)
    assert rotation_angle_between(T.R[0], R_z(np.radians(120.0))) < 1e-12


def test_sliding_joint_slides_along_z() -> None:
    robot = SerialRobot(joints=(Joint(a=0.0, alpha=np.pi / 2, d=5.0, kind="sliding"), Joint(a=10.0, alpha=0.0, d=0.0)))
    np.testing.assert_allclose(robot.forward(np.array([[7.0, 0.0]])).t[0], [10.0, 0.0, 12.0], atol=1e-12)


def test_modified_form_holds_the_same_arm(rng: np.random.Generator) -> None:
    """a and alpha move to the joint behind them: Rot_x(alpha_k) Trans_x(a_k) then come before joint k + 1."""
    robot = typical_robot()
    a, alpha = [0.0] + [j.a for j in robot.joints], [0.0] + [j.alpha for j in robot.joints]
    modified = SerialRobot(
        joints=tuple(replace(j, a=a[k], alpha=alpha[k]) for k, j in enumerate(robot.joints)),
        convention="modified-dh",
        tool=RigidTransform(
            R=R_x(alpha[-1]),
            t=[a[-1], 0, 0],
            source=robot.forward(robot.q_start[None]).source,
            target=robot.forward(robot.q_start[None]).source,
        ).matrix,
    )
    q = some_joints(robot, rng)
    np.testing.assert_allclose(modified.forward(q).matrix, robot.forward(q).matrix, atol=1e-9)


@pytest.mark.parametrize("convention", ["dh", "modified-dh"])
def test_jacobians_are_exact(convention: str, rng: np.random.Generator) -> None:
    robot = typical_robot(eccentricity_sigma=1e-4)
    joints = tuple(replace(j, sigma={**j.sigma, "beta": 1e-4}) for j in robot.joints)
    robot = replace(robot, joints=joints, convention=convention)
    assert len(robot.names) == 42
    q = some_joints(robot, rng, 3)
    p = rng.standard_normal(42) * robot.sigma
    T, J_q, J_p = robot.chain(q, p)

    def difference(ahead: np.ndarray, behind: np.ndarray, h: float) -> np.ndarray:
        w = log_rotation(ahead[:, :3, :3] @ np.swapaxes(behind[:, :3, :3], 1, 2))
        return np.concatenate([w, ahead[:, :3, 3] - behind[:, :3, 3]], axis=1) / (2 * h)

    h = 1e-6
    for i in range(42):
        e = h * np.eye(42)[i]
        numeric = difference(robot.chain(q, p + e)[0], robot.chain(q, p - e)[0], h)
        np.testing.assert_allclose(J_p[:, :, i], numeric, atol=2e-6, err_msg=robot.names[i])
    for k in range(6):
        e = h * np.eye(6)[k]
        numeric = difference(robot.chain(q + e, p)[0], robot.chain(q - e, p)[0], h)
        np.testing.assert_allclose(J_q[:, :, k], numeric, atol=2e-6)
    assert T.shape == (3, 4, 4)


def test_tool_rides_along(rng: np.random.Generator) -> None:
    """A table whose Cartesian poses hold a constant tool keeps it, in the pose and in the Jacobian's lever."""
    robot = typical_robot()
    q = some_joints(robot, rng, 4)
    tool = np.eye(4)
    tool[:3, 3] = [30.0, -20.0, 150.0]
    plain = poses_from_joints(robot, q)
    T = RigidTransform.from_matrix(plain.T_MH.matrix @ tool, source=plain.T_MH.source, target=plain.T_MH.target)
    with_tool = replace(plain, T_MH=T)
    p = rng.standard_normal(len(robot.names)) * robot.sigma
    built_in = replace(robot, tool=tool)
    a, b = robot.real_poses(with_tool, p), built_in.real_poses(poses_from_joints(built_in, q), p)
    np.testing.assert_allclose(a.t, b.t, atol=1e-9)
    np.testing.assert_allclose(a.J, b.J, atol=1e-9)


def test_inverse_finds_the_joints(rng: np.random.Generator) -> None:
    robot = typical_robot()
    q = some_joints(robot, rng, 30)
    np.testing.assert_allclose(robot.inverse(robot.forward(q)), q, atol=1e-9)


def test_inverse_refuses_what_cannot_be(rng: np.random.Generator) -> None:
    robot = typical_robot()
    T = robot.forward(some_joints(robot, rng, 3))
    with pytest.raises(OutOfReachError, match="cannot reach 3 poses"):
        robot.inverse(replace(T, t=T.t + [5000.0, 0, 0]))
    straight = np.array([[0.1, 0.2, 0.3, 0.1, 0.0, 0.2]])  # wrist stretched: axes 4 and 6 coincide
    with pytest.raises(TrajectoryError, match="singular"):
        robot.inverse(robot.forward(straight), q_start=straight)


def test_joints_and_poses_must_belong_together(rng: np.random.Generator) -> None:
    robot = typical_robot()
    poses = poses_from_joints(robot, some_joints(robot, rng))
    with pytest.raises(InputError, match="do not belong together"):
        robot.real_poses(replace(poses, q=np.degrees(poses.q)), np.zeros(len(robot.names)))


def test_bad_robots_are_refused() -> None:
    with pytest.raises(InputError, match="without joints"):
        SerialRobot(joints=())
    with pytest.raises(InputError, match="no error 'length'"):
        Joint(a=1.0, alpha=0.0, d=0.0, sigma={"length": 0.1})
    with pytest.raises(InputError, match="not a finite number"):
        Joint(a=float("nan"), alpha=0.0, d=0.0)
    with pytest.raises(InputError, match="convention"):
        replace(typical_robot(), convention="craig")
    with pytest.raises(ShapeError, match="q_start"):
        replace(typical_robot(), q_start=np.zeros(5))
    with pytest.raises(ShapeError, match=r"\(n, 6\)"):
        typical_robot().chain(np.zeros((2, 5)))
