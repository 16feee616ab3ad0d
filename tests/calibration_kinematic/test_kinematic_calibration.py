"""A manipulator's errors found from radiographs of one ball, and what is left of the trajectory error."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from manipulator_cases import (
    ROBOT_BALLS,
    SCANNER,
    Experiment,
    hexapod_experiment,
    robot_experiment,
    scan_error,
)

from tomopose import BallObservations, Calibration, Frame, RigidTransform
from tomopose.calibration.identified.calibrate import calibrate_kinematic, machine_of
from tomopose.calibration.identified.model_selection import SELECTION
from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.solve import calibrate
from tomopose.calibration.uncertainty.trajectory import object_points, rms_px
from tomopose.errors import InputError
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import project_ball
from tomopose.io.calibration.errors_block import errors_document
from tomopose.io.calibration_json import read_calibration, write_calibration
from tomopose.manipulator.error_models import commands_for, corrected_poses
from tomopose.manipulator.virtual import Disturbance, typical_hexapod, typical_robot
from tomopose.planning.identified_design import plan_kinematic
from tomopose.planning.robot_candidates import robot_work

HEXAPOD, ROBOT = typical_hexapod(), typical_robot()


def rigid_of(e: Experiment, **changes: Any) -> Calibration:
    return calibrate(
        e.scanner,
        changes.get("poses", e.poses),
        changes.get("observations", e.observations),
        model="rigid",
        hypotheses=False,
    )


def found(e: Experiment, model: str = "auto", **options: Any) -> Calibration:
    poses, observations = options.pop("poses", e.poses), options.pop("observations", e.observations)
    options.setdefault("manipulator", e.machine)
    rigid = rigid_of(e, poses=poses, observations=observations)
    return calibrate_kinematic(e.scanner, poses, observations, rigid=rigid, model=model, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options", "goal_px"),
    [("paper", {}, 0.08), ("mixed", {}, 0.02), ("mixed", {"geometry": 1.08}, 0.025), ("mixed", {"balls": 2}, 0.012)],
)
def test_platform_errors_are_found(kind: str, options: dict[str, Any], goal_px: float) -> None:
    """Joint errors of 0.1 mm: the scan's error falls from about 1 px to hundredths."""
    e = hexapod_experiment(HEXAPOD, kind, 3, **options)
    rigid, cal = rigid_of(e), found(e)
    before, error = scan_error(rigid, e).shared, scan_error(cal, e)
    after, stated = error.shared, error.u_shared
    assert cal.model == "kinematic"
    assert before > 0.25
    assert after < goal_px
    assert after < 3 * stated
    assert abs(cal.chi2_dof - 1) < 0.3
    assert cal.verdict == "trustworthy", cal.reasons


@pytest.mark.slow
def test_stated_uncertainty_covers() -> None:
    """Squared errors in stated standard deviations average to about 1 over seeded runs (a few directions dominate)."""
    share, ratio = [], []
    for seed in range(10):
        e = hexapod_experiment(HEXAPOD, "mixed", seed)
        error = scan_error(found(e, "kinematic"), e)
        share.append(error.inside)
        ratio.append((error.shared / error.u_shared) ** 2)
    assert 0.93 < np.mean(share) < 0.97, "of the single views, with the machine's scatter"
    assert 0.4 < np.mean(ratio) < 1.8


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["paper", "mixed"])
def test_a_perfect_machine_stays_rigid(kind: str) -> None:
    e = hexapod_experiment(HEXAPOD, kind, 1, size=0.0)
    rigid = rigid_of(e)
    cal = found(e)
    assert cal.model == "rigid"
    np.testing.assert_array_equal(cal.T_HT.matrix, rigid.T_HT.matrix)
    assert scan_error(cal, e).shared < 0.006
    models = {m.model: m for m in cal.comparison.models}
    assert models["kinematic"].log_evidence < models["rigid"].log_evidence + SELECTION.evidence_gain


@pytest.mark.slow
def test_small_errors_get_a_small_prior() -> None:
    """A machine fifty times better than its file says: the errors' size is taken from the data."""
    e = hexapod_experiment(HEXAPOD, "mixed", 0, size=0.02)
    rigid, cal = rigid_of(e), found(e)
    assert cal.model == "kinematic"
    assert scan_error(cal, e).shared < 0.5 * scan_error(rigid, e).shared
    assert {m.model: m.size for m in cal.comparison.models}["kinematic"] < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["paper", "mixed"])
@pytest.mark.parametrize("worn", [{"backlash_mm": 0.003}, {"leg_backlash_mm": 0.003}])
def test_backlash_and_drift_do_not_ruin_it(kind: str, worn: dict[str, float]) -> None:
    disturbance = Disturbance(growth_mm=(0.001, -0.002, 0.004), growth_rad=(5e-6, -8e-6, 4e-6), **worn)
    e = hexapod_experiment(HEXAPOD, kind, 2, disturbance=disturbance)
    cal = found(e)
    error = scan_error(cal, e)
    assert error.shared < 0.08
    assert error.shared < 2.0 * error.u_shared
    assert 0.9 < error.inside < 0.995
    lag = cal.errors.lag
    assert lag.names == tuple(name for name in cal.tangent if name.startswith("lag_"))
    assert not any("lag_" in name for name in cal.errors.names), "wear is distinguished from the geometry"
    assert max(cal.errors.scatter.t) > 0.0006, "what the run drifted may come again"
    assert any("drifted" in reason for reason in cal.reasons)


@pytest.mark.slow
def test_leg_backlash_follows_the_scan() -> None:
    """The identified lag, applied in the order of the scan's moves, halves what is left without it."""
    e = hexapod_experiment(HEXAPOD, "mixed", 2, disturbance=Disturbance(leg_backlash_mm=0.003))
    cal = found(e)
    without = replace(cal, errors=replace(cal.errors, lag=None))
    assert scan_error(cal, e).shared < 0.6 * rms_px(
        without_object_pose(projection_matrices(without, e.scan).P, e.P_true, e.points)
    )
    back = corrected_poses(cal.errors, commands_for(cal.errors, e.scan))
    off = np.abs(back.T_MH.t - e.scan.T_MH.t).max(axis=1)
    assert np.mean(off > 1e-3) < 0.02, "except for poses at which a leg turns round in one table and not in the other"
    assert off.max() < 0.006


@pytest.mark.slow
def test_robot_on_the_table() -> None:
    e = robot_experiment(ROBOT, 1, table=True)
    assert scan_error(found(e), e).shared < scan_error(rigid_of(e), e).shared / 20


@pytest.mark.slow
def test_scale_of_a_robot_alone_is_as_good_as_its_links() -> None:
    """With one ball and the table still, what is left is the scale of the object, whatever the poses; a message says
    so."""
    e = robot_experiment(ROBOT, 1)
    cal = found(e)
    error, before = scan_error(cal, e), scan_error(rigid_of(e), e).shared
    assert error.but_scale < before / 50
    assert 0.2 < error.u_shared < 0.5
    assert error.shared < 2.5 * error.u_shared
    assert any("all lengths of the robot together" in note for note in cal.observability.notes)
    table = found(robot_experiment(ROBOT, 1, table=True))
    assert not any("all lengths" in note for note in table.observability.notes)


def test_a_robot_may_grow_about_the_source_unseen() -> None:
    """All links, the ball's offset and the base's distance from the source, 1 % larger: not one centre moves."""
    e = robot_experiment(ROBOT, 2, n=20)
    T_HT = RigidTransform.from_angles([0.01, -0.02, 2.8], [-480.0, 20.0, -310.0], source=Frame.H, target=Frame.T)
    ball, s = np.array([12.0, -14.0, 70.0]), 1.01
    grown = replace(ROBOT, joints=tuple(replace(j, a=s * j.a, d=s * j.d) for j in ROBOT.joints))
    T_TS = SCANNER.T_WS @ SCANNER.T_TW(0.0)
    moved = replace(T_HT, t=s * T_HT.t + (s - 1) * T_TS.R.T @ T_TS.t)
    seen, again = (
        project_ball(SCANNER, T_HT=T, T_MH=robot.forward(e.poses.q), t=t)
        for T, robot, t in ((T_HT, ROBOT, ball), (moved, grown, s * ball))
    )
    np.testing.assert_allclose(again, seen, atol=1e-9)


@pytest.mark.slow
def test_planned_poses_of_a_robot() -> None:
    """With table angles the plan determines the scale; without, it says what it leaves."""
    still, turned = (
        plan_kinematic(
            SCANNER,
            ROBOT,
            T_HT=work.T_HT,
            balls=[10.0, -8.0, 16.0],
            candidates=work.candidates,
            scan=work.scan,
            points=object_points(),
            n=40,
        )
        for work in (
            robot_work(ROBOT, half_range=10.0, tilt=0.35, spin=2.9, table_angles=angles)
            for angles in ((0.0,), (0.0, np.pi / 2, np.pi))
        )
    )
    assert still.trusted > 20 * still.but_scale
    assert still.identified > 10 * still.but_scale
    assert turned.identified < 0.01
    assert turned.poses.q is not None
    np.testing.assert_allclose(ROBOT.forward(turned.poses.q).t, turned.poses.T_MH.t, atol=1e-9)


@pytest.mark.slow
def test_robot_alone_needs_one_known_length() -> None:
    """All of a robot's lengths with the ball and the distance to the source can grow together; a scale bar stops it."""
    e = robot_experiment(ROBOT, 1, balls=2)
    length = float(np.linalg.norm(ROBOT_BALLS[0] - ROBOT_BALLS[1]))
    without = found(e)
    bar = found(e, distances={(0, 1): (length, 0.0005)})
    assert scan_error(bar, e).shared < scan_error(rigid_of(e), e).shared / 20
    assert scan_error(bar, e).u_shared < 0.1 * scan_error(without, e).u_shared
    assert abs(np.linalg.norm(bar.balls[0] - bar.balls[1]) - length) < 0.002


def test_matrices_of_a_robot_whose_base_is_behind_the_source() -> None:
    """At home, zero, the origin of W would move behind the source; depths of the object stay positive all the same."""
    e = robot_experiment(ROBOT, 1, n=60, table=True)
    cal = found(e)
    P = projection_matrices(cal, e.scan)
    assert (P.P[:, 2, 3] < 0).any(), "the case that the sign is about"
    np.testing.assert_allclose(P.P, e.P_true, atol=2e-2 * np.abs(e.P_true).max())
    P.require_in_front(e.points)
    np.testing.assert_array_equal(P.select([3]).decompose().source, P.decompose().source[3:4])
    scan = e.scan.select(slice(0, 90))
    near = projection_matrices(cal, scan, home=corrected_poses(cal.errors, scan).T_MH[0])
    own = cal.scanner
    np.testing.assert_allclose(near.P[0], own.P_S @ own.T_WS.matrix, atol=1e-6)
    assert (near.P[:, 2, 3] > 0).all()
    np.testing.assert_allclose(near.points_sigma, projection_matrices(cal, scan).points_sigma, rtol=1e-6)


@pytest.mark.slow
def test_cartesian_log_of_a_robot_gives_the_same() -> None:
    e = robot_experiment(ROBOT, 0, n=60, table=True, spin=1.0, tilt_deg=8.0)  # one branch of the wrist throughout
    cartesian = replace(e.poses, q=None)
    a, b = found(e, "kinematic"), found(e, "kinematic", poses=cartesian)
    np.testing.assert_allclose(a.errors.values, b.errors.values, atol=1e-6)


@pytest.mark.slow
def test_gross_errors_are_set_aside() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    x = e.observations.x_D.copy()
    x[[5, 50, 100]] += [[3, 1], [0.3, -0.3], [-40, 50]]
    cal = found(e, observations=replace(e.observations, x_D=x))
    assert set(cal.outliers) == {"5", "50", "100"}
    assert len(cal.pose_id) == 186
    assert scan_error(cal, e).shared < 0.03


def test_exchanged_balls_are_named() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0, balls=2)
    ball = np.array(e.poses.ball_id)
    ball[[10, 11]] = ball[[11, 10]]
    with pytest.raises(InputError, match="pose '10' is said to show ball 1 and shows ball 0"):
        found(e, poses=replace(e.poses, ball_id=ball))


def test_machine_may_come_as_model_document_or_file(tmp_path: Any) -> None:
    from tomopose.manipulator.files import write_manipulator

    write_manipulator(tmp_path / "hexapod.json", HEXAPOD)
    for given in (HEXAPOD, tmp_path / "hexapod.json", str(tmp_path / "hexapod.json"), HEXAPOD.to_json()):
        machine = machine_of(given)
        assert machine is not None
        np.testing.assert_allclose(machine.sigma, HEXAPOD.sigma)
    with pytest.raises(InputError, match="manipulator is int"):
        machine_of(42)


def test_wrong_calls_are_refused() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0, balls=2)
    rigid = rigid_of(e)
    for options, message in (
        ({"model": "magic"}, "unknown model"),
        ({"model": "kinematic"}, "needs the manipulator"),
        ({"model": "auto", "manipulator": HEXAPOD, "distances": {(0, 7): (20.0, 0.1)}}, "observed are balls"),
        ({"model": "auto", "manipulator": HEXAPOD, "distances": {(0, 1): (-20.0, 0.1)}}, "two numbers > 0"),
    ):
        with pytest.raises(InputError, match=message):
            calibrate_kinematic(e.scanner, e.poses, e.observations, rigid=rigid, **options)


@pytest.mark.slow
def test_result_survives_its_file(tmp_path: Any) -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    cal = found(e)
    write_calibration(tmp_path / "calibration.json", cal)
    again = read_calibration(tmp_path / "calibration.json")
    np.testing.assert_array_equal(
        corrected_poses(again.errors, e.scan).T_MH.matrix, corrected_poses(cal.errors, e.scan).T_MH.matrix
    )
    assert scan_error(again, e) == scan_error(cal, e)


@pytest.mark.slow
def test_deterministic_and_independent_of_row_order() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    order = np.random.default_rng(1).permutation(len(e.observations))
    shuffled: BallObservations = e.observations.select(order)
    a, b, c = found(e), found(e), found(e, observations=shuffled)
    assert errors_document(a.errors) == errors_document(b.errors)
    np.testing.assert_array_equal(a.errors.values, c.errors.values)


def test_residuals_by_axis_before_and_after() -> None:
    """Fig. 8 (b): tilts ten times worse than the rest, and after the correction all alike."""
    cal = found(hexapod_experiment(HEXAPOD, "paper", 0))
    rows = {row.rotation: row for row in cal.comparison.by_rotation}
    assert set(rows) == {"none", "+x", "-x", "+y", "-y", "+z", "-z"}
    assert all(row.n == 27 for row in rows.values())
    worst = max(row.px["rigid"] for row in rows.values())
    assert worst > 3 * min(row.px["rigid"] for row in rows.values())
    assert max(row.px["kinematic"] for row in rows.values()) < 0.04
    assert rows["+x"].um["rigid"] == pytest.approx(rows["+x"].px["rigid"] * 200 / cal.scanner.magnification)


def test_freed_scanner_parameters_are_solved_along() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 4)
    stated = {**e.scanner.exact().sigma, "u_0": 1.0, "d_SR": 0.1}
    off = replace(e.scanner, u_0=e.scanner.u_0 + 0.8, d_SR=e.scanner.d_SR + 0.05, sigma=stated)
    rigid = calibrate(off, e.poses, e.observations, model="rigid", hypotheses=False)
    cal = calibrate_kinematic(off, e.poses, e.observations, rigid=rigid, manipulator=HEXAPOD, model="kinematic")
    u = {p.name: p.u for p in cal.parameters}
    assert abs(cal.scanner.u_0 - e.scanner.u_0) < 4 * u["u_0"] < 0.2
    assert abs(cal.scanner.d_SR - e.scanner.d_SR) < 4 * u["d_SR"] < 0.1
