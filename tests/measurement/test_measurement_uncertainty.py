"""The calibration's share in lengths, and simulation after JCGM 101."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.rotations import R_z
from tomopose.measurement.uncertainty import (
    displaced,
    distance_uncertainty,
    points_covariance,
    shortest_interval,
    simulate,
)

K = np.array([[6000.0, 0, 700.3], [0, 4800.0, 512.9], [0, 0, 1]])
POINTS = np.array([[0.0, 0, 0], [12.0, 3, -4], [-6.0, 9, 5]])


def matrices(d_SR=300.0, n=24):
    """A circular scan (n, 3, 4): the source at x = d_SR, looking along -x, v up."""
    look = np.array([[0, -1.0, 0], [0, 0, -1.0], [-1.0, 0, 0]])
    P = np.zeros((n, 3, 4))
    for k, alpha in enumerate(np.linspace(0, 2 * np.pi, n, endpoint=False)):
        P[k, :, :3], P[k, :, 3] = look @ R_z(alpha), [0, 0, d_SR]
    return K @ P


def test_exact_matrices_leave_points_where_they_are():
    assert np.abs(displaced(matrices(), matrices(), POINTS) - POINTS).max() < 1e-10


def test_a_wrong_magnification_scales_all_lengths():
    found = displaced(matrices(300.0), matrices(300.3), POINTS)
    ratio = np.linalg.norm(found[1] - found[0]) / np.linalg.norm(POINTS[1] - POINTS[0])
    assert ratio == pytest.approx(300 / 300.3, abs=2e-5)


def test_an_uncertain_distance_is_a_share_of_each_length():
    rng = np.random.default_rng(1)
    C = points_covariance(matrices(), (matrices(300 * (1 + 1e-4 * e)) for e in rng.standard_normal(60)), POINTS)
    length = np.linalg.norm(POINTS[2] - POINTS[1])
    assert distance_uncertainty(C, POINTS, 1, 2) == pytest.approx(1e-4 * length, rel=0.25)


def test_bad_views():
    with pytest.raises(InputError, match="do not fix"):
        displaced(matrices(n=1), matrices(n=1), POINTS)
    with pytest.raises(ShapeError):
        displaced(matrices(), matrices(n=7), POINTS)
    with pytest.raises(InputError, match="at least 10"):
        points_covariance(matrices(), [matrices()] * 3, POINTS)


def test_the_shortest_interval_of_a_skew_distribution():
    low, high = shortest_interval(np.random.default_rng(2).exponential(size=20000))
    assert low < 0.01
    assert high == pytest.approx(-np.log(0.05), rel=0.05)


def test_a_simulation_stops_when_it_is_stable_and_repeats():
    one, two = (simulate(lambda rng: 5 + 0.1 * rng.standard_normal(), tolerance=0.01, seed=4) for _ in range(2))
    assert one == two
    assert one.stable
    assert one.u == pytest.approx(0.1, rel=0.1)
    assert one.high - one.low == pytest.approx(2 * 1.96 * 0.1, rel=0.1)
    assert not simulate(lambda rng: rng.standard_normal(), tolerance=1e-6, most=200).stable


def test_a_simulation_refuses_what_is_no_number():
    with pytest.raises(InputError, match="finite"):
        simulate(lambda rng: np.nan, tolerance=1.0)
    with pytest.raises(InputError, match="tolerance"):
        simulate(lambda rng: 1.0, tolerance=0.0)
