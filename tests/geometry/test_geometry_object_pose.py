"""The rigid pose of an object is found from images of its points, and taken out."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.frames import Frame
from tomopose.geometry.object_pose import object_pose, pixels, without_object_pose
from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.geometry.transforms import RigidTransform

W, T = np.array([0.3, -0.2, 0.45]), np.array([2.0, -3.5, 1.2])


@pytest.fixture
def P(scanner, T_HT):
    still = RigidTransform(R=np.tile(np.eye(3), (5, 1, 1)), t=np.zeros((5, 3)), source=Frame.M, target=Frame.H)
    return eq5_matrices(scanner, T_HT=T_HT, T_MH=still, alpha=np.array([0.0, 0.9, 2.1, 3.3, 5.0]))


def test_a_large_motion_is_found_to_rounding(P):
    x = np.array([4.0, -2.0, 7.0]) + 12.0 * BOX_CORNERS
    R, t = object_pose(P, pixels(P, x @ exp_rotation(W).T + T), x)
    assert np.linalg.norm(log_rotation(R @ exp_rotation(W).T)) < 1e-11
    assert np.abs(t - T).max() < 1e-9


def test_a_motion_of_the_object_leaves_no_difference(P):
    moved = P @ np.block([[exp_rotation(W), T[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    assert np.abs(without_object_pose(moved, P, 12.0 * BOX_CORNERS)).max() < 1e-8


def test_points_in_a_line_leave_a_turn_open_and_no_difference(P):
    x = np.linspace(-1, 1, 4)[:, None] * [3.0, 5.0, 9.0]
    moved = P @ np.block([[exp_rotation(0.1 * W), T[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    assert np.abs(without_object_pose(moved, P, x)).max() < 1e-7


def test_what_no_motion_explains_stays(P):
    bent = P.copy()
    bent[2, 0] += 0.5 * bent[2, 2]  # half a pixel along u in one of five views
    left = without_object_pose(bent, P, 12.0 * BOX_CORNERS)
    assert 0.2 < np.sqrt(np.mean(left[2, :, 0] ** 2)) < 0.5
