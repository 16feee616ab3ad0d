"""Corrected poses, commands that reach wanted poses, maps, inverse chains, run effects and virtual machines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tomopose import Frame, PoseSequence, RigidTransform
from tomopose.errors import InputError, OutOfReachError, ShapeError
from tomopose.geometry.rotations import exp_rotation, log_rotation, rotation_angle_between
from tomopose.io.calibration.errors_block import errors_document, errors_from_document
from tomopose.manipulator.error_models import (
    EmpiricalErrors,
    IdentifiedErrors,
    PoseRange,
    PoseScatter,
    RigidErrors,
    commands_for,
    corrected_poses,
    correction,
)
from tomopose.manipulator.inverse import InverseManipulator, inverse_poses
from tomopose.manipulator.pose_map import PoseMap
from tomopose.manipulator.real_poses import ErrorModel, Repeatability, left_jacobian
from tomopose.manipulator.run_effects import with_run_effects
from tomopose.manipulator.serial import poses_from_joints
from tomopose.manipulator.virtual import (
    Disturbance,
    encoder_readout,
    lag_of_backlash,
    real_motion,
    typical_hexapod,
    typical_robot,
)

HEXAPOD, ROBOT = typical_hexapod(), typical_robot()


def hexapod_poses(rng: np.random.Generator, n: int = 12) -> PoseSequence:
    return PoseSequence.from_table(rng.uniform(-10, 10, (n, 3)), rng.uniform(-5, 5, (n, 3)))


def robot_poses(rng: np.random.Generator, n: int = 12) -> PoseSequence:
    return poses_from_joints(ROBOT, ROBOT.q_start + rng.uniform(-0.2, 0.2, (n, 6)))


def errors_of(machine: ErrorModel, rng: np.random.Generator, poses: PoseSequence) -> IdentifiedErrors | EmpiricalErrors:
    p = rng.standard_normal(len(machine.names)) * machine.sigma
    of = EmpiricalErrors if isinstance(machine, PoseMap) else IdentifiedErrors
    return of(machine=machine, values=p, u=machine.sigma, range=PoseRange.of(poses))


def assert_exact_jacobian(machine: Any, poses: PoseSequence, p: np.ndarray) -> None:
    real = machine.real_poses(poses, p)
    for i, sigma in enumerate(machine.sigma):
        e = np.zeros(len(p))
        e[i] = 1e-3 * sigma
        ahead, behind = machine.real_poses(poses, p + e), machine.real_poses(poses, p - e)
        w = log_rotation(ahead.R @ np.swapaxes(behind.R, 1, 2)) / (2 * e[i])
        t = (ahead.t - behind.t) / (2 * e[i])
        np.testing.assert_allclose(real.J[:, :3, i] * sigma, w * sigma, atol=1e-9, err_msg=machine.names[i])
        np.testing.assert_allclose(real.J[:, 3:, i] * sigma, t * sigma, atol=1e-6, err_msg=machine.names[i])


def test_left_jacobian_of_rotations(rng: np.random.Generator) -> None:
    for w in (rng.standard_normal(3), 1e-6 * rng.standard_normal(3), np.zeros(3)):
        d = 1e-6 * rng.standard_normal(3)
        moved = log_rotation(exp_rotation(w + d) @ exp_rotation(w).T)
        np.testing.assert_allclose(left_jacobian(w) @ d, moved, atol=1e-11)


@pytest.mark.parametrize("order", [1, 2])
def test_pose_map_jacobian(order: int, rng: np.random.Generator) -> None:
    machine = PoseMap(order=order)
    assert len(machine.names) == len(set(machine.names)) == {1: 36, 2: 162}[order]
    assert_exact_jacobian(machine, hexapod_poses(rng, 3), rng.standard_normal(len(machine.names)) * machine.sigma)


def test_inverse_machine_jacobian(rng: np.random.Generator) -> None:
    machine = InverseManipulator(machine=replace(HEXAPOD, leg_scale_sigma=1e-4))
    poses = inverse_poses(hexapod_poses(rng, 3))
    assert_exact_jacobian(machine, poses, rng.standard_normal(len(machine.names)) * machine.sigma)


def test_inverse_poses_twice_is_nothing(rng: np.random.Generator) -> None:
    poses = encoder_readout(hexapod_poses(rng), settling=Repeatability(), rng=rng)
    again = inverse_poses(inverse_poses(poses))
    np.testing.assert_allclose(again.T_MH.matrix, poses.T_MH.matrix, atol=1e-12)
    assert again.T_MH_set is not None
    assert poses.T_MH_set is not None
    np.testing.assert_allclose(again.T_MH_set.matrix, poses.T_MH_set.matrix, atol=1e-12)


@pytest.mark.parametrize("which", ["hexapod", "robot"])
def test_run_effects_jacobian(which: str, rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng, 4) if which == "hexapod" else robot_poses(rng, 4)
    machine = with_run_effects(HEXAPOD if which == "hexapod" else ROBOT, poses)
    assert len(machine.names) == len(machine.units) == len(machine.sigma)
    assert_exact_jacobian(machine, poses, rng.standard_normal(len(machine.names)) * machine.sigma)


@pytest.mark.parametrize("which", ["hexapod", "robot", "robot cartesian", "map", "inverse"])
def test_commands_reach_the_wanted_poses(which: str, rng: np.random.Generator) -> None:
    wanted = robot_poses(rng) if which.startswith("robot") else hexapod_poses(rng)
    machine: ErrorModel = {"hexapod": HEXAPOD, "map": PoseMap(), "inverse": InverseManipulator(machine=HEXAPOD)}.get(
        which, ROBOT
    )
    if which == "robot cartesian":
        wanted = replace(wanted, q=None)
    errors = errors_of(machine, rng, wanted)
    command = commands_for(errors, wanted)
    reached = corrected_poses(errors, command)
    assert rotation_angle_between(reached.T_MH.R, wanted.T_MH.R).max() < 1e-9
    assert np.abs(reached.T_MH.t - wanted.T_MH.t).max() < 1e-6
    assert np.abs(command.T_MH.t - wanted.T_MH.t).max() > 1e-3, "without the correction it was elsewhere"
    assert (command.q is None) == (wanted.q is None)


def test_commands_out_of_reach_are_named(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng)
    legs = HEXAPOD.leg_lengths(poses.T_MH.R, poses.T_MH.t)
    limited = replace(HEXAPOD, leg_limits=(legs.min() + 1.0, legs.max() - 1.0))
    with pytest.raises(OutOfReachError, match="poses need legs"):
        commands_for(errors_of(limited, rng, poses), poses)


def test_correction_says_what_lies_outside(rng: np.random.Generator) -> None:
    errors = errors_of(HEXAPOD, rng, hexapod_poses(rng, 40))
    inside = correction(errors, PoseSequence.from_table([[1.0, 2, 3], [0, 0, 0]], [[1.0, 0, 0], [0, -2, 1]]))
    assert not inside.outside.any()
    assert inside.notes == ()
    outside = correction(errors, PoseSequence.from_table([[1.0, 2, 3], [0, 0, 0]], [[1.0, 0, 0], [0, -9, 0]]))
    np.testing.assert_array_equal(outside.outside, [False, True])
    assert "1 of 2 poses lie outside the range" in outside.notes[0]
    assert outside.J.shape == (2, 6, len(HEXAPOD.names))


def test_nothing_identified_changes_nothing(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng)
    assert corrected_poses(RigidErrors(), poses) is poses
    assert commands_for(RigidErrors(), poses) is poses


def test_scale_of_trusted_poses_is_applied_and_undone(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng)
    errors = RigidErrors(translation_scale=1.01)
    np.testing.assert_allclose(corrected_poses(errors, poses).T_MH.t, 1.01 * poses.T_MH.t)
    np.testing.assert_allclose(corrected_poses(errors, commands_for(errors, poses)).T_MH.t, poses.T_MH.t)


@pytest.mark.parametrize("which", ["hexapod", "robot", "map", "inverse"])
def test_errors_come_back_from_their_block(which: str, rng: np.random.Generator) -> None:
    poses = robot_poses(rng) if which == "robot" else hexapod_poses(rng)
    machine: ErrorModel = {"hexapod": HEXAPOD, "map": PoseMap(), "inverse": InverseManipulator(machine=HEXAPOD)}.get(
        which, ROBOT
    )
    errors = replace(
        errors_of(machine, rng, poses), scatter=PoseScatter(t=rng.random(3), w=rng.random(3), about_H=True)
    )
    again = errors_from_document(errors_document(errors))
    assert type(again) is type(errors)
    assert errors_document(again) == errors_document(errors)
    np.testing.assert_array_equal(corrected_poses(again, poses).T_MH.matrix, corrected_poses(errors, poses).T_MH.matrix)


def test_damaged_blocks_are_refused(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng)
    block = errors_document(errors_of(HEXAPOD, rng, poses))
    for changes, message in (
        ({"kind": "crane"}, "kind 'crane'"),
        ({"values": block["values"][:1] * 3, "u": block["u"][:3], "names": block["names"][:3]}, "do not fit"),
        ({"names": block["names"][::-1]}, "do not fit"),
    ):
        with pytest.raises(InputError, match=message):
            errors_from_document({**block, **changes})
    with pytest.raises(InputError, match="key 'nominal'"):
        errors_from_document({k: v for k, v in block.items() if k != "nominal"})
    with pytest.raises(ShapeError, match="coefficients"):
        PoseMap().real_poses(poses, np.zeros(3))
    with pytest.raises(InputError, match="order 3"):
        PoseMap(order=3)


def test_translation_scale_is_applied(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng)
    errors = errors_of(HEXAPOD, rng, poses)
    plain, scaled = correction(errors, poses), correction(replace(errors, translation_scale=1.01), poses)
    np.testing.assert_allclose(scaled.poses.T_MH.t, 1.01 * plain.poses.T_MH.t)
    np.testing.assert_allclose(scaled.J[:, 3:], 1.01 * plain.J[:, 3:])


# -- virtual machines -------------------------------------------------------------------------------------------------


def test_backlash_by_hand() -> None:
    x = np.array([[0.0], [1.0], [1.0], [0.5], [0.5], [2.0]])
    np.testing.assert_allclose(lag_of_backlash(x, 0.004)[:, 0], [-0.002, -0.002, -0.002, 0.002, 0.002, -0.002])


def test_disturbed_motion_is_what_it_says(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng, 400)
    p = np.zeros(len(HEXAPOD.names))
    still = Disturbance(scatter=Repeatability(t_mm=0.0, w_rad=0.0))
    np.testing.assert_allclose(real_motion(HEXAPOD, poses, p, disturbance=still).T_MH.t, poses.T_MH.t, atol=1e-9)
    warm = replace(still, growth_mm=(0.0, 0.0, 0.01), time_constant=50.0)
    grown = real_motion(HEXAPOD, poses, p, disturbance=warm).T_MH.t - poses.T_MH.t
    assert grown[0, 2] == pytest.approx(0.0, abs=1e-9)
    assert grown[50, 2] == pytest.approx(0.01 * (1 - np.exp(-1)), abs=1e-6)
    scattered = real_motion(HEXAPOD, poses, p, disturbance=Disturbance(), rng=rng).T_MH
    assert np.std(scattered.t - poses.T_MH.t) == pytest.approx(0.0005, rel=0.1)
    w = log_rotation(scattered.R @ np.swapaxes(poses.T_MH.R, 1, 2))
    assert np.std(w) == pytest.approx(12e-6, rel=0.1)
    with pytest.raises(InputError, match="rng"):
        real_motion(HEXAPOD, poses, p, disturbance=Disturbance())


def test_leg_backlash_moves_legs(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng, 20)
    worn = Disturbance(leg_backlash_mm=0.01, scatter=Repeatability(t_mm=0.0, w_rad=0.0))
    real = real_motion(HEXAPOD, poses, np.zeros(len(HEXAPOD.names)), disturbance=worn).T_MH
    change = HEXAPOD.leg_lengths(real.R, real.t) - HEXAPOD.leg_lengths(poses.T_MH.R, poses.T_MH.t)
    np.testing.assert_allclose(np.abs(change), 0.005, atol=1e-6)


def test_encoders_are_kept_beside_set_poses(rng: np.random.Generator) -> None:
    poses = hexapod_poses(rng, 200)
    log = encoder_readout(poses, settling=Repeatability(t_mm=0.002, w_rad=2e-5), rng=rng)
    assert log.T_MH_set is not None
    np.testing.assert_array_equal(log.set_poses().T_MH.matrix, poses.T_MH.matrix)
    assert np.std(log.T_MH.t - poses.T_MH.t) == pytest.approx(0.002, rel=0.15)


def test_repeatability_must_be_a_size() -> None:
    with pytest.raises(InputError, match="two numbers >= 0"):
        Repeatability(t_mm=-1.0)


def test_frames_of_real_poses(rng: np.random.Generator) -> None:
    real = HEXAPOD.real_poses(hexapod_poses(rng), np.zeros(len(HEXAPOD.names)))
    assert isinstance(real.T_MH, RigidTransform)
    assert (real.T_MH.source, real.T_MH.target) == (Frame.M, Frame.H)
