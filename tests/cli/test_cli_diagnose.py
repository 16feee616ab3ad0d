"""`diagnose` takes what `calibrate` takes, answers first, and advises only what fits."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

import tomopose as tp
from tomopose.cli.main import run


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
    from tomopose.geometry.projection import project_ball

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
