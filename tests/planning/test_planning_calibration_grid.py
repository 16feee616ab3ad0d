"""The default calibration plan: compound rotations, two table angles, the first pose again at the end."""

from __future__ import annotations

import json

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run
from tomopose.trajectory.pose_grid import calibration_grid


def test_the_default_plan_has_the_papers_number_of_images_at_two_angles_and_closes() -> None:
    plan = calibration_grid()
    assert len(plan) == 190
    assert sorted(set(np.degrees(plan.alpha).round(6))) == [0.0, 90.0]
    # the table turns once there and once back
    assert np.count_nonzero(np.diff(plan.alpha)) == 2
    np.testing.assert_array_equal(plan.T_MH.R[0], plan.T_MH.R[-1])
    np.testing.assert_array_equal(plan.T_MH.t[0], plan.T_MH.t[-1])


def test_most_poses_turn_about_three_axes_at_once() -> None:
    from tomopose.geometry.rotations import log_rotation

    w = log_rotation(calibration_grid().T_MH.R)
    assert np.mean((np.abs(w) > 0.05).all(axis=1)) > 0.8


@pytest.mark.parametrize(("words", "angles", "count"), [([], 2, 190), (["--paper"], 1, 189)])
def test_plan_poses_turns_the_table_unless_the_papers_plan_is_asked_for(tmp_path, capsys, words, angles, count) -> None:
    out = tmp_path / "poses.csv"
    assert run(["plan", "poses", "--out", str(out), "--json", *words]) == 0
    assert json.loads(capsys.readouterr().out)["poses"] == count
    assert len(set(tp.read_poses(out).alpha)) == angles


def test_the_papers_plan_takes_no_table_angles(tmp_path) -> None:
    words = ["plan", "poses", "--paper", "--table-angles-deg", "0,90", "--out", str(tmp_path / "poses.csv")]
    assert run(words) == 2
