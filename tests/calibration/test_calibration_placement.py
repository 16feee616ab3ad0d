"""A ball off the panel or at the focal spot is named; directions of many balls are named by their groups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_cases import SCANNER, mixed_poses, observe, paper_poses

from tomopose.calibration.rigid.observability import _words
from tomopose.calibration.solve import calibrate
from tomopose.errors import InputError, UnitError


def test_a_centre_off_the_panel_is_named_with_its_pose():
    poses = mixed_poses(n=16)
    observed = observe(poses)
    x = observed.x_D.copy()
    x[3] = [5000.0, 900.0]
    with pytest.raises(InputError, match=r"1 of 16 centres are not on the panel: that of pose '3' is \(5000, 900\) px"):
        calibrate(SCANNER, poses, replace(observed, x_D=x))


def test_positions_that_place_the_ball_at_the_focal_spot_are_named_in_their_unit():
    poses = paper_poses(2)
    metres = replace(poses, T_MH=replace(poses.T_MH, t=poses.T_MH.t / 1000.0))
    with pytest.raises(UnitError, match=r"look like metres \(m\).*at the focal spot"):
        calibrate(SCANNER, metres, observe(poses))


def test_a_direction_of_many_balls_is_one_short_phrase():
    balls = [f"t[{b}]_{c}" for b in range(10) for c in "xyz"]
    names = (*(f"w_HT_{c}" for c in "xyz"), *(f"t_HT_{c}" for c in "xyz"), *balls)
    v = np.concatenate([np.zeros(3), np.ones(33)])
    assert _words(names, v) == "t_HT and the places of the balls together"
    assert _words(("t_HT_x", "d_SR"), np.array([1.0, -0.5])).startswith("1 t_HT_x - 0.5 d_SR")
