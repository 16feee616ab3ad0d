"""Optimal calibration poses: what the paper's plan reaches with 189 images, fewer reach, inside every limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tomopose import Scanner
from tomopose.calibration.rigid.pose_noise import expected_scatter
from tomopose.calibration.solve import calibrate
from tomopose.errors import InputError, NotObservableError, OutOfReachError
from tomopose.geometry.projection import project_ball
from tomopose.manipulator.real_poses import Repeatability
from tomopose.observations import BallObservations
from tomopose.planning.design import SIGMA_PX, DesignSettings, nominal_mount, plan_poses, predicted_covariance
from tomopose.planning.limits import PlanLimits, allowed, candidates
from tomopose.planning.resolve import resolvability
from tomopose.planning.target import scan_target
from tomopose.trajectory.feasibility import TravelLimits, travel
from tomopose.trajectory.pose_grid import pose_grid

BALL = np.array([8.0, -6.0, 17.0])
STILL = Repeatability(t_mm=0.0, w_rad=0.0)
"""Poses that are reached exactly, as the paper takes them."""
ALONE = DesignSettings(resolve=False, maker=STILL)
TURNED = PlanLimits(table_angles=(0.0, np.pi / 2))


@pytest.fixture(scope="module")
def paper_scanner():
    """Its values are exact, as in the paper."""
    return Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=1021.37, v_0=1026.81, n_u=2048, n_v=2048).exact()


@pytest.fixture(scope="module")
def silent_scanner(paper_scanner):
    """The same values, of which nobody says how well they are known."""
    return replace(paper_scanner, sigma={})


@pytest.fixture(scope="module")
def turned_plan(paper_scanner):
    return plan_poses(paper_scanner, t=BALL, limits=TURNED, settings=DesignSettings(maker=STILL))


@pytest.mark.slow
def test_thirty_images_with_two_table_angles_match_the_paper_grid(turned_plan):
    assert turned_plan.reference == pytest.approx(0.0023, abs=1e-4)
    assert turned_plan.predicted <= turned_plan.reference
    assert len(turned_plan) <= 30


@pytest.mark.slow
def test_all_but_the_true_symmetries_are_resolved(turned_plan):
    assert turned_plan.resolved.unresolved == ()
    assert {h.name for h in turned_plan.resolved.symmetric} == {
        "table zero",
        "image turned by 180 degrees and table sign",
    }


def test_the_still_table_needs_at_most_72_and_says_what_stays_hidden(paper_scanner):
    plan = plan_poses(paper_scanner, t=BALL, n=72, settings=DesignSettings(maker=STILL))
    assert plan.predicted <= plan.reference
    assert {h.name for h in plan.resolved.unresolved} == {
        "half a pixel low",
        "half a pixel high",
        "pixels counted from 1",
    }
    assert "another table angle" in plan.resolved.words[0]
    assert "half a pixel" in plan.resolved.words[0]


def test_few_images_are_chosen_so_that_alternatives_show(paper_scanner):
    """Eight images chosen for the scan alone would let half a pixel pass; the plan takes poses that show it."""
    plan = plan_poses(paper_scanner, t=BALL, n=8, limits=TURNED, settings=DesignSettings(maker=STILL))
    alone = plan_poses(paper_scanner, t=BALL, n=8, limits=TURNED, settings=ALONE)
    hidden = resolvability(paper_scanner, alone.poses, T_HT=nominal_mount(), t=BALL, sigma=SIGMA_PX)
    assert {h.name for h in hidden.unresolved} == {"half a pixel low", "half a pixel high"}
    assert plan.resolved.unresolved == ()
    assert plan.predicted < 1.25 * alone.predicted
    assert "5 sigma" in plan.resolved.words[0]


@pytest.mark.slow
def test_the_first_pose_is_repeated_and_limits_hold(turned_plan, paper_scanner):
    poses = turned_plan.poses
    np.testing.assert_array_equal(poses.T_MH.t[0], poses.T_MH.t[-1])
    np.testing.assert_array_equal(poses.T_MH.R[0], poses.T_MH.R[-1])
    assert len(set(poses.pose_id)) == len(poses)
    values = travel(poses)
    assert (values[:, :6] <= TURNED.travel.high[:6] + 1e-9).all()
    assert (values[:, :6] >= TURNED.travel.low[:6] - 1e-9).all()
    assert set(np.round(poses.alpha, 9)) <= set(np.round(TURNED.table_angles, 9))
    assert allowed(paper_scanner, poses, T_HT=nominal_mount(), t=BALL, limits=TURNED).all()


def stated(scanner, plan, maker):
    """Covariance that a calibration of the plan's poses states, which assumes the scatter that the plan assumes."""
    poses, scatter = plan.poses, expected_scatter(maker)
    x = project_ball(scanner, T_HT=nominal_mount(), T_MH=poses.T_MH, t=BALL, alpha=poses.alpha)
    return calibrate(
        scanner,
        poses,
        BallObservations.from_sigma(x, 0.0207 / np.sqrt(2), pose_id=poses.pose_id),
        pose_noise=(scatter.translation, scatter.rotation),
        hypotheses=False,
    ).covariance


def test_the_prediction_is_what_a_calibration_states(turned_plan, paper_scanner):
    np.testing.assert_allclose(stated(paper_scanner, turned_plan, STILL), turned_plan.covariance, rtol=1e-6, atol=1e-16)


def test_the_prediction_holds_what_a_calibration_assumes(turned_plan, silent_scanner):
    plan = plan_poses(silent_scanner, t=BALL, n=30, limits=TURNED, settings=DesignSettings(resolve=False))
    C = stated(silent_scanner, plan, Repeatability())
    assert C.shape == (21, 21)
    np.testing.assert_allclose(C, plan.covariance, rtol=1e-5, atol=1e-16)
    assert {"d_SR", "u_0", "eta"} <= plan.u.keys()
    assert plan.predicted > 5 * plan.exact
    assert plan.exact > turned_plan.predicted


@pytest.mark.slow
def test_a_goal_counts_what_nobody_stated(silent_scanner):
    with pytest.raises(NotObservableError, match="state the sigmas of the scanner's values"):
        plan_poses(silent_scanner, t=BALL, goal=0.005, limits=PlanLimits(total_time=400.0), settings=ALONE)


@pytest.mark.slow
def test_the_paper_plan_of_an_unstated_scanner_is_worse_than_two_angles(silent_scanner):
    plan = plan_poses(silent_scanner, t=BALL, limits=TURNED, settings=ALONE)
    assert len(plan) <= 60
    assert plan.predicted < 0.1 * plan.reference


def test_the_target_is_the_spread_of_simulated_scans(paper_scanner, rng):
    """tr(M C) against matrices made with drawn errors, the object's pose removed."""
    from tomopose.geometry.projection import eq5_matrices, project
    from tomopose.geometry.rotations import exp_rotation, skew
    from tomopose.geometry.transforms import RigidTransform
    from tomopose.planning.target import box_points, default_scan

    T_HT = nominal_mount()
    C = predicted_covariance(paper_scanner, pose_grid(3), T_HT=T_HT, t=BALL)
    target = scan_target(paper_scanner, T_HT=T_HT)
    scan, x = default_scan(T_HT, 90), box_points()
    P_0 = eq5_matrices(paper_scanner, T_HT=T_HT, T_MH=scan.T_MH, alpha=scan.alpha)
    h = np.einsum("nij,mj->nmi", P_0[:, :, :3], x) + P_0[:, None, :, 3]
    G = (P_0[:, None, :2, :3] - (h[..., :2] / h[..., 2:])[..., None] * P_0[:, None, 2:, :3]) / h[..., 2:, None]
    Q, _ = np.linalg.qr(np.concatenate([G, -G @ skew(x)], axis=3).reshape(-1, 6))
    squares = []
    for e in rng.multivariate_normal(np.zeros(9), C, size=200):
        moved = RigidTransform(
            R=exp_rotation(e[:3]) @ T_HT.R, t=T_HT.t + e[3:6], source=T_HT.source, target=T_HT.target
        )
        P = eq5_matrices(paper_scanner, T_HT=moved, T_MH=scan.T_MH, alpha=scan.alpha)
        d = (project(P, x) - project(P_0, x)).ravel()
        d = d - Q @ (Q.T @ d)
        squares.append((d @ d) / (d.size / 2))
    assert np.sqrt(np.mean(squares)) == pytest.approx(target.rms(C), rel=0.1)


def test_freed_parameters_need_table_angles(paper_scanner):
    with pytest.raises(NotObservableError, match="d_SR"):
        plan_poses(paper_scanner, t=BALL, n=40, free=("d_SR",), settings=ALONE)
    plan = plan_poses(paper_scanner, t=BALL, n=40, free=("d_SR", "u_0", "eta"), limits=TURNED, settings=ALONE)
    assert plan.u["d_SR"] < 0.01
    assert plan.u["u_0"] < 0.05


def test_narrow_fields_boxes_and_magnification(paper_scanner):
    narrow = Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=300, v_0=310, n_u=601, n_v=621)
    pool = candidates(narrow, T_HT=nominal_mount(), t=np.zeros(3), limits=PlanLimits())
    x = project_ball(narrow, T_HT=nominal_mount(), T_MH=pool.T_MH, t=np.zeros(3))
    assert (x > 30).all()
    assert (x < 591).all()
    walled = PlanLimits(boxes=((np.array([-60.0, -60, 21]), np.array([60.0, 60, 90])),))
    pool = candidates(paper_scanner, T_HT=nominal_mount(), t=BALL, limits=walled)
    assert (pool.T_MH.apply(BALL[None])[:, 0, 2] < 21).all()
    with pytest.raises(OutOfReachError):
        candidates(paper_scanner, T_HT=nominal_mount(), t=BALL, limits=PlanLimits(magnification=(8.0, 9.0)))


def test_time_bounds_the_number_of_images(paper_scanner):
    plan = plan_poses(paper_scanner, t=BALL, n=20, limits=PlanLimits(total_time=150.0), settings=ALONE)
    assert plan.duration <= 150.0
    with pytest.raises(InputError, match="time"):
        plan_poses(paper_scanner, t=BALL, n=100, limits=PlanLimits(total_time=150.0), settings=ALONE)


@pytest.mark.slow
def test_a_goal_out_of_reach_is_refused(paper_scanner):
    with pytest.raises(NotObservableError, match="images reach"):
        plan_poses(paper_scanner, t=BALL, goal=1e-5, settings=ALONE)


def test_plans_are_deterministic(paper_scanner):
    a, b = (plan_poses(paper_scanner, t=BALL, n=20, limits=TURNED, settings=ALONE) for _ in range(2))
    np.testing.assert_array_equal(a.poses.T_MH.t, b.poses.T_MH.t)


def test_d_optimal_plans_shrink_the_volume(paper_scanner):
    a = plan_poses(paper_scanner, t=BALL, n=24, limits=TURNED, settings=ALONE)
    d = plan_poses(
        paper_scanner, t=BALL, n=24, limits=TURNED, settings=DesignSettings(criterion="D", resolve=False, maker=STILL)
    )
    assert np.linalg.slogdet(d.covariance)[1] < np.linalg.slogdet(a.covariance)[1]
    assert d.predicted > a.predicted


def test_travel_must_be_finite():
    with pytest.raises(InputError, match="finite travel"):
        PlanLimits(travel=TravelLimits.symmetric(x=1.0))
