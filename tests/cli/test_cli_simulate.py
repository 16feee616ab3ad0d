"""Several scenes and grids in one command, each run in a folder of its own."""

from __future__ import annotations

import json

import pytest

import tomopose as tp
from tomopose.cli.main import run

SCENE = """
schema = "tomopose/scene/1"
seed = 1
source = { voltage_kV = 120.0 }
detector = { snr = 100 }
objects = [{ kind = "ball", diameter_mm = 4.0, t_mm = [0.3, -0.2, 0.1] }]
poses = { POSES }

[scanner]
d_SD_mm = 800.0
d_SR_mm = 200.0
p_u_mm = 0.8
p_v_mm = 0.9
u_0_px = 30.0
v_0_px = 31.0
n_u_px = 61
n_v_px = 63
"""
GRID, SCAN = "grid = { n = 2, half_range_mm = 1.0 }", "scan = { n = 3 }"


def scene(path, poses=GRID):
    path.write_text(SCENE.replace("POSES", poses), encoding="utf-8")
    return str(path)


@pytest.mark.slow
def test_each_scene_and_grid_has_a_folder(tmp_path, capsys):
    given = [scene(tmp_path / "a.toml"), scene(tmp_path / "b.toml")]
    assert run(["simulate", *given, "--grid", "1,2", "--out", str(tmp_path / "out"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["runs"] == ["a-grid1", "a-grid2", "b-grid1", "b-grid2"]
    assert said["images"] == 2 * (7 + 56)
    for name, n in (("a-grid1", 7), ("b-grid2", 56)):
        folder = tmp_path / "out" / name
        assert len(tp.read_poses(folder / "poses.csv")) == n
        assert len(tp.open_images(folder / "radiographs")) == n


def test_one_scene_needs_no_folder_of_its_own(tmp_path):
    assert run(["simulate", scene(tmp_path / "a.toml", SCAN), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert len(tp.open_images(tmp_path / "out" / "radiographs")) == 3


def test_what_cannot_be_meant_is_refused(tmp_path, capsys):
    a, out = scene(tmp_path / "a.toml"), str(tmp_path / "out")
    assert run(["simulate", a, "--grid", "two", "--out", out]) == 2
    assert run(["simulate", a, a, "--out", out]) == 2
    assert run(["simulate", scene(tmp_path / "scan.toml", SCAN), "--grid", "2", "--out", out]) == 2
    assert "no grid" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
