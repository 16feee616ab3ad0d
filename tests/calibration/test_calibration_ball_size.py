"""The ball's silhouette as a gauge of d_SD, pitch and diameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_cases import BALL, MOUNT, SCANNER, mixed_poses, observe, paper_poses
from scipy.spatial import ConvexHull

import tomopose as tp
from tomopose.calibration.build import with_findings
from tomopose.calibration.checks import ball_size
from tomopose.calibration.checks.ball_size import ball_size_findings, size_ratio
from tomopose.calibration.solve import calibrate
from tomopose.errors import InputError

DIAMETER = 8.0


def silhouette_px2(scanner: tp.Scanner, x_S: np.ndarray) -> float:
    """Area of the shadow of a ball's surface points, px^2."""
    k = np.arange(40_000) + 0.5
    z, phi = 1.0 - 2.0 * k / k.size, np.pi * (1.0 + np.sqrt(5.0)) * k
    s = np.sqrt(1.0 - z**2)
    ball = x_S + DIAMETER / 2 * np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=1)
    y = np.c_[ball, np.ones(len(ball))] @ scanner.P_S.T
    return float(ConvexHull(y[:, :2] / y[:, 2:]).volume)


@pytest.fixture(scope="module")
def run():
    poses = mixed_poses(n=16)
    T_MS = SCANNER.T_WS @ SCANNER.T_TW(poses.alpha) @ MOUNT @ poses.T_MH
    radius_px = np.sqrt([silhouette_px2(SCANNER, x) / np.pi for x in T_MS.apply(BALL)])
    return poses, replace(observe(poses), semi_major=radius_px, semi_minor=radius_px)


def test_size_is_that_of_the_shadow_of_the_balls_own_surface(run):
    poses, observed = run
    calibration = calibrate(SCANNER, poses, observed)
    assert size_ratio(calibration, poses, observed, DIAMETER) == pytest.approx(1.0, abs=3e-4)
    assert ball_size_findings(calibration, poses, observed, DIAMETER) == ()


def test_wrong_scale_of_the_translations_that_centres_hide_is_named():
    poses = paper_poses(2)
    T_MS = SCANNER.T_WS @ SCANNER.T_TW(0.0) @ MOUNT @ poses.T_MH
    radius_px = np.sqrt([silhouette_px2(SCANNER, x) / np.pi for x in T_MS.apply(BALL)])
    observed = replace(observe(poses), semi_major=radius_px, semi_minor=radius_px)
    longer = replace(poses, T_MH=replace(poses.T_MH, t=1.01 * poses.T_MH.t))
    calibration = calibrate(SCANNER, longer, observed)
    assert calibration.chi2 / calibration.dof < 1.3
    ratio = size_ratio(calibration, longer, observed, DIAMETER)
    assert ratio == pytest.approx(1.01, abs=1e-3)
    (finding,) = ball_size_findings(calibration, longer, observed, DIAMETER)
    assert finding.rule.startswith("size of the ball")
    assert "the scale of the poses' translations" in finding.words


@pytest.mark.parametrize("ratio", [1.021, 0.979])
def test_more_than_two_per_cent_is_an_error(run, ratio, monkeypatch):
    poses, observed = run
    monkeypatch.setattr(ball_size, "size_ratio", lambda *_: ratio)
    with pytest.raises(InputError, match=r"2\.1 % (larger|smaller) than a ball of 8 mm"):
        ball_size_findings(calibrate(SCANNER, poses, observed), poses, observed, DIAMETER)


@pytest.mark.parametrize(("ratio", "verdict"), [(1.0049, None), (1.006, "trustworthy"), (0.987, "doubtful")])
def test_a_smaller_difference_is_a_finding(run, ratio, verdict, monkeypatch):
    poses, observed = run
    monkeypatch.setattr(ball_size, "size_ratio", lambda *_: ratio)
    calibration = calibrate(SCANNER, poses, observed)
    found = ball_size_findings(calibration, poses, observed, DIAMETER)
    assert [f.verdict for f in found] == ([] if verdict is None else [verdict])
    assert with_findings(calibration, found).verdict == (verdict or "trustworthy")


def test_wrong_diameter_shows_as_its_ratio(run):
    poses, observed = run
    ratio = size_ratio(calibrate(SCANNER, poses, observed), poses, observed, DIAMETER / 1.05)
    assert ratio == pytest.approx(1.05, abs=1e-3)


def test_without_sizes_nothing_is_said(run):
    poses, observed = run
    bare = replace(observed, semi_major=None, semi_minor=None)
    calibration = calibrate(SCANNER, poses, bare)
    assert np.isnan(size_ratio(calibration, poses, bare, DIAMETER))
    assert ball_size_findings(calibration, poses, bare, DIAMETER) == ()
