"""Memory of a calibration: in proportion to its centres, whatever the number of poses and balls."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tomopose.calibration.model import tall
from tomopose.calibration.solve import calibrate
from tomopose.geometry.projection import project_ball
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

BALLS = 8


def many(scanner, T_HT, poses: int, balls: int = BALLS) -> tuple[PoseSequence, BallObservations]:
    """So many poses with all balls in each, and their noisy centres."""
    rng = np.random.default_rng(poses)
    x, angles, alpha = (
        np.repeat(a, balls, axis=0)
        for a in (rng.uniform(-9, 9, (poses, 3)), rng.uniform(-6, 6, (poses, 3)), rng.choice([0.0, np.pi / 2], poses))
    )
    ball = np.tile(np.arange(balls), poses)
    table = PoseSequence.from_table(x, angles, alpha=alpha, ball_id=ball)
    t = rng.uniform(-12, 12, (balls, 3))[ball]
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=table.T_MH, t=t, alpha=alpha) + rng.normal(0, 0.01, (len(table), 2))
    return table, BallObservations.from_sigma(x_D, 0.01, pose_id=table.pose_id)


def peak_of_a_calibration(scanner, T_HT, poses: int, balls: int = BALLS) -> int:
    """Largest memory, bytes, that is held while so many poses, with all balls in each, are calibrated."""
    table, observations = many(scanner, T_HT, poses, balls)
    tracemalloc.start()
    try:
        calibrate(scanner, table, observations)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_four_times_the_poses_take_four_times_the_memory(scanner, T_HT):
    peak_of_a_calibration(scanner, T_HT, 20)  # what is imported and compiled once is not a calibration's
    few, many = (peak_of_a_calibration(scanner, T_HT, n) for n in (100, 400))
    assert many < 5 * few
    # Measured: 8 kB a centre of these few, and 3.4 kB of 80,000, where rows are looked at in parts.
    assert many < 13_000 * 400 * BALLS


@pytest.mark.slow
def test_a_centre_takes_the_memory_of_its_own_ball_and_not_of_all(scanner, T_HT, monkeypatch):
    monkeypatch.setattr(tall, "PART", 128)
    peak_of_a_calibration(scanner, T_HT, 20, 4)
    peaks = [peak_of_a_calibration(scanner, T_HT, 2400 // balls, balls) for balls in (4, 24)]
    assert peaks[1] < 1.3 * peaks[0]  # measured: 1.17; with tables of all balls 1.46


def test_many_balls_looked_at_in_parts_give_the_same_calibration(scanner, T_HT, monkeypatch):
    table, observations = many(scanner, T_HT, 40, 5)
    x_D = observations.x_D + (np.arange(200) >= 120)[:, None] * [0.1, -0.05]
    x_D[17] += 3.0
    observations = BallObservations.from_sigma(x_D, 0.01, pose_id=table.pose_id)
    scanner = replace(scanner, sigma={})  # what nobody states is estimated with the default's prior
    whole = calibrate(scanner, table, observations)
    monkeypatch.setattr(tall, "PART", 16)
    parts = calibrate(scanner, table, observations)
    unit = np.sqrt(np.diag(whole.covariance))
    np.testing.assert_allclose(
        parts.covariance / np.outer(unit, unit), whole.covariance / np.outer(unit, unit), atol=1e-5
    )
    for a, b in zip(parts.parameters, whole.parameters, strict=True):
        assert a.value == pytest.approx(b.value, abs=1e-5 * b.u)
    assert parts.outliers.keys() == whole.outliers.keys()
    assert parts.pose_noise.translation_mm == pytest.approx(whole.pose_noise.translation_mm, rel=1e-5)
    assert parts.pose_noise.rotation_rad == pytest.approx(whole.pose_noise.rotation_rad, rel=1e-5)
    assert [(e.name, e.at, e.also) for e in parts.explanations] == [(e.name, e.at, e.also) for e in whole.explanations]
    assert whole.explanations
    for a, b in zip(parts.stability.effects, whole.stability.effects, strict=True):
        assert (a.at, a.share) == (b.at, pytest.approx(b.share, rel=1e-6))
    assert parts.stability.held_out_chi2 == pytest.approx(whole.stability.held_out_chi2, rel=1e-6)
    assert parts.halves.rms_px == pytest.approx(whole.halves.rms_px, rel=1e-6)
    assert parts.budget.total == pytest.approx(whole.budget.total, rel=1e-6)
    np.testing.assert_allclose(parts.unseen.gain, whole.unseen.gain, atol=1e-6 * np.abs(whole.unseen.gain).max())
    seen = (parts.observability.singular_values, whole.observability.singular_values)
    np.testing.assert_allclose(*seen, rtol=1e-6, atol=1e-12)


def test_rows_looked_at_in_parts_give_the_same_explanations(scanner, T_HT, monkeypatch):
    rng = np.random.default_rng(3)
    poses = PoseSequence.from_table(
        rng.uniform(-9, 9, (90, 3)), rng.uniform(-6, 6, (90, 3)), alpha=rng.choice([0.0, np.pi / 2], 90)
    )
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=[8.0, -6.0, 17.0], alpha=poses.alpha)
    x_D = x_D + rng.normal(0, 0.01, x_D.shape) + (np.arange(90) >= 50)[:, None] * [0.2, -0.1]
    observations = BallObservations.from_sigma(x_D, 0.01, pose_id=poses.pose_id)
    whole = calibrate(scanner, poses, observations)
    monkeypatch.setattr(tall, "PART", 16)
    parts = calibrate(scanner, poses, observations)
    assert [(e.name, e.at, e.predicts) for e in parts.explanations] == [
        (e.name, e.at, e.predicts) for e in whole.explanations
    ]
    assert whole.explanations
    for a, b in zip(parts.explanations, whole.explanations, strict=True):
        assert a.evidence == pytest.approx(b.evidence, rel=1e-6)
        np.testing.assert_allclose(a.size, b.size, rtol=1e-5, atol=1e-8)
    for a, b in zip(parts.stability.effects, whole.stability.effects, strict=True):
        assert (a.at, a.share) == (b.at, pytest.approx(b.share, rel=1e-6))
