"""Radiographs through the front door: detect, and what is said of a missing flat field and of a wrong diameter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run
from tomopose.cli.simulated import RADIOGRAPHS, write_run
from tomopose.geometry.frames import Frame

DIAMETER = 8.0


@pytest.fixture(scope="module")
def radiographs(tmp_path_factory):
    """Eight small radiographs of a ball, with scanner.json and poses.csv."""
    folder = tmp_path_factory.mktemp("run")
    scanner = tp.Scanner(d_SD=1500.0, d_SR=555.0, p_u=0.4, p_v=0.42, u_0=90.3, v_0=101.8, n_u=181, n_v=203)
    poses = tp.PoseSequence.from_table(
        [[0, 0, 0], [4, 0, 0], [-4, 0, 0], [0, 4, 0], [0, 0, 4], [3, 3, -3], [-3, 2, 3], [2, -3, 1]],
        [[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5], [-5, 2, 0], [2, 2, -5], [0, -5, 3], [4, 4, 4]],
        pose_id=[f"p{k}" for k in range(8)],
    )
    T_HT = tp.RigidTransform.from_angles([0.007, -0.005, 3.126], [1.0, -0.5, 1.0], source=Frame.H, target=Frame.T)
    made = tp.simulate_ball_run(scanner, T_HT=T_HT, t=[2.0, -3.0, 4.0], poses=poses, ball_diameter=DIAMETER, seed=3)
    write_run(folder, made)
    return folder


def words(folder, verb, out, *more):
    return [
        verb,
        "--scanner",
        str(folder / "scanner.json"),
        "--images",
        str(folder / RADIOGRAPHS),
        "--poses",
        str(folder / "poses.csv"),
        "--out",
        str(out),
        *more,
    ]


@pytest.mark.slow
def test_detect_writes_a_row_for_each_radiograph_and_names_the_missing_flat_field(radiographs, tmp_path, capsys):
    out = tmp_path / "observations.csv"
    assert run(words(radiographs, "detect", out, "--ball-diameter-mm", str(DIAMETER))) == 0
    said = capsys.readouterr()
    assert "8 of 8 balls measured" in said.out
    assert "no flat field given" in said.err
    found = tp.read_observations(out)
    assert found.pose_id == tp.read_poses(radiographs / "poses.csv").pose_id
    assert found.seen.all()


@pytest.mark.slow
def test_diameter_that_contradicts_the_calibration_stops_before_anything_is_written(radiographs, tmp_path, capsys):
    wrong = tmp_path / "wrong"
    assert run(words(radiographs, "calibrate", wrong, "--ball-diameter-mm", "7.6", "--quiet")) == 1
    assert "than a ball of 7.6 mm would throw" in capsys.readouterr().err
    assert not wrong.exists()
    # the right one is calibrated, if doubtful with so few poses
    assert run(words(radiographs, "calibrate", tmp_path / "right", "--ball-diameter-mm", str(DIAMETER), "--quiet")) == 3
    assert (tmp_path / "right" / "calibration.json").exists()


@pytest.mark.slow
def test_the_diameter_has_no_default(radiographs, tmp_path, capsys):
    for verb in ("detect", "calibrate"):
        assert run(words(radiographs, verb, tmp_path / "out")) == 2
        assert "--ball-diameter-mm" in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
    assert run(words(radiographs, "detect", tmp_path / "out", "--ball-diameter-mm", "0=8,x")) == 2
    assert "ID=MM" in capsys.readouterr().err


def test_balls_of_two_sizes_and_predicted_places(radiographs, tmp_path):
    """The pose table names the ball of each row; a table of places limits the search to regions."""
    poses, out = tmp_path / "poses.csv", tmp_path / "observations.csv"
    sequence = tp.read_poses(radiographs / "poses.csv")
    tp.write_poses(poses, replace(sequence, ball_id=np.full(len(sequence), 4)))
    command = words(radiographs, "detect", out, "--ball-diameter-mm", f"4={DIAMETER},9={3 * DIAMETER}", "--quiet")
    command[command.index("--poses") + 1] = str(poses)
    assert run(command) == 0
    by_size = tp.read_observations(out)
    assert by_size.seen.all()
    again = words(radiographs, "detect", tmp_path / "b.csv", "--ball-diameter-mm", str(DIAMETER), "--quiet")
    assert run([*again, "--predicted", str(out)]) == 0
    predicted = tp.read_observations(tmp_path / "b.csv")
    assert np.abs(predicted.x_D - by_size.x_D).max() < 0.01
