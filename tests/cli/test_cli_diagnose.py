"""`diagnose` takes what `calibrate` takes, answers first, and advises only what fits."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run
from tomopose.geometry.projection import project_ball


def said(words, capsys):
    capsys.readouterr()
    code = run([*map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_data_that_fit_as_declared_are_exit_code_0_and_said_first(files, capsys):
    words = files.calibrate()
    words = ["diagnose", *words[words.index("--scanner") :], "--ball-diameter-mm", "8", "--free", "d_SR"]
    assert run(words) == 0
    assert capsys.readouterr().out.splitlines()[0] == "the data fit as they were declared"


def test_a_scanner_that_moves_is_an_arrangement_of_diagnose_too(files, capsys):
    still = replace(files.poses, alpha=np.zeros(len(files.poses)))
    x = tp.read_observations(files.folder / "observations.csv")
    centres = project_ball(files.scanner, T_HT=files.T_HT, T_MH=still.T_MH, t=[6.0, -4.0, 11.0], alpha=still.alpha)
    rows = [still.pose_id.index(i) for i in x.pose_id]
    tp.write_observations(files.folder / "still.csv", replace(x, x_D=centres[rows]))
    tp.write_poses(files.folder / "inverse.csv", tp.inverse_poses(still))
    words = ["diagnose", "--scanner", files.folder / "scanner.json", "--poses", files.folder / "inverse.csv"]
    words += ["--observations", files.folder / "still.csv"]
    code, shown = said([*words, "--arrangement", "moving-scanner"], capsys)
    assert (code, shown["leading"]) == (0, [])
    code, shown = said(words, capsys)
    assert code == 3
    assert "pose inverted" in shown["leading"]
    assert shown["answer"].startswith("another convention fits")


def test_nothing_fits_is_an_answer_with_exit_code_3(files, capsys):
    x = tp.read_observations(files.folder / "observations.csv")
    shuffled = x.x_D[np.random.default_rng(0).permutation(len(x))]
    tp.write_observations(files.folder / "shuffled.csv", replace(x, x_D=shuffled))
    words = ["diagnose", "--scanner", files.folder / "scanner.json", "--poses", files.folder / "poses.csv"]
    code, shown = said([*words, "--observations", files.folder / "shuffled.csv"], capsys)
    assert code == 3
    assert shown["nothing_fits"]
    assert shown["leading"] == []
    assert shown["answer"] == "nothing fits"


@pytest.mark.slow
def test_a_turning_table_alone_has_its_own_method(tmp_path, capsys):
    """Refused with a pointer without it; calibrated, diagnosed and made into matrices with it."""
    rng = np.random.default_rng(2)
    alpha = np.tile(np.linspace(0, 2 * np.pi, 24, endpoint=False), 3)
    ball = np.repeat(np.arange(3), 24)
    zero = np.zeros((72, 3))
    scanner = tp.Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)
    poses = tp.PoseSequence.from_table(zero, zero, alpha=alpha, ball_id=ball)
    x = np.array([[14.0, -3.0, -20.0], [-5.0, 11.0, 2.0], [3.0, -13.0, 18.0]])
    real = replace(scanner, u_0=739.0, eta=4e-3)
    mount = tp.RigidTransform.identity(tp.Frame.H, tp.Frame.T)
    seen = project_ball(real, T_HT=mount, T_MH=poses.T_MH, t=x[ball], alpha=alpha)
    observed = tp.BallObservations.from_sigma(seen + rng.normal(0, 0.015, seen.shape), 0.015, pose_id=poses.pose_id)
    tp.write_scanner(tmp_path / "scanner.json", scanner)
    tp.write_poses(tmp_path / "poses.csv", poses)
    tp.write_observations(tmp_path / "observations.csv", observed)
    given = ["--scanner", tmp_path / "scanner.json", "--poses", tmp_path / "poses.csv"]
    given = [str(w) for w in [*given, "--observations", tmp_path / "observations.csv"]]
    assert run(["calibrate", *given, "--out", str(tmp_path / "no")]) == 1
    assert "--arrangement turntable" in capsys.readouterr().err
    for k, option in enumerate((["--arrangement", "turntable"], ["--method", "turntable"])):
        assert run(["calibrate", *given, *option, "--out", str(tmp_path / f"cal{k}"), "--quiet"]) == 0
        cal = tp.read_calibration(tmp_path / f"cal{k}" / "calibration.json")
        found = {p.name: p for p in cal.parameters}
        assert abs(found["u_0"].value - 739.0) < 5 * found["u_0"].u < 0.1
        assert abs(found["eta"].value - 4e-3) < 5 * found["eta"].u < 1e-4
    code, shown = said(["diagnose", *given, "--arrangement", "turntable"], capsys)
    assert (code, shown["leading"]) == (0, [])
    assert "circular scan" in (tmp_path / "cal0" / "calibration.json").read_text(encoding="utf-8")


def test_the_part_of_a_run_before_or_from_a_pose_on_is_calibrated(files, capsys):
    middle = files.poses.pose_id[len(files.poses) // 2]
    n = len(tp.read_observations(files.folder / "observations.csv"))
    used = []
    for option in ("--until-pose", "--from-pose"):
        words = files.calibrate(option.strip("-"))
        assert run([*words, option, middle, "--quiet"]) in (0, 3)
        cal = tp.read_calibration(files.folder / option.strip("-") / "calibration.json")
        used += [*cal.pose_id, *cal.outliers]
        assert (middle in cal.pose_id) == (option == "--from-pose")
    assert len(used) == len(set(used)) <= n
    assert run([*files.calibrate("never"), "--until-pose", "no such pose"]) == 2
