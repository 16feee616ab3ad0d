"""Every alternative is found when it is the truth, and the poses' blindness is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_cases import BALL, MOUNT, SCANNER, mixed_poses, observe, paper_poses

from tomopose.calibration.checks.conventions.alternatives import ALTERNATIVES
from tomopose.calibration.checks.conventions.diagnose import diagnose
from tomopose.calibration.checks.conventions.fits import FIRST_ROWS, Reading
from tomopose.calibration.model.problem import pair
from tomopose.calibration.model.silhouettes import Cameras
from tomopose.calibration.rigid.start import ray_equations
from tomopose.calibration.solve import calibrate
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.rotations import rotation_from_convention
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

MIXED = mixed_poses()
ANGLES = np.degrees(MIXED.T_MH.angles)


def written_as(R, t, alpha=MIXED.alpha, **columns):
    T = RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H)
    return PoseSequence(T_MH=T, pose_id=MIXED.pose_id, alpha=alpha, **columns)


def mistakes():
    """name of the alternative that is true -> (poses as declared, centres as declared)."""
    T, exact = MIXED.T_MH, observe(MIXED).x_D
    n_u, n_v = SCANNER.n_u - 1, SCANNER.n_v - 1
    Rt = np.swapaxes(T.R, 1, 2)
    own = written_as(T.R, T.t)
    return {
        "rows flipped": (own, exact * [1, -1] + [0, n_v]),
        "columns flipped": (own, exact * [-1, 1] + [n_u, 0]),
        "image turned by 180 degrees": (own, [n_u, n_v] - exact),
        "table sign": (written_as(T.R, T.t, -MIXED.alpha), exact),
        "pose inverted": (written_as(Rt, -(Rt @ T.t[:, :, None])[..., 0]), exact),
        "rotation inverted": (written_as(Rt, T.t), exact),
        "translation in the tool frame": (written_as(T.R, (Rt @ T.t[:, :, None])[..., 0]), exact),
        "x and y exchanged": (written_as(T.R, T.t[:, [1, 0, 2]]), exact),
        "sign of z": (written_as(T.R, T.t * [1, 1, -1]), exact),
        "half a pixel low": (own, exact + 0.5),
        "pixels counted from 1": (own, exact + 1),
        "sign of U": (written_as(rotation_from_convention(ANGLES * [-1, 1, 1], "pi-hexapod"), T.t), exact),
        "sign of UVW": (written_as(rotation_from_convention(-ANGLES, "pi-hexapod"), T.t), exact),
        # the angles are those of R_z R_y R_x, and were read as R_x R_y R_z
        "order ZYX": (written_as(rotation_from_convention(_zyx_angles(T.R), "pi-hexapod"), T.t), exact),
        "pairing lag +1": (
            written_as(np.roll(T.R, 1, axis=0), np.roll(T.t, 1, axis=0), np.roll(MIXED.alpha, 1)),
            exact,
        ),
        "pairing lag -2": (
            written_as(np.roll(T.R, -2, axis=0), np.roll(T.t, -2, axis=0), np.roll(MIXED.alpha, -2)),
            exact,
        ),
        "angles are radians": (written_as(rotation_from_convention(np.radians(ANGLES), "pi-hexapod"), T.t), exact),
    }


def _zyx_angles(R):
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_euler("xyz", degrees=True)


CASES = mistakes()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_true_alternative_comes_first(name):
    poses, x = CASES[name]
    found = diagnose(SCANNER, poses, BallObservations.from_sigma(x, 0.0146, pose_id=poses.pose_id))
    best = found.hypotheses[0]
    assert best.outcome == "better"
    # two readings may be the same to within the noise, as a sign of all angles and a transposed rotation nearly are
    assert name == best.name or next(h for h in found.hypotheses if h.name == name).delta < 0.9 * best.delta
    assert best.d_rms < 0.1
    assert name in " ".join(h.name for h in found.better)
    assert all(h.remedy for h in found.better)


def test_quick_alternatives_reject_a_calibration():
    poses, x = CASES["sign of UVW"]
    cal = calibrate(SCANNER, poses, BallObservations.from_sigma(x, 0.0146, pose_id=poses.pose_id))
    assert cal.verdict == "rejected"
    assert "counted the other way" in cal.reasons[0]
    assert cal.hypotheses[0].outcome == "better"
    assert cal.hypotheses[0].remedy


def test_mixed_poses_distinguish_all_but_the_true_symmetries():
    found = diagnose(SCANNER, MIXED, observe(MIXED))
    assert found.hypotheses[0].outcome == "declared"
    assert {h.name for h in found.same} == {"table zero", "image turned by 180 degrees and table sign"}
    assert all(h.symmetry for h in found.same)
    assert "true symmetries" in " ".join(found.advice)


def test_the_papers_plan_is_blind_to_what_it_is_blind_to():
    """Order and half a pixel leave the noise floor: the headline of what such a plan cannot determine."""
    poses = paper_poses()
    found = diagnose(SCANNER, poses, observe(poses))
    same = {h.name for h in found.same}
    assert {"order ZYX", "order YXZ", "half a pixel low", "half a pixel high", "table zero"} <= same
    assert "cannot be distinguished" in " ".join(found.advice)
    by_name = {h.name: h for h in found.hypotheses}
    assert by_name["sign of UVW"].d_rms > 1.0
    assert by_name["sign of UVW"].outcome == "worse"


def test_a_ball_on_the_pivot_hides_signs():
    poses = paper_poses()
    near = np.array([0.7, -0.5, 0.6])
    found = diagnose(SCANNER, poses, observe(poses, t=near))
    wrong = next(h for h in found.hypotheses if h.name == "sign of UVW")
    assert 0.02 < wrong.d_rms < 0.2


def test_set_and_encoder_poses_are_alternatives():
    rng = np.random.default_rng(2)
    off = replace(MIXED.T_MH, t=MIXED.T_MH.t + rng.normal(0, 0.02, (len(MIXED), 3)))
    declared = replace(MIXED, T_MH=off, T_MH_set=MIXED.T_MH)
    found = diagnose(SCANNER, declared, observe(MIXED))
    assert found.hypotheses[0].name == "set poses"
    assert calibrate(SCANNER, declared, observe(MIXED)).verdict == "rejected"


def test_alternatives_change_nothing_and_have_different_names():
    problem = pair(SCANNER, MIXED, observe(MIXED))
    before = [a.copy() for a in (problem.R_MH, problem.t_MH, problem.x_D, problem.alpha)]
    for alternative in ALTERNATIVES:
        alternative.change(problem)
    for a, b in zip(before, (problem.R_MH, problem.t_MH, problem.x_D, problem.alpha), strict=True):
        np.testing.assert_array_equal(a, b)
    assert len({r.name for r in ALTERNATIVES}) == len(ALTERNATIVES) >= 40


def test_a_turned_scanner_keeps_the_truth():
    """The true symmetry, by its own definition: half a turn about the beam, table counted backwards."""
    alternative = next(r for r in ALTERNATIVES if r.symmetry and "180" in r.name)
    problem = alternative.change(pair(SCANNER, MIXED, observe(MIXED, seed=None)))
    turned = PoseSequence(T_MH=MIXED.T_MH, pose_id=MIXED.pose_id, alpha=problem.alpha)
    cal = calibrate(
        SCANNER, turned, BallObservations.from_sigma(problem.x_D, 0.01, pose_id=MIXED.pose_id), hypotheses=False
    )
    assert cal.d_rms < 1e-9
    np.testing.assert_allclose(cal.t, BALL, atol=1e-8)
    np.testing.assert_allclose(cal.T_HT.t, MOUNT.t * [1, -1, -1], atol=1e-8)


TAU = np.linspace(0, 1, len(MIXED))
COURSES = {"even": TAU, "settling": 1 - np.exp(-3 * TAU), "to and fro": np.sin(4 * TAU), "step": (TAU > 0.5) * 1.0}


def drifting(x, course, size, seed):
    rng = np.random.default_rng(seed)
    a = rng.uniform(0, 2 * np.pi)
    noisy = x + rng.normal(0, 0.0146, x.shape) + size * COURSES[course][:, None] * [np.cos(a), np.sin(a)]
    return BallObservations.from_sigma(noisy, 0.0146, pose_id=MIXED.pose_id)


@pytest.mark.slow
@pytest.mark.parametrize("course", COURSES)
@pytest.mark.parametrize("size", [0.2, 3.0])
def test_a_drift_is_not_taken_for_a_wrong_convention(course, size):
    exact = observe(MIXED, seed=None).x_D
    for seed in range(3):
        observed = drifting(exact, course, size, seed)
        assert diagnose(SCANNER, MIXED, observed).better == ()
        cal = calibrate(SCANNER, MIXED, observed)
        assert cal.verdict == "doubtful"
        assert any("drift" in r or "changed" in r for r in cal.reasons)
        assert not any("convention fits" in r for r in cal.reasons)


@pytest.mark.slow
@pytest.mark.parametrize("course", COURSES)
@pytest.mark.parametrize("name", ["sign of UVW", "order ZYX", "pairing lag +1"])
def test_a_wrong_convention_is_found_under_drift(name, course):
    poses, x = CASES[name]
    observed = drifting(x, course, 0.3, 1)
    better = diagnose(SCANNER, poses, observed).better
    assert name in {h.name for h in better[:2]}
    assert calibrate(SCANNER, poses, observed).verdict == "rejected"


def test_an_alternative_of_many_balls_is_fitted_to_some_rows_of_each_first():
    balls, poses, rng = 3, 2 * FIRST_ROWS + 5, np.random.default_rng(2)
    x, angles = rng.uniform(-9, 9, (poses, 3)), rng.uniform(-6, 6, (poses, 3))
    ball, alpha = np.tile(np.arange(balls), poses), rng.choice([0.0, np.pi / 2], poses)
    several = (np.repeat(a, balls, axis=0) for a in (x, angles))
    table = PoseSequence.from_table(*several, alpha=np.repeat(alpha, balls), ball_id=ball)
    t = np.array([[8.0, -6.0, 17.0], [-11.0, 4.0, 3.0], [2.0, 9.0, -8.0]])[ball]
    x_D = project_ball(SCANNER, T_HT=MOUNT, T_MH=table.T_MH, t=t, alpha=table.alpha)
    x_D = x_D * [1, -1] + [0, SCANNER.n_v - 1] + rng.normal(0, 0.0146, x_D.shape)
    flipped = BallObservations.from_sigma(x_D, 0.0146, pose_id=table.pose_id)
    problem = pair(SCANNER, table, flipped)
    cameras = Cameras.of(problem)
    first = Reading.of(problem, cameras, ray_equations(problem, cameras), thoroughly=False)
    assert np.bincount(problem.ball[first.rows]).tolist() == [FIRST_ROWS] * balls
    found = calibrate(SCANNER, table, flipped)
    assert found.hypotheses[0].name == "rows flipped"
    assert found.verdict == "rejected"
