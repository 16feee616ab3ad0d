"""The paper's grid of calibration poses (sec. 5, fig. 5)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tomopose.errors import InputError
from tomopose.geometry.rotations import R_x, R_y, R_z, rotation_angle_between
from tomopose.trajectory.pose_grid import grid_positions, pose_grid, seven_orientations


@pytest.mark.parametrize(("n", "poses"), [(2, 56), (3, 189), (5, 875)])
def test_the_paper_counts_n_cubed_times_seven_poses(n, poses):
    grid = pose_grid(n)
    assert len(grid) == poses
    assert grid.source == "set"
    assert np.abs(grid.T_MH.t).max(axis=0).tolist() == [10.0, 10.0, 10.0]


def test_seven_single_axis_rotations_of_five_degrees_at_each_position():
    grid = pose_grid(2)
    a = math.radians(5)
    expected = [np.eye(3), R_x(a), R_x(-a), R_y(a), R_y(-a), R_z(a), R_z(-a)]
    for k in range(8):
        assert np.ptp(grid.T_MH.t[7 * k : 7 * k + 7], axis=0).max() == 0
        assert rotation_angle_between(np.array(expected), grid.T_MH.R[7 * k : 7 * k + 7]).max() < 1e-15


def test_the_third_party_sequence_is_this_grid(shared_data):
    from tomopose.io import read_poses

    theirs = read_poses(shared_data / "ball-radiographs-gvxr" / "poses.csv")
    ours = pose_grid(2)
    np.testing.assert_allclose(ours.T_MH.matrix, theirs.T_MH.matrix, atol=1e-15)


def test_positions_are_evenly_spaced_and_may_differ_by_axis():
    x = grid_positions((3, 1, 2), (4.0, 9.0, 1.0))
    assert x.shape == (6, 3)
    assert sorted(set(x[:, 0])) == [-4, 0, 4]
    assert set(x[:, 1]) == {0.0}
    assert sorted(set(x[:, 2])) == [-1, 1]


def test_the_grid_is_repeated_at_each_table_angle():
    grid = pose_grid(2, table_angles=np.radians([0, 90, 180]))
    assert len(grid) == 3 * 56
    assert grid.alpha[55] == 0
    assert grid.alpha[56] == math.pi / 2
    np.testing.assert_array_equal(grid.T_MH.matrix[:56], grid.T_MH.matrix[112:])
    assert len(set(grid.pose_id)) == 168


def test_tilts_may_differ_by_axis_and_orientations_be_given():
    assert np.abs(seven_orientations((0.1, 0.2, 0.3))).max(axis=0).tolist() == [0.1, 0.2, 0.3]
    assert len(pose_grid(1, orientations=np.array([[0.1, 0.1, 0.0], [0.0, 0.1, 0.1]]))) == 2


def test_bad_grids_are_refused():
    with pytest.raises(InputError, match="whole numbers"):
        pose_grid(0)
    with pytest.raises(InputError, match="whole numbers"):
        pose_grid(2.5)
    with pytest.raises(InputError, match="range of 0 or more"):
        pose_grid(2, half_range=-1)
    with pytest.raises(InputError, match=r"angles \(m, 3\)"):
        pose_grid(2, orientations=np.zeros((2, 4)))
