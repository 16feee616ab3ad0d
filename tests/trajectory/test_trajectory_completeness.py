"""Tuy-Smith completeness against what is known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.trajectory.completeness import object_points, plane_normals, source_path, tuy_completeness
from tomopose.trajectory.scan import circular_scan, tilted_scan
from tomopose.trajectory.tilt import eq11_triangle


def circle(radius: float, n: int = 720) -> np.ndarray:
    a = 2 * np.pi * np.arange(n) / n
    return radius * np.column_stack([np.cos(a), np.sin(a), np.zeros(n)])


@pytest.mark.parametrize("z", [0.0, 10.0, 60.0, 300.0])
def test_a_circle_misses_the_flat_planes_through_a_point_above_it(z):
    # A plane through (0, 0, z) whose normal leans by theta meets the circle of radius R if R tan(theta) >= z;
    # normals spread evenly over the half sphere, so the share is cos(theta_0) = R / hypot(R, z).
    share = tuy_completeness(circle(300.0), np.array([[0.0, 0.0, z]]), n_planes=20000).share[0]
    assert share == pytest.approx(300 / math.hypot(300, z), abs=2e-4)


def test_two_circles_at_right_angles_are_complete():
    a = circle(300.0)
    both = np.vstack([a, a[:, [0, 2, 1]]])
    points = object_points(60, -60, 60, spacing=20)
    assert tuy_completeness(both, points).share.min() == 1.0
    assert tuy_completeness(a, points).share.min() < 1.0


def test_the_tilted_scan_is_more_complete_than_the_circular_one(scanner, T_HT):
    points = object_points(15, -15, 15, spacing=5)
    result = []
    for poses in (circular_scan(140), tilted_scan(140, eq11_triangle, R_HT=T_HT.R)):
        P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=poses.alpha)
        result.append(tuy_completeness(source_path(P), points))
    circular, tilted = result
    assert tilted.share.min() == 1.0
    assert circular.mean < tilted.mean
    assert abs(circular.points[circular.worst, 2]) == 15


def test_the_source_path_of_a_circular_scan_is_a_circle(scanner, T_HT):
    poses = circular_scan(9)
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=poses.alpha)
    s = source_path(P)
    np.testing.assert_allclose(np.hypot(s[:, 0], s[:, 1]), scanner.d_SR, rtol=1e-12)
    np.testing.assert_allclose(s[0], [scanner.d_SR, 0, 0], atol=1e-9)
    matrices = ProjectionMatrices(P=P, n_u=5, n_v=5, p_u=1, p_v=1, pose_id=poses.pose_id)
    np.testing.assert_allclose(source_path(matrices), s, atol=1e-9)


def test_normals_are_unit_and_even():
    n = plane_normals(5000)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(n.T @ n / 5000, np.eye(3) / 3, atol=1e-3)


def test_object_points_stay_inside_and_hold_the_origin():
    x = object_points(10, -4, 9, spacing=2.5)
    assert np.hypot(x[:, 0], x[:, 1]).max() <= 10
    assert x[:, 2].min() >= -4
    assert x[:, 2].max() <= 9
    assert (np.abs(x).sum(axis=1) == 0).any()


def test_bad_input_is_refused():
    with pytest.raises(ShapeError, match="path"):
        tuy_completeness(np.zeros(3), np.zeros((1, 3)))
    with pytest.raises(InputError, match="not finite"):
        tuy_completeness(circle(3), np.array([[np.nan, 0, 0]]))
    with pytest.raises(InputError, match="no points"):
        object_points(-1, 0, 1, spacing=1)
    with pytest.raises(InputError, match="at least one plane"):
        tuy_completeness(circle(3), np.zeros((1, 3)), n_planes=0)
