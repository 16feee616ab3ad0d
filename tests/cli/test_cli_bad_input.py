"""Bad input never gives a number: exit code 1, a message that names what is wrong, nothing written."""

from __future__ import annotations

import json
import os
import sys

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run

HEAD = "pose_id,u_px,v_px,sigma_u_px,sigma_v_px\n"


def rows(files):
    return [f"{i},{u},{v},0.01,0.01\n" for i, (u, v) in zip(files.poses.pose_id, files.x_D.tolist(), strict=True)]


def refused(files, capsys, words, *parts):
    assert run(words) == 1
    shown = capsys.readouterr().err
    for part in parts:
        assert part in shown, f"{part!r} is not in {shown!r}"
    assert "Traceback" not in shown
    assert not (files.folder / "cal" / "calibration.json").exists()


OBSERVATIONS = {
    "an unknown pose": (lambda r: [*r, "p999,1,1,0.01,0.01\n"], ["p999", "not in the pose table"]),
    "a pose twice": (lambda r: [r[0], *r], ["p0", "more than once"]),
    "not a number": (lambda r: ["p0,nan,5,0.01,0.01\n", *r[1:]], ["row 1", "u_px", "nan"]),
    "a blank cell": (lambda r: ["p0,,5,0.01,0.01\n", *r[1:]], ["row 1", "u_px", "blank"]),
    "too few poses": (lambda r: r[:3], ["only 3 poses"]),
    "a sigma of zero": (lambda r: ["p0,1,5,0,0.01\n", *r[1:]], ["sigma_u_px"]),
}


@pytest.mark.parametrize("what", OBSERVATIONS)
def test_observations(files, capsys, what):
    change, parts = OBSERVATIONS[what]
    path = files.table("bad.csv", HEAD + "".join(change(rows(files))))
    refused(files, capsys, files.calibrate(observations=path), *parts)


def test_unknown_column(files, capsys):
    path = files.table("bad.csv", HEAD.replace("v_px", "w_px") + "".join(rows(files)))
    refused(files, capsys, files.calibrate(observations=path), "w_px")


def poses_with(files, positions=None, angles=None, head=None, comment=""):
    n = len(files.poses)
    x = files.poses.T_MH.t if positions is None else positions
    a = np.degrees(files.poses.T_MH.angles) if angles is None else angles
    head = head or "pose_id,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg"
    lines = [f"p{k}," + ",".join(repr(float(v)) for v in (*x[k], *a[k])) + "\n" for k in range(n)]
    return files.table("bad_poses.csv", comment + head + "\n" + "".join(lines))


def test_radians_where_degrees_belong(files, capsys):
    path = poses_with(files, angles=files.poses.T_MH.angles)
    refused(files, capsys, files.calibrate(poses=path), "rad")


def test_metres_where_millimetres_belong(files, capsys):
    path = poses_with(files, positions=files.poses.T_MH.t / 1000)
    refused(files, capsys, files.calibrate(poses=path), "metres")


def test_column_without_unit(files, capsys):
    path = poses_with(files, head="pose_id,x,y_mm,z_mm,rx_deg,ry_deg,rz_deg")
    refused(files, capsys, files.calibrate(poses=path), "x_mm")


def test_unknown_convention(files, capsys):
    path = poses_with(files, comment="# convention: euler\n")
    refused(files, capsys, files.calibrate(poses=path), "euler", "pi-hexapod")


def test_poses_without_rotation(files, capsys, scanner, T_HT):
    still = tp.PoseSequence.from_table(files.poses.T_MH.t, np.zeros((len(files.poses), 3)), pose_id=files.poses.pose_id)
    x_D = project(scanner, T_HT, still)
    tp.write_poses(files.folder / "still.csv", still)
    tp.write_observations(
        files.folder / "still_obs.csv", tp.BallObservations.from_sigma(x_D, 0.01, pose_id=still.pose_id)
    )
    words = files.calibrate(poses=files.folder / "still.csv", observations=files.folder / "still_obs.csv")
    refused(files, capsys, words, "t_HT", "rotat")


def test_rotations_about_one_axis_only(files, capsys, scanner, T_HT, rng):
    angles = np.zeros((len(files.poses), 3))
    angles[:, 0] = rng.uniform(-6, 6, len(files.poses))
    one = tp.PoseSequence.from_table(files.poses.T_MH.t, angles, pose_id=files.poses.pose_id)
    tp.write_poses(files.folder / "one.csv", one)
    x_D = project(scanner, T_HT, one)
    tp.write_observations(files.folder / "one_obs.csv", tp.BallObservations.from_sigma(x_D, 0.01, pose_id=one.pose_id))
    words = files.calibrate(poses=files.folder / "one.csv", observations=files.folder / "one_obs.csv")
    refused(files, capsys, words, "axis")


def project(scanner, T_HT, poses):
    from tomopose.geometry.projection import project_ball

    return project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=[6.0, -4.0, 11.0])


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"d_SR_mm": 1300}, ["behind the detector"]),
        ({"schema": "tomopose/scanner/2"}, ["newer"]),
        ({"schema": "tomopose/poses/1"}, ["tomopose/scanner/1"]),
        ({"d_SD": 1200}, ["d_SD"]),
        ({"u_0_px": None}, ["u_0_px"]),
    ],
)
def test_scanner_file(files, capsys, change, parts):
    content = {**files.json("scanner.json"), **change}
    path = files.table("bad.json", json.dumps({k: v for k, v in content.items() if v is not None}))
    refused(files, capsys, files.calibrate(scanner=path), *parts)


def test_scanner_file_that_is_no_json(files, capsys):
    refused(files, capsys, files.calibrate(scanner=files.table("bad.json", "{")), "no JSON")


def test_missing_files_are_named(files, capsys):
    for name in ("scanner", "poses", "observations"):
        refused(files, capsys, files.calibrate(**{name: files.folder / "nowhere.csv"}), "nowhere.csv")


def test_errors_as_json(files, capsys):
    assert run([*files.calibrate(poses=files.folder / "nowhere.csv"), "--json"]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["kind"] == "FileError"
    assert error["exit_code"] == 1


@pytest.mark.skipif(sys.platform == "win32", reason="/dev/full is a Linux device")
def test_an_output_folder_that_cannot_be_made(files, capsys):
    blocked = files.table("blocked", "a file, not a folder")
    refused(files, capsys, files.calibrate(out="blocked/inside"), str(blocked))


def test_a_full_disk_leaves_nothing(files, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    refused(files, capsys, files.calibrate(), "No space left on device")
    assert not list(files.folder.glob("cal*/*"))
    assert not list(files.folder.glob(".cal*"))


@pytest.fixture
def calibrated(files):
    assert run(files.calibrate()) == 0
    return files.folder / "cal" / "calibration.json"


def matrices_words(files, calibrated, poses, *more):
    return [
        "matrices", "--calibration", str(calibrated), "--poses", str(poses), "--out", str(files.folder / "m.npz"),
        "--quiet", *map(str, more),
    ]  # fmt: skip


def test_matrices_refuse_another_pivot(files, capsys):
    text = (files.folder / "poses.csv").read_text()
    first = files.table("first.csv", "# pivot_mm: 0, 0, 100\n" + text)
    other = files.table("other.csv", "# pivot_mm: 0, 0, 130\n" + text)
    assert run(files.calibrate(poses=first)) == 0
    calibrated = files.folder / "cal" / "calibration.json"
    assert run(matrices_words(files, calibrated, other)) == 1
    assert "pivot" in capsys.readouterr().err
    assert not (files.folder / "m.npz").exists()
    assert run(matrices_words(files, calibrated, first)) == 0


def test_matrices_refuse_another_scanner(files, calibrated, capsys):
    content = {**files.json("scanner.json"), "d_SR_mm": 320.0}
    other = files.table("other.json", json.dumps(content))
    words = matrices_words(files, calibrated, files.folder / "poses.csv", "--scanner", other)
    assert run(words) == 1
    assert "d_SR" in capsys.readouterr().err
    assert not (files.folder / "m.npz").exists()


def test_matrices_refuse_a_newer_calibration(files, calibrated, capsys):
    content = {**json.loads(calibrated.read_text()), "schema": "tomopose/calibration/99"}
    newer = files.table("newer.json", json.dumps(content))
    assert run(matrices_words(files, newer, files.folder / "poses.csv")) == 1
    assert "99" in capsys.readouterr().err


def test_export_of_an_unknown_format(files, calibrated, capsys):
    assert run(matrices_words(files, calibrated, files.folder / "poses.csv")) == 0
    words = ["export", "--matrices", str(files.folder / "m.npz"), "--to", "astro", "--out", str(files.folder / "x")]
    assert run(words) == 1
    assert "astro" in capsys.readouterr().err
    assert not (files.folder / "x").exists()
