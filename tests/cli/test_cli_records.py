"""compare and monitor through the front door: the answer first, exit code 3 on a change, nothing half done."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import tomopose as tp
from tomopose.cli.main import run

SIGMA = 0.01


@pytest.fixture
def days(files):
    """Calibrations of the same run on other days, with other noise: a function of (name, seed, changed files)."""

    def calibrated(name, seed, shift=0.0, **changed):
        rng = np.random.default_rng(seed)
        x = files.x_D + rng.normal(0, SIGMA, files.x_D.shape)
        poses = replace(files.poses, T_MH=replace(files.poses.T_MH, t=files.poses.T_MH.t - [shift, 0.0, 0.0]))
        observed = tp.BallObservations.from_sigma(x, SIGMA, pose_id=files.poses.pose_id)
        tp.write_observations(files.folder / f"{name}.csv", observed, force=True)
        tp.write_poses(files.folder / f"{name}-poses.csv", poses, force=True)
        own = {"observations": files.folder / f"{name}.csv", "poses": files.folder / f"{name}-poses.csv"}
        assert run(files.calibrate(name, **own, **changed)) in (0, 3)
        return files.folder / name / "calibration.json"

    return calibrated


def said(words, capsys):
    capsys.readouterr()
    code = run([*map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_two_days_of_an_unchanged_machine_agree(files, days, capsys):
    a, b = days("a", 1), days("b", 2)
    code, shown = said(["compare", a, b, "--out", files.folder / "change.html"], capsys)
    assert code == 0
    assert shown["mount_changed"] is False
    assert shown["changed"] is False
    assert_allclose(shown["difference"], 0, atol=0.05)
    assert (files.folder / "change.html").stat().st_size > 1000


def test_a_moved_mount_is_exit_code_3(days, capsys):
    code, shown = said(["compare", days("a", 1), days("b", 2, shift=0.2)], capsys)
    assert code == 3
    assert shown["mount_changed"] is True


def test_a_changed_scanner_file_is_named_first_and_the_mount_is_not_tested(files, days, capsys):
    a = days("a", 1)
    document = files.json("scanner.json")
    path = files.table("other.json", json.dumps({**document, "d_SR_mm": document["d_SR_mm"] + 0.5}))
    b = days("b", 2, scanner=path)
    code, shown = said(["compare", a, b, "--out", files.folder / "change.html"], capsys)
    assert code == 3
    assert shown["words"][0].startswith("scanner.json changed: d_SR_mm 310 -> 310.5")
    assert shown["mount_changed"] is False
    assert shown["p_mount"] is None
    assert "different scanners" in (files.folder / "change.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_history_grows_once_for_each_run_and_answers_first(files, days, capsys):
    history, page = files.folder / "history.jsonl", files.folder / "history.html"
    paths = [days(f"d{k}", k) for k in range(4)]
    for k, path in enumerate(paths):
        words = ["monitor", history, "--add", path, "--label", f"d{k}", "--machine", "CT 1", "--out", page]
        code, shown = said(words, capsys)
        assert code == 0
        assert shown["calibrations"] == k + 1
        assert page.exists() == (k >= 2)
    assert shown["words"][0].startswith("no alarm: 4 calibrations agree")
    entry = shown["last"]
    assert entry["scanner"]["d_SR_mm"] == files.scanner.d_SR
    assert entry["machine"] == "CT 1"
    assert set(entry["inputs"]) >= {"scanner.json", "d3.csv", "d3-poses.csv"}
    assert len(entry["digest"]) == 64
    assert "No alarm" in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_run_is_added_once_and_a_failing_command_adds_nothing(files, days, capsys):
    history = files.folder / "history.jsonl"
    a, b = days("a", 1), days("b", 2)
    assert run(["monitor", str(history), "--add", str(a), "--label", "a", "--machine", "one", "--quiet"]) == 0
    before = history.read_bytes()
    again = files.folder / "again.json"
    shutil.copy(a, again)
    for words, message in (
        (["--add", again], "in the history already, as line 1 (a)"),
        (["--add", b, "--machine", "two"], "that of machine 'one'"),
        (["--add", b, "--baseline", "never"], "no run labelled 'never'"),
        (["--add", files.folder / "absent.json"], "absent.json"),
    ):
        assert run(["monitor", *map(str, [history, *words])]) == 1
        assert message in capsys.readouterr().err
        assert history.read_bytes() == before
    days("c", 3)
    for k in (b, files.folder / "c" / "calibration.json"):
        blocked = ["monitor", str(history), "--add", str(k), "--quiet"]
        if k != b:
            blocked += ["--out", str(files.folder / "a.csv" / "below a file.html")]
            before = history.read_bytes()
            assert run(blocked) == 1
            assert history.read_bytes() == before
        else:
            assert run(blocked) == 0


@pytest.fixture
def stepped(shared_data, tmp_path):
    path = tmp_path / "history.jsonl"
    shutil.copy(shared_data / "cases" / "monitor-history" / "history.jsonl", path)
    return path


def test_a_step_of_the_mount_is_an_alarm_that_names_number_and_run(stepped, shared_data, capsys):
    expected = json.loads((shared_data / "cases" / "monitor-history" / "expected.json").read_text())
    before = stepped.read_bytes()
    page = stepped.parent / "history.html"
    code, shown = said(["monitor", stepped, "--out", page], capsys)
    assert code == expected["exit_code"] == 3
    (alarm,) = shown["alarms"]
    assert alarm["parameter"] == expected["alarm"]["parameter"]
    assert alarm["from_label"] == expected["alarm"]["from_label"]
    assert alarm["step_mm"] == pytest.approx(expected["alarm"]["step_mm"], abs=3 * alarm["u_mm"])
    assert stepped.read_bytes() == before
    assert run(["monitor", str(stepped)]) == 3
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("alarm: t_HT_x changed by +0.0049(2) mm from d10 on")
    assert ">Alarm<" in page.read_text(encoding="utf-8")


def test_after_a_repair_the_baseline_begins_anew(stepped, capsys):
    assert said(["monitor", stepped, "--baseline", "d10"], capsys)[0] == 0
    code, shown = said(["monitor", stepped, "--baseline", "d0:d9"], capsys)
    assert code == 3
    assert [a["parameter"] for a in shown["alarms"]] == ["t_HT_x"]
