"""`tomopose plan scan --part`: files that agree with one another, and bad input that leaves nothing behind."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run
from tomopose.cli.plan_scan import PartOptions
from tomopose.io.foreign.reading import read_pose_log
from tomopose.manipulator.files import write_manipulator
from tomopose.manipulator.virtual import typical_robot
from tomopose.planning.part.settings import PartSettings

SCANNER = tp.Scanner(
    d_SD=1000.0,
    d_SR=400.0,
    p_u=0.8,
    p_v=0.75,
    u_0=66.3,
    v_0=61.1,
    n_u=131,
    n_v=127,
    sigma={"d_SR": 0.05, "u_0": 0.2},
)
LIMITS = """
[travel]
z_mm = [0, 0.5]
rx_deg = [-8, 8]
ry_deg = [-8, 8]
rz_deg = [0, 0]
alpha_deg = [0, 45]
"""


def write_box(path: Path, half: tuple[float, float, float]) -> None:
    """An OBJ of six quadrilaterals, faces counter-clockwise from outside."""
    corners = np.array(list(itertools.product((-1, 1), repeat=3))) * half
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c} {d}" for a, b, c, d in quads]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def words(tmp_path) -> list[str]:
    write_box(tmp_path / "part.obj", (9.0, 7.0, 2.5))
    tp.write_scanner(tmp_path / "scanner.json", SCANNER)
    (tmp_path / "limits.toml").write_text(LIMITS)
    files = {"part": "part.obj", "scanner": "scanner.json", "limits": "limits.toml", "out": "scan.csv"}
    return ["plan", "scan", *itertools.chain(*((f"--{k}", str(tmp_path / v)) for k, v in files.items()))]


@pytest.mark.slow
def test_a_planned_scan_comes_with_its_figures_its_page_and_the_machine_list(words, tmp_path, capsys):
    assert run([*words, "--mu-per-mm", "0.05", "--views", "9", "--commands", "pi-gcs", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    document = json.loads((tmp_path / "scan.json").read_text())
    assert document["schema"] == "tomopose/scan-plan/1"
    assert said["J"] == document["J"]
    assert 0 < document["J"] <= document["bound"] <= 1
    assert document["J"] == pytest.approx(0.5 * document["C"] + 0.3 * document["T"] + 0.2 * document["M"])
    assert set(document["paths"]) == {"circular", "triangle", "sine"}
    assert document["constants"]["tangent_deg"] == pytest.approx(1.5)
    assert "y_mm" in document["assumed_limits"]
    poses = tp.read_poses(tmp_path / "scan.csv")
    assert len(poses) == 9
    tilts = np.degrees(poses.T_MH.angles)
    assert np.abs(tilts).max() <= 8 + 1e-9
    np.testing.assert_allclose(tilts[:, 2], 0, atol=1e-9)
    html = (tmp_path / "scan.html").read_text()
    assert "Beside the usual paths" in html
    assert "http://" not in html.split("</script>")[-1]
    back = read_pose_log(tmp_path / "scan.gcs").poses()
    np.testing.assert_allclose(back.T_MH.t, poses.T_MH.t, atol=1e-6)


@pytest.mark.slow
def test_a_material_is_looked_up_and_the_assumed_voltage_is_said(words, tmp_path, capsys):
    assert run([*words, "--material", "Al", "--views", "4"]) == 0
    out = capsys.readouterr().out
    assert "150 kV (assumed: --kv was not given)" in out
    mu = json.loads((tmp_path / "scan.json").read_text())["constants"]["mu_per_mm"]
    assert 0.03 < mu < 0.2


@pytest.mark.slow
def test_drawn_scans_know_the_beam_that_is_given(words, tmp_path, capsys):
    asked = [*words, "--material", "Al", "--kv", "120", "--views", "4", "--uncertainty", "drawn", "--draws", "10"]
    assert run(asked) == 0
    assert "plan: drawn scans: 10 of 10" in capsys.readouterr().err
    constants = json.loads((tmp_path / "scan.json").read_text())["constants"]
    assert (constants["uncertainty"], constants["draws"]) == ("drawn", 10)
    assert constants["beam_energies"] > 1


@pytest.mark.slow
def test_a_placing_is_stated_and_never_worse_than_as_given(words, tmp_path):
    assert run([*words, "--mu-per-mm", "0.05", "--views", "4", "--placing", "--quiet"]) == 0
    placing = json.loads((tmp_path / "scan.json").read_text())["placing"]
    tried = {t["rotation"]: t["J"] for t in placing["tried"]}
    assert max(tried.values()) >= tried["as given"] > 0
    R = np.array(placing["R"])
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "code", "match"),
    [
        (["--views", "100000", "--mu-per-mm", "0.05"], 1, "candidates"),
        (["--mu-per-mm", "-1"], 1, "mu"),
        (["--mu-per-mm", "nan"], 1, "mu"),
        (["--mu-per-mm", "0.05", "--material", "Al"], 2, "give one"),
        ([], 2, "attenuation"),
        (["--shape", "circular", "--mu-per-mm", "0.05"], 2, "--part"),
        (["--mu-per-mm", "0.05", "--commands", "siemens"], 2, "siemens"),
        (["--material", "unobtainium"], 1, "unobtainium"),
        (["--mu-per-mm", "0.05", "--uncertainty", "guessed"], 1, "filters, exact, drawn"),
    ],
)
def test_bad_input_is_answered_in_words_and_leaves_nothing(words, tmp_path, capsys, change, code, match):
    assert run([*words, *change]) == code
    assert match in capsys.readouterr().err
    assert not list(tmp_path.glob("scan.*"))


@pytest.mark.slow
def test_a_robots_plan_holds_its_joint_values_and_their_strokes(words, tmp_path):
    robot = typical_robot()
    asked = [*words, "--mu-per-mm", "0.05", "--views", "4", "--manipulator", str(tmp_path / "robot.json")]
    joints = [replace(j, limits=(q - 0.4, q + 0.4)) for j, q in zip(robot.joints, robot.q_start.tolist(), strict=True)]
    robot = replace(robot, joints=joints)
    write_manipulator(tmp_path / "robot.json", robot)
    assert run([*asked, "--commands", "kuka-krl"]) == 0
    poses = tp.read_poses(tmp_path / "scan.csv")
    assert (np.abs(poses.q - robot.q_start) <= 0.4).all()
    np.testing.assert_allclose(robot.forward(poses.q).matrix, poses.T_MH.matrix, atol=1e-8)
    document = json.loads((tmp_path / "scan.json").read_text())
    np.testing.assert_allclose(document["home"], robot.forward(robot.q_start[None]).matrix[0], atol=1e-9)
    np.testing.assert_allclose([j["highest"] for j in document["joints"]], np.degrees(poses.q.max(axis=0)))
    assert "joint 6, deg" in (tmp_path / "scan.html").read_text()
    back = read_pose_log(tmp_path / "scan.src").poses()
    np.testing.assert_allclose(back.T_MH.t, poses.T_MH.t, atol=1e-6)


def test_an_open_part_is_refused(words, tmp_path, capsys):
    path = tmp_path / "part.obj"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]))
    assert run([*words, "--mu-per-mm", "0.05"]) == 1
    assert "open" in capsys.readouterr().err


def test_files_that_exist_are_kept(words, tmp_path, capsys):
    (tmp_path / "scan.html").write_text("mine")
    assert run([*words, "--mu-per-mm", "0.05"]) == 1
    assert (tmp_path / "scan.html").read_text() == "mine"
    assert not (tmp_path / "scan.csv").exists()


def test_the_defaults_of_the_options_are_those_of_the_library():
    options, settings = PartOptions(), PartSettings(mu=1.0)
    for option, degrees in {"tangent": True, "tuy": True, "least_transmission": False, "margin": False}.items():
        there = getattr(settings, {"tuy": "tuy_width"}.get(option, option))
        assert getattr(options, option) == pytest.approx(np.degrees(there) if degrees else there), option
    for option in ("quanta", "blur", "seed", "sweeps", "room", "uncertainty", "draws"):
        assert getattr(options, option) == getattr(settings, option), option


@pytest.mark.slow
def test_a_continuous_scan_writes_its_way_and_says_whether_fdk_follows_it(words, tmp_path, capsys):
    (tmp_path / "limits.toml").write_text("[travel]\nz_mm = [0, 0.5]\nrx_deg = [-3, 3]\nry_deg = [-3, 3]\n")
    assert run([*words, "--mu-per-mm", "0.05", "--views", "16", "--continuous"]) == 0
    assert "FDK follows this path" in capsys.readouterr().out
    assert json.loads((tmp_path / "scan.json").read_text())["fdk"] == {"possible": True, "why": ""}
    way = tp.read_poses(tmp_path / "scan.way.csv")
    assert np.degrees(np.diff(way.alpha)).max() <= 0.5 + 1e-9


def test_a_manipulator_without_known_strokes_is_refused(words, tmp_path, capsys):
    joints = {"a_mm": 100, "alpha_deg": 90, "d_mm": 10}
    angle = np.radians([0, 60, 120, 180, 240, 300])
    ring = np.column_stack([100 * np.cos(angle), 100 * np.sin(angle), np.full(6, -200.0)])
    plates = {"base_joints_mm": ring.tolist(), "platform_joints_mm": (0.6 * ring).tolist()}
    for content, match in (
        ({"schema": "tomopose/hexapod/1", **plates}, "leg_limits_mm is missing"),
        ({"schema": "tomopose/serial/1", "convention": "dh", "joints": [joints] * 6}, "joint 1 of the robot has no"),
    ):
        (tmp_path / "machine.json").write_text(json.dumps(content))
        assert run([*words, "--mu-per-mm", "0.05", "--manipulator", str(tmp_path / "machine.json")]) == 1
        assert match in capsys.readouterr().err
        assert not list(tmp_path.glob("scan.*"))
