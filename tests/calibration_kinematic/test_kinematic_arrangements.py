"""The other arrangement, unknown kinematics, changes during a run, several balls in a view, planned poses."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from manipulator_cases import SCANNER, Experiment, experiment, hexapod_experiment, mixed_poses, tilted_scan

from tomopose import BallObservations, Frame, PoseSequence, RigidTransform, Scanner
from tomopose.calibration.arrangements.moving_scanner import calibrate_inverse, view_distances
from tomopose.calibration.arrangements.multi_sphere.path import self_calibrated_balls
from tomopose.calibration.arrangements.multi_sphere.view_pose import pose_from_balls, poses_of_views
from tomopose.calibration.checks.cross_validation import blocks_of
from tomopose.calibration.checks.stability import SIGNIFICANT, movements_of
from tomopose.calibration.identified.calibrate import calibrate_kinematic
from tomopose.calibration.identified.fit import fit_model
from tomopose.calibration.identified.map_estimate import KinematicProblem, State, linear_fit, linearise, solve_map
from tomopose.calibration.identified.model_selection import judged
from tomopose.calibration.identified.pose_map import slacks
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import pair
from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.solve import calibrate
from tomopose.calibration.uncertainty.trajectory import object_points, rms_px
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import project, project_ball
from tomopose.geometry.rotations import R_y, R_z, rotation_angle_between
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.real_poses import Repeatability
from tomopose.manipulator.virtual import Disturbance, real_motion, typical_hexapod
from tomopose.planning.identified_design import plan_kinematic

HEXAPOD = typical_hexapod()
SIGMA = 0.015


def problem_of(e: Experiment, machine: Any) -> tuple[KinematicProblem, State]:
    data = pair(e.scanner, e.poses, e.observations)
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
    problem = KinematicProblem(data=data, poses=e.poses, free=free_parameters(data.scanners), model=machine)
    p = np.zeros(0 if machine is None else len(machine.names))
    balls = np.array([rigid.balls[i] for i in data.ball_ids])
    return problem, State(T_HT=rigid.T_HT, balls=balls, delta=np.zeros(0), p=p)


# -- estimator --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rows_answer_to_every_unknown_as_stated() -> None:
    """The estimator's Jacobian against differences, with two balls, freed scanner parameters and errors."""
    e = hexapod_experiment(HEXAPOD, "mixed", 0, balls=2)
    problem, state = problem_of(e, HEXAPOD)
    free = free_parameters(problem.data.scanners, free=("d_SR", "u_0", "eta", "translation_scale"))
    problem = replace(problem, free=free)
    rng = np.random.default_rng(1)
    p = rng.standard_normal(len(HEXAPOD.names)) * HEXAPOD.sigma
    state = replace(state, delta=np.array([0.1, 0.5, 1e-3, 1e-3]), p=p)
    at = linearise(problem, state)
    m = at.J.shape[2]
    assert m == len(problem.tangent) == len(problem.prior_sigma)
    for i in range(m):
        h = 1e-5 if i < 3 or problem.tangent[i] == "eta" else 1e-3
        step = h * np.eye(m)[i]
        numeric = (linearise(problem, state.moved(-step)).r - linearise(problem, state.moved(step)).r) / (2 * h)
        scale = np.abs(numeric).max() + 1e-9
        np.testing.assert_allclose(at.J[:, :, i] / scale, numeric / scale, atol=2e-4, err_msg=problem.tangent[i])


@pytest.mark.slow
def test_held_out_poses_as_if_refitted() -> None:
    """The closed form of cross-validation against honest refits."""
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    problem, start = problem_of(e, HEXAPOD)
    fit = fit_model(problem, start)
    said = judged("kinematic", fit)
    n = len(e.poses)
    squares, log_predictive = 0.0, 0.0
    for block in blocks_of(n, problem.data.ball):
        trained = solve_map(problem.rows(np.setdiff1d(np.arange(n), block)), fit.estimate.state)
        at = linearise(problem, trained.state)
        W = whiteners(fit.estimate.at.C[block])
        A = (W @ at.J[block]).reshape(2 * len(block), -1)
        r = (W @ at.r[block][:, :, None]).ravel()
        V = np.eye(len(r)) + A @ trained.covariance @ A.T
        log_predictive -= 0.5 * (r @ np.linalg.solve(V, r) + np.linalg.slogdet(V)[1])
        log_predictive += np.sum(np.log(np.linalg.det(W)))
        squares += float(np.sum(at.r[block] ** 2))
    assert said.cv_rms == pytest.approx(np.sqrt(squares / n), rel=0.02)
    assert said.log_predictive == pytest.approx(log_predictive, abs=3.0)


def test_exact_data_give_the_exact_trajectory() -> None:
    """Without noise the errors that matter are found although 42 numbers cannot be distinguished."""
    e = hexapod_experiment(HEXAPOD, "mixed", 5, disturbance=Disturbance(scatter=Repeatability(t_mm=0.0, w_rad=0.0)))
    rng = np.random.default_rng(np.random.SeedSequence([9, 9]))
    machine = replace(HEXAPOD, scale_sigma=0.0, geometry_sigma=0.0, repeatability=Repeatability(t_mm=0.0, w_rad=0.0))
    p = rng.standard_normal(42) * machine.sigma
    T_HT = RigidTransform.from_angles([0.01, -0.02, 3.1], [1.0, -2.0, 0.5], source=Frame.H, target=Frame.T)
    poses = mixed_poses(rng)
    x = project_ball(
        SCANNER, T_HT=T_HT, T_MH=real_motion(machine, poses, p).T_MH, t=[12.0, -14.0, 10.0], alpha=poses.alpha
    )
    tight = BallObservations.from_sigma(x, 1e-5, pose_id=poses.pose_id)
    rigid = calibrate(SCANNER, poses, tight, model="rigid", hypotheses=False)
    cal = calibrate_kinematic(SCANNER, poses, tight, rigid=rigid, manipulator=machine, model="kinematic")
    scan = tilted_scan(T_HT)
    exact = experiment(
        machine,
        p,
        poses,
        scan,
        T_HT=T_HT,
        balls=[[12.0, -14.0, 10.0]],
        rng=rng,
        disturbance=Disturbance(scatter=Repeatability(t_mm=0.0, w_rad=0.0)),
    )
    d = without_object_pose(projection_matrices(cal, scan).P, exact.P_true, object_points())
    assert rms_px(d) < 2e-4
    assert len(e.poses) == len(poses)


# -- unknown kinematics -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_ball_cannot_determine_rotations_without_kinematics() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
    cal = calibrate_kinematic(e.scanner, e.poses, e.observations, rigid=rigid, model="slack")
    assert cal.model == "slack"
    assert cal.verdict == "doubtful"
    assert any("one ball cannot determine the errors of the plate's turns" in r for r in cal.reasons)
    assert cal.d_rms < 0.1 * rigid.d_rms, "what the ball itself sees is mapped"
    assert projection_matrices(cal, e.scan).P.shape == (180, 3, 4)


def test_slacks_follow_the_residuals() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    problem, start = problem_of(e, None)
    estimate = fit_model(problem, start).estimate
    s = slacks(estimate)
    left = estimate.at.r - np.einsum("nia,na->ni", estimate.at.J_pose, s)
    assert np.sqrt(np.mean(left**2)) < 0.05 * np.sqrt(np.mean(estimate.at.r**2))


# -- something changed ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 1.0])
def test_changed_pivot_is_named(size: float) -> None:
    """From pose 100 on the controller turns about another pivot; the table's numbers do not show it."""
    rng = np.random.default_rng(4)
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    change = np.array([0.3, -0.2, 0.4])
    R, t = e.poses.T_MH.R, e.poses.T_MH.t.copy()
    t[100:] += change - R[100:] @ change
    executed = replace(e.poses, T_MH=RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H))
    exact = replace(HEXAPOD, scale_sigma=0.0, geometry_sigma=0.0)
    p = size * rng.standard_normal(42) * exact.sigma
    T_HT = RigidTransform.from_angles([0.0, 0.0, np.pi], [1.0, 2.0, 1.0], source=Frame.H, target=Frame.T)
    run = experiment(exact, p, executed, e.scan, T_HT=T_HT, balls=[[12.0, -14.0, 10.0]], rng=rng)
    rigid = calibrate(SCANNER.exact(), e.poses, run.observations, model="rigid", hypotheses=False)
    cal = calibrate_kinematic(SCANNER.exact(), e.poses, run.observations, rigid=rigid, manipulator=HEXAPOD)
    assert cal.verdict == "doubtful"
    # trusted poses are the better model of an exact machine, and the change is named beside either
    assert cal.model == ("rigid" if size == 0.0 else "kinematic")
    (changed,) = (f for f in cal.checks if f.rule == "changed during the run")
    assert changed.verdict == "doubtful"
    assert re.match(r"the pivot of the controller changed at pose 100, by 5\.[34]e\+02 um", changed.words)


@pytest.mark.slow
def test_quiet_runs_raise_no_alarm() -> None:
    for seed in range(3):
        e = hexapod_experiment(HEXAPOD, "mixed", seed)
        problem, start = problem_of(e, HEXAPOD)
        estimate = fit_model(problem, start).estimate
        assert all(e.p > SIGNIFICANT for e in movements_of(linear_fit(estimate), estimate.state.T_HT.R))


def test_slipped_ball_is_named() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0, size=0.0)
    T_HT = RigidTransform.from_angles([0.0, 0.0, np.pi], [1.0, 2.0, 1.0], source=Frame.H, target=Frame.T)
    t = np.tile([12.0, -14.0, 10.0], (189, 1))
    t[60:] += [0.01, 0.0, -0.02]
    x = project_ball(SCANNER, T_HT=T_HT, T_MH=e.poses.T_MH, t=t, alpha=e.poses.alpha)
    x += SIGMA * np.random.default_rng(0).standard_normal(x.shape)
    observations = BallObservations.from_sigma(x, SIGMA, pose_id=e.poses.pose_id)
    problem, start = problem_of(replace(e, observations=observations), None)
    estimate = fit_model(problem, start).estimate
    moved = movements_of(linear_fit(estimate), estimate.state.T_HT.R)
    change = min((e for e in moved if e.at), key=lambda e: e.p)
    assert (change.name, change.at) == ("ball", "60")
    assert change.p < 1e-6
    found = [float(x) for x in re.findall(r"\((.*)\) mm", change.words)[0].split(", ")]
    np.testing.assert_allclose(found, [0.01, 0.0, -0.02], atol=0.004)


# -- the other arrangement --------------------------------------------------------------------------------------------


def carm(rng: np.random.Generator, *, n: int = 150) -> tuple[Scanner, PoseSequence, RigidTransform, np.ndarray]:
    """A hexapod carries source and detector about a fixed ball; non-square pixels, off-centre piercing point."""
    scanner = Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203).exact()
    poses = PoseSequence.from_table(rng.uniform(-12, 12, (n, 3)), rng.uniform(-6, 6, (n, 3)))
    T_MT = RigidTransform.from_angles([0.02, -0.01, 0.03], [3.0, 1.0, -2.0], source=Frame.H, target=Frame.T)
    return scanner, poses, T_MT, np.array([4.0, -6.0, 5.0])


def test_chain_of_the_other_arrangement_by_hand(rng: np.random.Generator) -> None:
    """x_S = T_WS T_MT T_MH^-1 (ball in the base), typed from the definition."""
    scanner, poses, T_MT, ball = carm(rng, n=3)
    x = project_ball(scanner, T_HT=T_MT, T_MH=inverse_poses(poses).T_MH, t=ball)
    for k in range(3):
        x_M = poses.T_MH.R[k].T @ (ball - poses.T_MH.t[k])
        x_W = T_MT.R @ x_M + T_MT.t
        h = scanner.P_S @ scanner.T_WS.matrix @ [*x_W, 1.0]
        np.testing.assert_allclose(x[k], h[:2] / h[2], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("machine_errors", [False, True])
def test_moving_scanner_is_calibrated(machine_errors: bool, rng: np.random.Generator) -> None:
    scanner, poses, T_MT, ball = carm(rng)
    machine = replace(HEXAPOD, scale_sigma=0.0, geometry_sigma=0.0)
    p = rng.standard_normal(42) * machine.sigma if machine_errors else np.zeros(42)
    real = real_motion(machine, poses, p, disturbance=Disturbance(), rng=rng)
    x = project_ball(scanner, T_HT=T_MT, T_MH=inverse_poses(real).T_MH, t=ball)
    x += SIGMA * rng.standard_normal(x.shape)
    observations = BallObservations.from_sigma(x, SIGMA, pose_id=poses.pose_id)
    cal = calibrate_inverse(scanner, poses, observations, manipulator=machine)
    assert cal.model == ("kinematic" if machine_errors else "rigid")
    tilts = np.column_stack([np.zeros(40), np.linspace(-5, 5, 40), np.zeros(40)])
    scan = PoseSequence.from_table(np.zeros((40, 3)), tilts)
    true = inverse_poses(real_motion(machine, scan, p))
    home = scanner.T_TW(0.0) @ T_MT
    P = projection_matrices(cal, inverse_poses(scan)).P
    P_true = np.array(
        [scanner.P_S @ scanner.T_WS.matrix @ home.matrix @ T @ np.linalg.inv(home.matrix) for T in true.T_MH.matrix]
    )
    rigid = calibrate_inverse(scanner, poses, observations)
    after = rms_px(without_object_pose(P, P_true, object_points()))
    before = rms_px(without_object_pose(projection_matrices(rigid, inverse_poses(scan)).P, P_true, object_points()))
    assert after < 0.06
    assert not machine_errors or after < before / 8


def test_one_more_number_a_view(rng: np.random.Generator) -> None:
    """d_SD that differs from view to view widens what it blurs and is found in each view."""
    scanner, poses, T_MT, ball = carm(rng)
    d_SD = scanner.d_SD + 0.5 * rng.standard_normal(len(poses))
    inverse = inverse_poses(poses)
    x = np.concatenate(
        [
            project_ball(replace(scanner, d_SD=d), T_HT=T_MT, T_MH=inverse.T_MH[k : k + 1], t=ball)
            for k, d in enumerate(d_SD)
        ]
    ) + SIGMA * rng.standard_normal((len(poses), 2))
    observations = BallObservations.from_sigma(x, SIGMA, pose_id=poses.pose_id)
    cal = calibrate_inverse(scanner, poses, observations, d_SD_sigma=0.5, model="rigid")
    assert cal.chi2_dof < 1.4
    assert rotation_angle_between(cal.T_HT.R, T_MT.R) < 2e-3
    found, u = view_distances(cal, poses, observations, d_SD_sigma=0.5)
    assert np.mean(np.abs(found - d_SD) < 3 * u + 0.05) > 0.95
    known = u < 0.25
    assert known.sum() > 50
    assert np.std((found - d_SD)[known]) < 0.3


def test_no_table_under_a_fixed_object(rng: np.random.Generator) -> None:
    scanner, poses, _, _ = carm(rng)
    observations = BallObservations.from_sigma(np.zeros((len(poses), 2)), SIGMA, pose_id=poses.pose_id)
    with pytest.raises(InputError, match="no rotary table"):
        calibrate_inverse(scanner, replace(poses, alpha=np.ones(len(poses))), observations)
    with pytest.raises(InputError, match="d_SD_sigma"):
        calibrate_inverse(scanner, poses, observations, d_SD_sigma=-1.0)


def test_a_failed_fit_of_a_moving_scanner_says_what_it_was(rng: np.random.Generator, monkeypatch: Any) -> None:
    """What was reached without an optimum keeps the arrangement, for its report and its matrices."""
    from tomopose.calibration.arrangements import moving_scanner

    scanner, poses, T_MT, ball = carm(rng)
    x = project_ball(scanner, T_HT=T_MT, T_MH=inverse_poses(poses).T_MH, t=ball)
    observations = BallObservations.from_sigma(x, SIGMA, pose_id=poses.pose_id)
    reached = calibrate_inverse(scanner, poses, observations)

    def fails(*_: Any, **__: Any) -> Any:
        as_reached = replace(reached, arrangement="moving-object", converged=False)
        raise NotConvergedError("no optimum", calibration=as_reached)

    monkeypatch.setattr(moving_scanner, "rigid_calibration", fails)
    with pytest.raises(NotConvergedError) as error:
        calibrate_inverse(scanner, poses, observations)
    assert error.value.calibration.arrangement == "moving-scanner"


# -- several balls in every view --------------------------------------------------------------------------------------

BALLS = np.array([[0, 0, -12], [10, 0, -4], [-6, 9, 2], [-7, -8, 8], [5, 7, 13], [9, -6, 10.0]])


def ball_views(scanner: Scanner, n: int, rng: np.random.Generator) -> tuple[list[np.ndarray], list[RigidTransform]]:
    views, true = [], []
    for k in range(n):
        R = R_z(2 * np.pi * k / n + 0.3) @ R_y(0.1 * np.sin(k))
        T = RigidTransform(R=R, t=rng.uniform(-2, 2, 3), source=Frame.M, target=Frame.W)
        P = (scanner.P_S @ scanner.T_WS.matrix @ T.matrix)[None]
        views.append(project(P, BALLS)[0])
        true.append(T)
    return views, true


@pytest.mark.slow
def test_exact_views_give_exact_poses(scanner: Scanner, rng: np.random.Generator) -> None:
    views, true = ball_views(scanner, 12, rng)
    for view, T in zip(views, true, strict=True):
        found = pose_from_balls(scanner, view, BALLS)
        assert rotation_angle_between(found.T_MW.R, T.R) < 1e-8
        np.testing.assert_allclose(found.T_MW.t, T.t, atol=1e-6)


def test_pose_uncertainty_is_honest(scanner: Scanner, rng: np.random.Generator) -> None:
    """Squared errors in stated standard deviations: 6 on average for six coordinates."""
    views, true = ball_views(scanner, 60, rng)
    C = np.tile(np.eye(2) * SIGMA**2, (len(BALLS), 1, 1))
    noisy = [v + SIGMA * rng.standard_normal(v.shape) for v in views]
    squares = []
    for found, T in zip(poses_of_views(scanner, noisy, BALLS, covariance=[C] * 60), true, strict=True):
        w = (T.R @ found.T_MW.R.T - np.eye(3))[[2, 0, 1], [1, 2, 0]]
        d = np.concatenate([w, T.t - found.T_MW.t])
        squares.append(d @ np.linalg.solve(found.covariance, d))
    assert 4.8 < np.mean(squares) < 7.4


@pytest.mark.slow
def test_ball_object_calibrates_itself(scanner: Scanner, rng: np.random.Generator) -> None:
    """Coarse coordinates (0.3 mm) become good to micrometres; one known distance gives the scale."""
    views, _ = ball_views(scanner, 40, rng)
    noisy = [v + SIGMA * rng.standard_normal(v.shape) for v in views]
    C = [np.tile(np.eye(2) * SIGMA**2, (len(BALLS), 1, 1))] * 40
    coarse = BALLS + 0.3 * rng.standard_normal(BALLS.shape)
    length = float(np.linalg.norm(BALLS[0] - BALLS[4]))
    found = self_calibrated_balls(
        scanner, noisy, coarse, covariance=C, distances={(0, 4): (length, 1e-4)}, ball_sigma=0.3
    )

    def distances(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x[:, None] - x, axis=2)

    assert np.abs(distances(coarse) - distances(BALLS)).max() > 0.1
    assert np.abs(distances(found.centres) - distances(BALLS)).max() < 0.004
    assert len(found.T_MW) == 40


def test_balls_without_information_are_refused(scanner: Scanner) -> None:
    with pytest.raises(InputError, match="at least 4"):
        pose_from_balls(scanner, np.zeros((3, 2)), BALLS[:3])
    with pytest.raises(InputError, match="must pair"):
        pose_from_balls(scanner, np.zeros((5, 2)), BALLS)
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(NotObservableError, match="in a line"):
        pose_from_balls(scanner, np.zeros((5, 2)), line)


def test_views_with_missing_balls(scanner: Scanner, rng: np.random.Generator) -> None:
    views, true = ball_views(scanner, 6, rng)
    views[2][[0, 5]] = np.nan
    found = poses_of_views(scanner, views, BALLS)
    assert rotation_angle_between(found[2].T_MW.R, true[2].R) < 1e-7


# -- planning ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_planned_poses_beat_random_ones_and_keep_their_promise() -> None:
    rng = np.random.default_rng(8)
    T_HT = RigidTransform.from_angles([0.0, 0.0, np.pi], [1.0, 2.0, 1.0], source=Frame.H, target=Frame.T)
    machine = replace(HEXAPOD, scale_sigma=0.0, geometry_sigma=0.0)
    candidates = mixed_poses(rng, n=400)
    scan = tilted_scan(T_HT, n=60)
    ball, n = [12.0, -14.0, 10.0], 60
    call: dict[str, Any] = {"T_HT": T_HT, "balls": ball, "scan": scan, "points": object_points(), "sigma_px": SIGMA}
    plan = plan_kinematic(SCANNER, machine, candidates=candidates, n=n, **call)
    assert len(plan.poses) == n
    assert len(np.unique(np.round(plan.poses.alpha, 6))) > 1, "table angles are used"
    assert np.all(np.diff(plan.history) <= 1e-9)
    some = plan_kinematic(SCANNER, machine, candidates=candidates.select(np.arange(0, 400, 7)[:n]), n=57, **call)
    assert plan.identified < 0.8 * some.identified
    assert plan.trusted > 5 * plan.identified
    errors = []
    for seed in range(8):
        p = np.random.default_rng(seed).standard_normal(42) * machine.sigma
        run = experiment(machine, p, plan.poses, scan, T_HT=T_HT, balls=[ball], rng=np.random.default_rng(100 + seed))
        rigid = calibrate(SCANNER, plan.poses, run.observations, model="rigid", hypotheses=False)
        cal = calibrate_kinematic(
            SCANNER, plan.poses, run.observations, rigid=rigid, manipulator=machine, model="kinematic"
        )
        errors.append(rms_px(without_object_pose(projection_matrices(cal, scan).P, run.P_true, object_points())))
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) / plan.identified < 1.8


def test_plans_that_leave_the_view_are_refused() -> None:
    T_HT = RigidTransform.from_angles([0.0, 0.0, np.pi], [0.0, 60.0, 0.0], source=Frame.H, target=Frame.T)
    with pytest.raises(InputError, match="keep the ball in view"):
        plan_kinematic(
            SCANNER,
            HEXAPOD,
            T_HT=T_HT,
            balls=[0.0, 0, 0],
            candidates=mixed_poses(np.random.default_rng(0), n=20),
            scan=tilted_scan(T_HT, n=8),
            points=object_points(),
            n=15,
        )
