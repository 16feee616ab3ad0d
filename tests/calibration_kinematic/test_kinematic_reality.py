"""What was assumed, what changed during the run and what explains the residuals, beside identified errors too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from manipulator_cases import Experiment, hexapod_experiment
from twin_cases import TwinExperiment, twin_experiment

import tomopose as tp
from tomopose import Calibration
from tomopose.calibration.arrangements.twin_robots import calibrate_twin
from tomopose.geometry.projection import project_ball
from tomopose.geometry.rotations import exp_rotation
from tomopose.manipulator.error_models import corrected_poses
from tomopose.manipulator.real_poses import Repeatability
from tomopose.manipulator.virtual import Disturbance, typical_hexapod, typical_robot

HEXAPOD = typical_hexapod()


@pytest.fixture(scope="module")
def hexapod() -> Experiment:
    return hexapod_experiment(HEXAPOD, "mixed", 3)


@pytest.fixture(scope="module")
def twins() -> TwinExperiment:
    return twin_experiment(typical_robot(), 2, n=120)


def identified(e: Experiment, **changed: object) -> Calibration:
    scanner, observations = changed.get("scanner", e.scanner), changed.get("observations", e.observations)
    return tp.calibrate(scanner, e.poses, observations, manipulator=HEXAPOD, model="kinematic", hypotheses=False)


def rules(cal: Calibration) -> set[str]:
    return {f.rule for f in cal.checks}


@pytest.mark.slow
def test_a_scanner_value_beyond_what_was_assumed_is_freed_beside_the_errors(hexapod: Experiment) -> None:
    """The rigid fit of such a machine pulls a dozen values; beside its errors only the wrong one is left."""
    wrong = replace(hexapod.scanner, u_0=hexapod.scanner.u_0 + 4.0, sigma={})
    cal = identified(hexapod, scanner=wrong)
    assert [c.name for c in cal.contradicted] == ["u_0"]
    assert cal.contradicted[0].off == pytest.approx(-4.0, abs=0.1)
    assert rules(cal) == {"value freed"}
    assert cal.explanations[0].name == "u_0"
    assert identified(hexapod, scanner=replace(wrong, u_0=hexapod.scanner.u_0)).contradicted == ()


def bumped(e: Experiment, cal: Calibration, at: int) -> tp.BallObservations:
    """The centres had the mount moved by 0.1 mm and 0.25 mrad before pose `at`."""
    T_MH = corrected_poses(cal.errors, e.poses).T_MH
    turned = exp_rotation(np.array([2e-4, -1e-4, 1e-4])) @ cal.T_HT.R
    moved = replace(cal.T_HT, R=turned, t=cal.T_HT.t + [0.08, 0.05, 0.0])
    here, there = (
        project_ball(cal.scanner, T_HT=T, T_MH=T_MH, t=cal.t, alpha=e.poses.alpha) for T in (cal.T_HT, moved)
    )
    late = np.arange(len(e.poses)) >= at
    return replace(e.observations, x_D=e.observations.x_D + late[:, None] * (there - here))


@pytest.mark.slow
@pytest.mark.parametrize("at", [120, 180])
def test_a_mount_that_is_bumped_is_named_at_its_pose_beside_the_errors(hexapod: Experiment, at: int) -> None:
    cal = identified(hexapod, observations=bumped(hexapod, identified(hexapod), at))
    assert cal.verdict == "doubtful"
    named = [f for f in cal.checks if f.rule in ("changed during the run", "block of outliers")]
    assert any(f.remedy.startswith(f"calibrate with the poses before {at}") for f in named)


@pytest.mark.slow
def test_a_closing_pose_that_is_off_is_never_silent_beside_the_errors(hexapod: Experiment) -> None:
    again = np.append(np.arange(188), 0)
    T = hexapod.poses.T_MH
    poses = replace(
        hexapod.poses, T_MH=replace(T, R=T.R[again], t=T.t[again]), alpha=hexapod.poses.alpha[again], orientations=None
    )
    x = np.concatenate([hexapod.observations.x_D[:188], hexapod.observations.x_D[:1] + [2.0, 0.0]])
    cal = tp.calibrate(
        hexapod.scanner,
        poses,
        replace(hexapod.observations, x_D=x),
        manipulator=HEXAPOD,
        model="kinematic",
        hypotheses=False,
    )
    (closing,) = (f for f in cal.checks if f.rule.startswith("repeated pose"))
    assert "188" in closing.words
    assert closing.value > 50.0


def test_what_no_ball_shows_and_the_scatter_are_assumed_and_in_the_scan(hexapod: Experiment) -> None:
    cal = identified(hexapod)
    assert cal.unseen is not None
    assert {"rotation_scale_x", "table_z_cos1"} <= set(cal.unseen.names)
    assert "scale_of_translations" not in cal.unseen.names  # the joints' errors hold it, with their priors
    assert {a.name: a.source for a in cal.assumed}["scatter_and_backlash_t"] == "option"
    blind = replace(cal, unseen=None)
    with_, without = (np.mean(tp.projection_matrices(c, hexapod.scan).points_sigma_shared ** 2) for c in (cal, blind))
    assert with_ > without


@pytest.mark.slow
def test_scatter_that_chi2_does_not_show_is_what_the_residuals_leave_room_for() -> None:
    """A machine that is quieter than its data sheet, as it says, and half again as restless."""
    found = []
    for scale in (0.05, 1.5):
        scatter = Repeatability(t_mm=scale * HEXAPOD.repeatability.t_mm, w_rad=scale * HEXAPOD.repeatability.w_rad)
        e = hexapod_experiment(HEXAPOD, "mixed", 4, disturbance=Disturbance(scatter=scatter))
        cal = identified(e)
        assert cal.errors.scatter is not None
        found.append(cal.errors.scatter.t[0] / HEXAPOD.repeatability.t_mm)
    assert 0.0 < found[0] < 0.9
    assert found[1] > 1.1


def test_images_that_drift_are_named_for_twin_robots_and_what_was_assumed_is_said(twins: TwinExperiment) -> None:
    e = twins
    x = e.observations.x_D + np.linspace(0.0, 1.0, len(e.poses))[:, None] * [0.0, 2.5]
    cal = calibrate_twin(e.scanner, e.poses, replace(e.observations, x_D=x), twin=e.twin, mount=e.mount, model="rigid")
    assert {"p_u", "p_v", "scatter_and_backlash_t"} <= {a.name for a in cal.assumed}
    assert any("drift" in f.words for f in cal.checks if f.rule == "changed during the run")
