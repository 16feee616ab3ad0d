"""Eq. (7): truth in, truth out; what cannot be solved is refused in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tomopose import RigidTransform
from tomopose.calibration.model.ball_projection import _project_all, project_pose, projection_blocks
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import pair
from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.rigid.estimate import best_fit
from tomopose.calibration.solve import calibrate
from tomopose.errors import InputError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, project, project_ball
from tomopose.geometry.rotations import log_rotation
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

SINGLE_AXIS = np.array([[0, 0, 0], [5, 0, 0], [-5, 0, 0], [0, 5, 0], [0, -5, 0], [0, 0, 5], [0, 0, -5.0]])


def grid_poses(n=3, orientations=SINGLE_AXIS, **columns):
    g = np.linspace(-10, 10, n)
    positions = np.stack(np.meshgrid(g, g, g, indexing="ij"), axis=-1).reshape(-1, 3)
    return PoseSequence.from_table(
        np.repeat(positions, len(orientations), axis=0), np.tile(orientations, (len(positions), 1)), **columns
    )


def mixed_poses(rng, n=40, alphas=(0.0, 90.0, 180.0), **columns):
    return PoseSequence.from_table(
        rng.uniform(-9, 9, (n, 3)), rng.uniform(-6, 6, (n, 3)), alpha=np.radians(rng.choice(alphas, n)), **columns
    )


def any_mount(rng):
    R = Rotation.random(random_state=rng).as_matrix()
    return RigidTransform(R=R, t=rng.uniform(-5, 5, 3), source=Frame.H, target=Frame.T)


def observe(scanner, poses, T_HT, t, sigma=0.0, rng=None, said=0.02):
    x = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t, alpha=poses.alpha)
    if sigma:
        x = x + rng.normal(0, sigma, x.shape)
    return BallObservations.from_sigma(x, said, pose_id=poses.pose_id)


@pytest.mark.slow
@pytest.mark.parametrize("plan", ["grid", "mixed"])
def test_exact_centres_give_the_exact_mount(scanner, rng, plan):
    poses = grid_poses() if plan == "grid" else mixed_poses(rng)
    scan = mixed_poses(rng, 10)
    for _ in range(25):
        T_HT, t = any_mount(rng), rng.uniform(-10, 10, 3)
        observed = observe(scanner, poses, T_HT, t)
        cal = calibrate(scanner, poses, observed.select(rng.permutation(len(poses))), hypotheses=False)
        np.testing.assert_allclose(cal.T_HT.t, T_HT.t, rtol=0, atol=1e-9)
        np.testing.assert_allclose(cal.t, t, rtol=0, atol=1e-9)
        assert np.linalg.norm(log_rotation(cal.T_HT.R @ T_HT.R.T)) < 1e-9
        x_W = rng.uniform(-20, 20, (6, 3))
        expected = project(eq5_matrices(scanner, T_HT=T_HT, T_MH=scan.T_MH, alpha=scan.alpha), x_W)
        np.testing.assert_allclose(projection_matrices(cal, scan).project(x_W), expected, rtol=0, atol=1e-6)
        assert cal.d_rms < 1e-9
        assert cal.pose_id == poses.pose_id


@pytest.mark.slow
@pytest.mark.parametrize("plan", ["grid", "mixed", "turned"])
def test_a_thousand_mounts_are_found_from_no_start(scanner, rng, plan):
    """Exact centres, 1e-9 mm and rad, whatever the mount; in "turned" the poses rotate by up to 180 degrees."""
    poses = {
        "grid": grid_poses(2),
        "mixed": mixed_poses(rng, 30),
        "turned": PoseSequence.from_table(rng.uniform(-9, 9, (30, 3)), rng.uniform(-180, 180, (30, 3))),
    }[plan]
    free = free_parameters((scanner,))
    for _ in range(1000 if plan == "grid" else 150):
        T_HT, t = any_mount(rng), rng.uniform(-10, 10, 3)
        fit = best_fit(pair(scanner, poses, observe(scanner, poses, T_HT, t)), free)
        assert fit.converged
        assert np.linalg.norm(log_rotation(fit.R_HT @ T_HT.R.T)) < 1e-9
        assert np.abs(np.concatenate([fit.t_HT - T_HT.t, fit.t[0] - t])).max() < 1e-9


def test_several_balls_have_one_centre_each(scanner, T_HT, rng):
    poses = mixed_poses(rng, 60, ball_id=np.repeat([3, 7], 30))
    t = {3: np.array([4.0, -2.0, 9.0]), 7: np.array([-15.0, 6.0, 1.0])}
    observed = observe(scanner, poses, T_HT, np.array([t[b] for b in poses.ball_id]))
    cal = calibrate(scanner, poses, observed, hypotheses=False)
    for ball, centre in t.items():
        np.testing.assert_allclose(cal.balls[ball], centre, rtol=0, atol=1e-9)
    assert cal.tangent[6:9] == ("t[3]_x", "t[3]_y", "t[3]_z")


def test_the_observations_name_the_balls_where_the_pose_table_does_not(scanner, T_HT, rng):
    poses = mixed_poses(rng, 60, ball_id=np.repeat([3, 7], 30))
    t = {3: np.array([4.0, -2.0, 9.0]), 7: np.array([-15.0, 6.0, 1.0])}
    observed = observe(scanner, poses, T_HT, np.array([t[b] for b in poses.ball_id]))
    named = replace(observed, ball_id=poses.ball_id)
    cal = calibrate(scanner, replace(poses, ball_id=None), named[::-1], hypotheses=False)
    for ball, centre in t.items():
        np.testing.assert_allclose(cal.balls[ball], centre, rtol=0, atol=1e-9)
    wrong = np.array(poses.ball_id)
    wrong[[4, 40]] = [7, 3]
    with pytest.raises(InputError, match=r"pose '4': the pose table says ball 3, the observations ball 7 \(2 of"):
        calibrate(scanner, poses, replace(observed, ball_id=wrong), hypotheses=False)


def test_errors_stay_inside_three_predicted_sigmas(scanner, T_HT, rng):
    poses, t = grid_poses(), np.array([1.0, -2.0, 3.0])
    for _ in range(5):
        cal = calibrate(scanner, poses, observe(scanner, poses, T_HT, t, 0.0207, rng, said=0.0207), hypotheses=False)
        error = np.concatenate([log_rotation(T_HT.R @ cal.T_HT.R.T), T_HT.t - cal.T_HT.t, t - cal.t])
        u = np.sqrt(np.diag(cal.covariance))
        assert (np.abs(error) < 3.7 * u).all()
        assert error @ np.linalg.solve(cal.covariance, error) < 33.7  # chi2 of 9 at 1e-4
        assert 0.8 < cal.chi2_dof < 1.2


def test_unknown_ids_are_refused(scanner, T_HT, rng):
    poses = mixed_poses(rng)
    observed = observe(scanner, poses, T_HT, np.ones(3))
    odd = replace(observed, pose_id=(*observed.pose_id[:-1], "p999"))
    with pytest.raises(InputError, match="p999"):
        calibrate(scanner, poses, odd)


def test_too_few_poses_are_refused(scanner, T_HT, rng):
    poses = mixed_poses(rng)
    observed = observe(scanner, poses, T_HT, np.ones(3))
    with pytest.raises(InputError, match="only 3 poses"):
        calibrate(scanner, poses, observed.select([0, 1, 2]))


def test_poses_without_rotation_are_refused(scanner, T_HT):
    poses = grid_poses(orientations=np.zeros((1, 3)))
    with pytest.raises(NotObservableError, match="no pose rotates"):
        calibrate(scanner, poses, observe(scanner, poses, T_HT, np.ones(3)))


def test_rotations_about_one_axis_are_refused_and_the_axis_named(scanner, T_HT):
    poses = grid_poses(orientations=np.array([[0, 0, 0], [0, 5.0, 0], [0, -5, 0]]))
    with pytest.raises(NotObservableError, match=r"\(0\.00, 1\.00, 0\.00\)") as caught:
        calibrate(scanner, poses, observe(scanner, poses, T_HT, np.ones(3)))
    assert len(caught.value.singular_values) == 9


@pytest.mark.parametrize("noisy", [False, True])
def test_poses_that_only_turn_about_one_point_hold_no_length(scanner, T_HT, rng, noisy):
    poses = PoseSequence.from_table(np.zeros((60, 3)), rng.uniform(-40, 40, (60, 3)), alpha=np.zeros(60))
    real = replace(poses, T_MH=replace(poses.T_MH, t=0.05 * noisy * rng.standard_normal((60, 3))))
    observed = observe(scanner, real, T_HT, np.array([8.0, -6.0, 5.0]))
    with pytest.raises(NotObservableError, match="do not determine"):
        calibrate(scanner, poses, observed)


def test_freeing_what_the_poses_cannot_determine_is_refused(scanner, T_HT):
    poses = grid_poses()
    observed = observe(scanner, poses, T_HT, np.ones(3))
    for name in ("d_SR", "eta", "translation_scale"):
        with pytest.raises(NotObservableError, match=name):
            calibrate(scanner, poses, observed, free=(name,))
    with pytest.raises(InputError, match="known are"):
        calibrate(scanner, poses, observed, free=("u0",))


def test_another_pivot_or_scanner_is_refused(scanner, T_HT, rng):
    poses = mixed_poses(rng, pivot=[0.0, 0.0, 30.0])
    cal = calibrate(scanner, poses, observe(scanner, poses, T_HT, np.ones(3)), hypotheses=False)
    with pytest.raises(InputError, match="pivot"):
        projection_matrices(cal, replace(poses, pivot=[0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="d_SR"):
        projection_matrices(cal, poses, scanner=replace(scanner, d_SR=scanner.d_SR + 0.1))


def test_kernels_are_compiled_once_whatever_arrays_are_given(scanner, T_HT, rng):
    poses = mixed_poses(rng)
    t = np.array([6.0, -4.0, 11.0])
    blocks = projection_blocks(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t, alpha=poses.alpha)
    each = np.asfortranarray(np.tile(t, (len(poses), 1)))
    each.setflags(write=False)
    again = projection_blocks(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=each, alpha=poses.alpha, run=[0] * len(poses))
    assert np.array_equal(blocks.J_scanner, again.J_scanner)
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t, alpha=poses.alpha)
    assert np.allclose(blocks.x_D, x_D, rtol=0, atol=1e-9)
    calibrate(scanner, poses, BallObservations.from_sigma(x_D, 0.01, pose_id=poses.pose_id))
    assert len(_project_all.signatures) == 1
    assert len(project_pose.signatures) <= 1  # none where all that calls it came from the cache
