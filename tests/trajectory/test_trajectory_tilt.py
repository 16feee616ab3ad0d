"""Eqs. (10), (11) and the sine of the paper, typed from the text apart from the code."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.rotations import R_y, R_z, rotation_angle_between, rotation_from_angles
from tomopose.trajectory.scan import circular_scan, scan, table_angles, tilted_scan
from tomopose.trajectory.tilt import (
    R_HT_MOUNTED,
    eq10_rotation,
    eq11_triangle,
    sine_tilt,
    sine_wave,
    triangle_wave,
)

ANGLE = st.floats(-4, 4)


@given(ANGLE, st.floats(-0.3, 0.3), st.tuples(ANGLE, st.floats(-1.5, 1.5), ANGLE))
def test_eq_10_tilts_about_the_fixed_y_axis(alpha, tilt, mount):
    # R_TW R_HT R_MH = R_y(tilt) R_TW R_HT: table first and tilt after is the same as plate first and table after
    R_HT = rotation_from_angles(np.array(mount))
    R_MH = eq10_rotation(np.array([alpha]), np.array([tilt]), R_HT)[0]
    assert rotation_angle_between(R_z(alpha) @ R_HT @ R_MH, R_y(tilt) @ R_z(alpha) @ R_HT) < 1e-7


def test_eq_10_with_the_printed_mount_at_hand_worked_angles():
    # R_z(pi) R_y(b) R_z(pi) = R_y(-b); with the table at 90 deg, R_x turns up
    np.testing.assert_allclose(eq10_rotation(np.zeros(1), np.array([0.1]))[0], R_y(-0.1), atol=1e-15)
    quarter = eq10_rotation(np.array([math.pi / 2]), np.array([0.1]))[0]
    c, s = math.cos(0.1), math.sin(0.1)
    np.testing.assert_allclose(quarter, [[1, 0, 0], [0, c, s], [0, -s, c]], atol=1e-15)


def test_eq_11_at_its_corners():
    period = 2 * math.pi / 7
    alpha = np.array([0, period / 4, period / 2, 3 * period / 4, period])
    np.testing.assert_allclose(np.degrees(eq11_triangle(alpha)), [0, -8, 0, 8, 0], atol=1e-12)


def test_eq_11_has_seven_periods_and_an_amplitude_of_eight_degrees():
    alpha = np.linspace(0, 2 * math.pi, 70001)
    phi = eq11_triangle(alpha)
    assert phi.max() == pytest.approx(math.radians(8), abs=1e-4)
    assert phi.min() == pytest.approx(-math.radians(8), abs=1e-4)
    assert int(np.sum((phi[:-1] < 0) & (phi[1:] >= 0))) == 7


def test_the_general_wave_contains_eq_11():
    alpha = np.linspace(-7, 7, 4001)
    np.testing.assert_allclose(triangle_wave(alpha, amplitude=2 * math.pi / 45), eq11_triangle(alpha), atol=1e-14)


@given(st.floats(0.01, 0.3), st.integers(1, 9), st.floats(-3, 3), st.floats(-0.2, 0.2))
def test_the_general_wave_stays_within_its_amplitude_and_repeats(amplitude, periods, phase, offset):
    alpha = np.linspace(0, 2 * math.pi, 997)
    wave = triangle_wave(alpha, amplitude=amplitude, periods=periods, phase=phase, offset=offset)
    assert np.abs(wave - offset).max() <= amplitude * (1 + 1e-12)
    again = triangle_wave(
        alpha + 2 * math.pi / periods, amplitude=amplitude, periods=periods, phase=phase, offset=offset
    )
    np.testing.assert_allclose(again, wave, atol=1e-11)


def test_the_sine_of_the_multi_sphere_scan():
    alpha = np.array([0.0, math.pi / 14, 3 * math.pi / 14])
    np.testing.assert_allclose(np.degrees(sine_tilt(alpha)), [1, 5, -3], atol=1e-12)
    np.testing.assert_allclose(sine_wave(alpha, amplitude=1, periods=1, phase=math.pi / 2), np.cos(alpha), atol=1e-15)


def test_table_angles_count_from_zero_to_one_step_before_the_turn():
    np.testing.assert_allclose(table_angles(4), [0, math.pi / 2, math.pi, 3 * math.pi / 2])
    np.testing.assert_allclose(table_angles(4, direction=-1, start=1.0), 1 - table_angles(4))


def test_scans_are_pose_sequences_at_zero_position():
    poses = tilted_scan(2100, eq11_triangle)
    assert len(poses) == 2100
    assert poses.source == "set"
    assert not poses.T_MH.t.any()
    tilts = rotation_angle_between(np.broadcast_to(np.eye(3), (2100, 3, 3)), poses.T_MH.R)
    np.testing.assert_allclose(tilts, np.abs(eq11_triangle(poses.alpha)), atol=1e-9)


def test_a_scan_takes_any_function_and_any_mount():
    R_HT = rotation_from_angles(np.array([0.02, -0.03, 3.05]))
    poses = tilted_scan(9, lambda alpha: 0.05 * np.cos(alpha), R_HT=R_HT, direction=-1)
    np.testing.assert_allclose(poses.T_MH.R, eq10_rotation(poses.alpha, 0.05 * np.cos(poses.alpha), R_HT))


def test_a_circular_scan_leaves_the_manipulator_at_zero():
    poses = circular_scan(7)
    np.testing.assert_array_equal(poses.T_MH.matrix, np.broadcast_to(np.eye(4), (7, 4, 4)))


def test_a_free_scan_keeps_positions_and_pivot():
    t = np.arange(6.0).reshape(2, 3)
    poses = scan(np.array([0.1, 0.2]), t_MH=t, pivot=np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(poses.T_MH.t, t)
    assert poses.pivot.tolist() == [1, 2, 3]


def test_bad_scans_are_refused():
    with pytest.raises(InputError, match="0 views"):
        circular_scan(0)
    with pytest.raises(InputError, match="direction"):
        table_angles(3, direction=2)
    with pytest.raises(ShapeError, match="one tilt each"):
        tilted_scan(5, lambda alpha: np.zeros(3))
    with pytest.raises(InputError, match="view 2"):
        tilted_scan(5, lambda alpha: np.where(np.arange(5) == 2, np.nan, 0.0))
    with pytest.raises(ShapeError, match="R_HT"):
        eq10_rotation(np.zeros(2), np.zeros(2), np.tile(R_HT_MOUNTED, (2, 1, 1)))
