"""The hexapod: inverse and forward kinematics, the exact Jacobian by its errors, and poses that it cannot take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import fsolve

from tomopose import PoseSequence
from tomopose.errors import InputError, OutOfReachError, ShapeError, TrajectoryError
from tomopose.geometry.rotations import exp_rotation, log_rotation, rotation_angle_between
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.virtual import typical_hexapod

NM, NRAD = 1e-6, 1e-9


def some_poses(rng: np.random.Generator, n: int = 17) -> PoseSequence:
    return PoseSequence.from_table(rng.uniform(-10, 10, (n, 3)), rng.uniform(-8, 8, (n, 3)))


def everything() -> Hexapod:
    return replace(typical_hexapod(), leg_scale_sigma=1e-4, axes_sigma=2e-3, pivot_sigma=1.0)


def test_legs_are_distances_between_joints(rng: np.random.Generator) -> None:
    machine, poses = typical_hexapod(), some_poses(rng)
    legs = machine.leg_lengths(poses.T_MH.R, poses.T_MH.t)
    for k in range(6):
        x = poses.T_MH.apply(machine.platform_joints[k])
        np.testing.assert_allclose(legs[:, k], np.linalg.norm(x - machine.base_joints[k], axis=1), atol=NM)
    np.testing.assert_allclose(machine.leg_lengths(np.eye(3)[None], np.zeros((1, 3))), 250.0, atol=NM)


def test_forward_undoes_inverse(rng: np.random.Generator) -> None:
    machine, poses = typical_hexapod(), some_poses(rng)
    legs = machine.leg_lengths(poses.T_MH.R, poses.T_MH.t)
    n = len(poses)
    R, t = machine.forward(legs, np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))
    assert rotation_angle_between(R, poses.T_MH.R).max() < NRAD
    np.testing.assert_allclose(t, poses.T_MH.t, atol=NM)


def test_without_errors_the_plate_is_where_it_was_commanded(rng: np.random.Generator) -> None:
    machine, poses = everything(), some_poses(rng)
    real = machine.real_poses(poses, np.zeros(len(machine.names)))
    assert rotation_angle_between(real.R, poses.T_MH.R).max() < NRAD
    np.testing.assert_allclose(real.t, poses.T_MH.t, atol=NM)


def test_real_pose_fulfils_the_constraints_of_the_real_machine(rng: np.random.Generator) -> None:
    """Against a general root finder that knows only that every real leg has its commanded length plus its offset."""
    machine = replace(typical_hexapod(), scale_sigma=0.0, geometry_sigma=0.0)
    poses = some_poses(rng, 4)
    p = rng.standard_normal(42) * machine.sigma
    b, m = machine.base_joints + p[:18].reshape(6, 3), machine.platform_joints + p[18:36].reshape(6, 3)
    legs = machine.leg_lengths(poses.T_MH.R, poses.T_MH.t) + p[36:]
    real = machine.real_poses(poses, p)
    for k in range(len(poses)):

        def miss(x: np.ndarray, k: int = k) -> np.ndarray:
            placed = m @ exp_rotation(x[:3]).T + x[3:]
            return np.linalg.norm(placed - b, axis=1) - legs[k]

        x = fsolve(miss, np.concatenate([log_rotation(poses.T_MH.R[k]), poses.T_MH.t[k]]), xtol=1e-13)
        assert rotation_angle_between(exp_rotation(x[:3]), real.R[k]) < 1e-8
        np.testing.assert_allclose(real.t[k], x[3:], atol=1e-5)
    assert np.linalg.norm(real.t - poses.T_MH.t, axis=1).max() > 0.05, "errors of 0.1 mm must show"


def test_jacobian_is_exact(rng: np.random.Generator) -> None:
    machine, poses = everything(), some_poses(rng, 5)
    p = rng.standard_normal(len(machine.names)) * machine.sigma
    real = machine.real_poses(poses, p)
    for i, sigma in enumerate(machine.sigma):
        e = np.zeros(len(p))
        e[i] = 1e-3 * sigma
        ahead, behind = machine.real_poses(poses, p + e), machine.real_poses(poses, p - e)
        w = log_rotation(ahead.R @ np.swapaxes(behind.R, 1, 2)) / (2 * e[i])
        t = (ahead.t - behind.t) / (2 * e[i])
        np.testing.assert_allclose(real.J[:, :3, i] * sigma, w * sigma, atol=1e-8, err_msg=machine.names[i])
        np.testing.assert_allclose(real.J[:, 3:, i] * sigma, t * sigma, atol=1e-6, err_msg=machine.names[i])


def test_turned_axes_turn_elsewhere_but_shift_as_commanded() -> None:
    """Turning axes rotated by 2.6 mrad about z against the shifting axes, field observation on a real hexapod."""
    machine = Hexapod(
        base_joints=typical_hexapod().base_joints,
        platform_joints=typical_hexapod().platform_joints,
        joint_sigma=0.0,
        leg_sigma=0.0,
        scale_sigma=0.0,
        geometry_sigma=0.0,
        axes_sigma=1e-3,
    )
    c = np.array([0.0, 0.0, 2.6e-3])
    poses = PoseSequence.from_table([[4.0, -3.0, 2.0], [0, 0, 0]], [[0, 0, 0], [0, 5.0, 0]])
    real = machine.real_poses(poses, c)
    np.testing.assert_allclose(real.t, poses.T_MH.t, atol=NM)
    w = log_rotation(real.R[1])
    np.testing.assert_allclose(w, exp_rotation(c) @ [0, np.radians(5.0), 0], atol=NRAD)


def test_names_units_and_sizes() -> None:
    machine = typical_hexapod()
    assert len(machine.names) == 47
    assert len(set(machine.names)) == 47
    assert len(replace(machine, scale_sigma=0.0, geometry_sigma=0.0).names) == 42
    assert machine.sigma.shape == (47,)
    np.testing.assert_allclose(machine.resized(np.array([2.0])).sigma[:42], 2 * machine.sigma[:42])


def test_singular_platform_is_named(rng: np.random.Generator) -> None:
    """A platform that is a scaled copy of its base can turn about the vertical without changing a leg."""
    machine = typical_hexapod()
    copy = machine.base_joints * [0.5, 0.5, 1.0] + [0, 0, 200.0]
    singular = replace(machine, platform_joints=copy)
    with pytest.raises(TrajectoryError, match="singular") as caught:
        singular.real_poses(some_poses(rng), np.zeros(len(singular.names)))
    assert len(caught.value.indices) == 17


def test_out_of_reach_is_named(rng: np.random.Generator) -> None:
    machine, poses = typical_hexapod(), some_poses(rng)
    limited = replace(machine, leg_limits=(249.0, 251.0))
    with pytest.raises(OutOfReachError, match=r"legs of .* mm, outside 249 to 251"):
        limited.real_poses(poses, np.zeros(len(machine.names)))
    far = PoseSequence.from_table([[0, 0, 0], [0, 0, 600.0]], np.zeros((2, 3)))
    with pytest.raises(OutOfReachError, match="outside half or twice their length at home") as caught:
        machine.real_poses(far, np.zeros(len(machine.names)))
    assert caught.value.indices == (1,)
    below = PoseSequence.from_table([[0, 0, -500.0]], np.zeros((1, 3)))
    with pytest.raises(OutOfReachError, match="lean by more than 90 deg"):
        machine.real_poses(below, np.zeros(len(machine.names)))
    with pytest.raises(OutOfReachError, match="cannot be reached"):
        machine.forward(np.full((1, 6), 20.0), np.eye(3)[None], np.zeros((1, 3)))


def test_bad_machines_are_refused() -> None:
    machine = typical_hexapod()
    with pytest.raises(ShapeError, match="6 joints"):
        replace(machine, base_joints=machine.base_joints[:5])
    with pytest.raises(InputError, match="not finite"):
        replace(machine, platform_joints=np.full((6, 3), np.nan))
    with pytest.raises(InputError, match="joint_sigma"):
        replace(machine, joint_sigma=-0.1)
    with pytest.raises(ShapeError, match="47 errors"):
        machine.real_poses(PoseSequence.from_table([[0, 0, 0]], [[0, 0, 0]]), np.zeros(42))
    with pytest.raises(InputError, match="too short"):
        typical_hexapod(leg=20.0)
