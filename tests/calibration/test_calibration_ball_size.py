"""The ball's silhouette as a gauge of d_SD, pitch and diameter."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibration_cases import BALL, MOUNT, SCANNER, mixed_poses, observe, paper_poses
from scipy.spatial import ConvexHull

import tomopose as tp
from tomopose.calibration.checks.ball_size import size_ratio
from tomopose.calibration.model.silhouettes import silhouette_outlines
from tomopose.calibration.solve import calibrate
from tomopose.errors import InputError, UnitError

DIAMETER = 8.0


def silhouette_px2(scanner: tp.Scanner, x_S: np.ndarray) -> float:
    """Area of the shadow of a ball's surface points, px^2."""
    k = np.arange(40_000) + 0.5
    z, phi = 1.0 - 2.0 * k / k.size, np.pi * (1.0 + np.sqrt(5.0)) * k
    s = np.sqrt(1.0 - z**2)
    ball = x_S + DIAMETER / 2 * np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=1)
    y = np.c_[ball, np.ones(len(ball))] @ scanner.P_S.T
    return float(ConvexHull(y[:, :2] / y[:, 2:]).volume)


def with_sizes(poses, observed, alpha):
    T_MS = SCANNER.T_WS @ SCANNER.T_TW(alpha) @ MOUNT @ poses.T_MH
    radius_px = np.sqrt([silhouette_px2(SCANNER, x) / np.pi for x in T_MS.apply(BALL)])
    return replace(observed, semi_major=radius_px, semi_minor=radius_px)


@pytest.fixture(scope="module")
def run():
    poses = mixed_poses(n=16)
    return poses, with_sizes(poses, observe(poses), poses.alpha)


def gauge(calibration):
    return [f for f in calibration.checks if f.rule.startswith("size of the ball")]


@pytest.mark.slow
def test_size_is_that_of_the_shadow_of_the_balls_own_surface(run):
    poses, observed = run
    calibration = calibrate(SCANNER, poses, observed.with_ball_diameter(DIAMETER))
    assert size_ratio(calibration, poses, observed, DIAMETER) == pytest.approx(1.0, abs=3e-4)
    assert gauge(calibration) == []


def test_outlines_under_a_matrix_are_the_areas_of_the_balls_own_shadow():
    rng = np.random.default_rng(4)
    x_S = np.array([30.0, -20.0, 300.0]) + rng.uniform(-20, 20, (5, 3))
    P = np.repeat(SCANNER.P_S[None], 5, axis=0)
    area = [silhouette_px2(SCANNER, x) for x in x_S]
    np.testing.assert_allclose(np.pi * silhouette_outlines(P, x_S, DIAMETER), area, rtol=3e-4)


@pytest.mark.slow
def test_wrong_scale_of_the_translations_that_centres_hide_is_named():
    poses = paper_poses(2)
    observed = with_sizes(poses, observe(poses), 0.0)
    longer = replace(poses, T_MH=replace(poses.T_MH, t=1.012 * poses.T_MH.t))
    calibration = calibrate(SCANNER, longer, observed.with_ball_diameter(DIAMETER))
    assert calibration.chi2 / calibration.dof < 1.3
    assert size_ratio(calibration, longer, observed, DIAMETER) == pytest.approx(1.012, abs=1e-3)
    (finding,) = gauge(calibration)
    assert "the scale of the poses' translations" in finding.words
    assert finding.verdict == calibration.verdict == "doubtful"


@pytest.mark.parametrize("ratio", [1.025, 0.975])
def test_more_than_two_per_cent_is_an_error(run, ratio):
    poses, observed = run
    with pytest.raises(InputError, match=r"2\.\d % (larger|smaller) than a ball of"):
        calibrate(SCANNER, poses, observed.with_ball_diameter(DIAMETER / ratio))


@pytest.mark.parametrize(("ratio", "verdict"), [(1.004, None), (1.007, "trustworthy"), (0.987, "doubtful")])
def test_a_smaller_difference_is_a_finding(run, ratio, verdict):
    poses, observed = run
    calibration = calibrate(SCANNER, poses, observed.with_ball_diameter(DIAMETER / ratio))
    assert [f.verdict for f in gauge(calibration)] == ([] if verdict is None else [verdict])
    assert calibration.verdict == (verdict or "trustworthy")


def test_without_sizes_or_diameter_nothing_is_said(run):
    poses, observed = run
    bare = replace(observed, semi_major=None, semi_minor=None)
    calibration = calibrate(SCANNER, poses, bare)
    assert np.isnan(size_ratio(calibration, poses, bare, DIAMETER))
    assert gauge(calibrate(SCANNER, poses, bare.with_ball_diameter(DIAMETER / 2))) == []
    assert gauge(calibrate(SCANNER, poses, observed)) == []


UNITS = [("centimetres (cm)", 10.0), ("inches (inch)", 25.4), ("metres (m)", 1000.0)]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "factor"), UNITS)
def test_positions_in_another_unit_are_refused_by_name_on_every_route(words, factor):
    """The table does not move, so that the centres fit as well; several balls, several runs and a moving scanner
    too."""
    message = re.escape(f"positions look like {words}")
    poses = paper_poses(2)
    shorter = replace(poses, T_MH=replace(poses.T_MH, t=poses.T_MH.t / factor))
    observed = with_sizes(poses, observe(poses), 0.0).with_ball_diameter(DIAMETER)
    with pytest.raises(UnitError, match=message):
        calibrate(SCANNER, shorter, observed)
    with pytest.raises(UnitError, match=message):
        calibrate(SCANNER, [shorter, shorter], [observed, observed])
    balls = np.arange(len(poses)) % 2
    with pytest.raises(UnitError, match=message):
        calibrate(SCANNER, replace(shorter, ball_id=balls), observed)
    with pytest.raises(UnitError, match=message):
        tp.calibrate_inverse(SCANNER, tp.inverse_poses(shorter), observed)


def test_without_sizes_another_unit_of_the_positions_keeps_a_calibration_from_being_trusted():
    poses = paper_poses(2)
    shorter = replace(poses, T_MH=replace(poses.T_MH, t=poses.T_MH.t / 10.0))
    calibration = calibrate(SCANNER, shorter, observe(poses))
    assert calibration.verdict == "doubtful"
    assert any("centimetres (cm)" in reason for reason in calibration.reasons)
    assert calibrate(SCANNER, replace(shorter, units_confirmed=True), observe(poses)).verdict == "trustworthy"
    assert calibrate(SCANNER, poses, observe(poses)).verdict == "trustworthy"
