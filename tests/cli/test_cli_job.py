"""The main job through the front door: files in, files out, exit codes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import tomopose as tp
from tomopose.cli.main import VERBS, app, run
from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.rotations import rotation_angle_between

MILLIMETRE = 1e-9
PIXEL = 1e-6


def verbs():
    return [word for info in app.registered_commands for word in [info.name]] + [g.name for g in app.registered_groups]


def test_from_observations_to_nine_formats_and_back(files):
    f = files.folder
    assert run(files.calibrate()) == 0
    calibration = tp.read_calibration(f / "cal" / "calibration.json")
    assert_allclose(calibration.T_HT.t, files.T_HT.t, atol=MILLIMETRE)
    assert rotation_angle_between(calibration.T_HT.R, files.T_HT.R) < 1e-9
    assert (f / "cal" / "report.html").stat().st_size > 1000

    words = ["matrices", "--calibration", f / "cal" / "calibration.json", "--poses", f / "poses.csv", "--quiet"]
    assert run([*map(str, words), "--out", str(f / "m.npz")]) == 0
    matrices = tp.read_matrices(f / "m.npz")
    wanted = eq5_matrices(files.scanner, T_HT=files.T_HT, T_MH=files.poses.T_MH, alpha=files.poses.alpha)
    x = np.random.default_rng(1).uniform(-10, 10, (20, 3))
    assert_allclose(matrices.project(x), replace(matrices, P=wanted).project(x), atol=PIXEL)

    assert run(["export", "--matrices", str(f / "m.npz"), "--out", str(f / "geometry"), "--quiet"]) == 0
    back = ["import-geometry", str(f / "geometry" / "rtk.xml"), "--side", str(f / "geometry" / "rtk.json"), "--quiet"]
    size = ["--n-u-px", str(files.scanner.n_u), "--n-v-px", str(files.scanner.n_v)]
    assert run([*back, *size, "--out", str(f / "back.npz")]) == 0
    assert_allclose(tp.read_matrices(f / "back.npz").project(x), matrices.project(x), atol=PIXEL)


def test_binned_scan(files):
    f = files.folder
    assert run(files.calibrate()) == 0
    words = ["matrices", "--calibration", str(f / "cal/calibration.json"), "--poses", str(f / "poses.csv"), "--quiet"]
    assert run([*words, "--out", str(f / "m.npz"), "--binning", "2"]) == 0
    assert tp.read_matrices(f / "m.npz").n_u == files.scanner.n_u // 2


def test_json_is_one_object_on_standard_output(files, capsys):
    assert run([*files.calibrate(), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["verdict"] == "trustworthy"
    assert shown["poses_used"] == len(files.poses)


def test_nothing_is_overwritten_without_force(files, capsys):
    assert run(files.calibrate()) == 0
    before = (files.folder / "cal" / "calibration.json").read_bytes()
    assert run(files.calibrate()) == 1
    assert "--force" in capsys.readouterr().err
    assert (files.folder / "cal" / "calibration.json").read_bytes() == before
    assert run([*files.calibrate(), "--force"]) == 0


def test_same_input_same_numbers(files):
    numbers = []
    for out in ("a", "b"):
        assert run(files.calibrate(out)) == 0
        content = files.json(f"{out}/calibration.json")
        content["provenance"].pop("time_utc")
        numbers.append(content)
    assert numbers[0] == numbers[1]


def test_provenance_names_inputs_without_folders(files):
    assert run(files.calibrate()) == 0
    inputs = files.json("cal/calibration.json")["provenance"]["inputs"]
    assert set(inputs) == {"scanner.json", "poses.csv", "observations.csv"}
    assert all(len(digest) == 64 for digest in inputs.values())


@pytest.mark.parametrize("verb", verbs())
def test_every_verb_explains_itself_with_an_example(verb, capsys):
    assert run([verb, "--help"]) == 0
    shown = capsys.readouterr().out
    assert "Example" in shown or "COMMAND" in shown


def test_version_and_verbs(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("tomopose ")
    assert len(verbs()) == len(VERBS)


@pytest.mark.parametrize("words", [["calibrte"], ["calibrate"], ["export", "--to"], ["plan", "nothing"]])
def test_usage_errors_are_exit_code_2(words, capsys):
    assert run(words) == 2
    assert capsys.readouterr().err


def test_doctor_lists_engines_and_install_lines(capsys):
    assert run(["doctor", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert {"cpu", "rtk", "astra"} <= set(shown["engines"])
    assert shown["extras"]["recon"]["install"].startswith("pip install")


def test_an_alternative_that_fits_better_is_exit_code_3(files, capsys):
    """Rows exchanged among poses: the files are well formed, but the reading of them is wrong."""
    wrong = files.folder / "signs.csv"
    angles = np.degrees(files.poses.T_MH.angles) * [-1, -1, -1]
    poses = tp.PoseSequence.from_table(files.poses.T_MH.t, angles, pose_id=files.poses.pose_id, alpha=files.poses.alpha)
    tp.write_poses(wrong, poses)
    words = ["diagnose", "--scanner", str(files.folder / "scanner.json"), "--poses", str(wrong)]
    assert run([*words, "--observations", str(files.folder / "observations.csv"), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["advice"]
    assert run(files.calibrate(poses=wrong)) == 3
    assert files.json("cal/calibration.json")["verdict"] != "trustworthy"


def test_reports_from_what_a_folder_holds(files, capsys):
    f = files.folder
    assert run(files.calibrate()) == 0
    poses = ["--poses", str(f / "poses.csv")]
    assert run(["report", str(f / "cal"), *poses, "--out", str(f / "again.html"), "--quiet"]) == 0
    assert "Trustworthy" in (f / "again.html").read_text(encoding="utf-8")
    (f / "cal" / "calibration.json").unlink()
    assert run(["report", str(f / "cal"), "--out", str(f / "observations.html"), "--quiet"]) == 0
    assert "30" in (f / "observations.html").read_text(encoding="utf-8")
    assert run(["report", str(f / "nowhere"), "--out", str(f / "none.html")]) == 1
    assert "holds no calibration.json" in capsys.readouterr().err
    assert not (f / "none.html").exists()


def test_plans_are_written_with_their_command_list(files, capsys):
    f = files.folder
    words = ["plan", "poses", "--grid", "2", "--table-angles-deg", "0,90", "--commands", "pi-gcs", "--json"]
    assert run([*words, "--out", str(f / "plan.csv")]) == 0
    assert json.loads(capsys.readouterr().out)["poses"] == 112
    assert len(tp.read_poses(f / "plan.csv")) == 112
    assert (f / "plan.gcs").read_text().count("MOV ") == 112
    assert run(["plan", "scan", "--shape", "sine", "--views", "21", "--quiet", "--out", str(f / "scan.csv")]) == 0
    scan = tp.read_poses(f / "scan.csv")
    assert len(scan) == 21
    assert np.degrees(rotation_angle_between(np.eye(3), scan.T_MH.R)).max() <= 5.0 + 1e-9


def test_a_plan_that_loses_the_ball_is_refused(files, capsys):
    words = ["plan", "poses", "--scanner", str(files.folder / "scanner.json"), "--half-range-mm", "60"]
    assert run([*words, "--out", str(files.folder / "far.csv")]) == 1
    assert "field of view" in capsys.readouterr().err
    assert not (files.folder / "far.csv").exists()
