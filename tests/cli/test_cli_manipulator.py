"""A hexapod that errs, through the front door: identified from the ball alone, applied to a scan, corrected."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run
from tomopose.geometry.projection import eq5_matrices, project_ball
from tomopose.manipulator.files import write_manipulator
from tomopose.manipulator.virtual import real_motion, typical_hexapod

CORNERS = np.array([[x, y, z] for x in (-15.0, 15.0) for y in (-15.0, 15.0) for z in (-30.0, 30.0)])


@pytest.fixture
def erring(tmp_path, scanner, T_HT):
    """Files of a run with table angles and mixed tilts; joints 0.1 mm off, 0.01 px of noise."""
    rng = np.random.default_rng(7)
    machine = typical_hexapod()
    p = rng.normal(size=len(machine.names)) * machine.sigma
    p[len(machine.names) - 5 :] = 0.0  # the geometry file as a whole is right
    n = 120
    poses = tp.PoseSequence.from_table(
        rng.uniform(-9, 9, (n, 3)), rng.uniform(-7, 7, (n, 3)), alpha=np.radians(90.0 * (np.arange(n) % 4))
    )
    real = real_motion(machine, poses, p)
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=real.T_MH, t=[9.0, -7.0, 14.0], alpha=poses.alpha)
    x_D = x_D + rng.normal(scale=0.01, size=x_D.shape)
    scan = tp.tilted_scan(24, lambda a: np.radians(5.0) * np.sin(3 * a), R_HT=T_HT.R)
    tp.write_scanner(tmp_path / "scanner.json", scanner)
    tp.write_poses(tmp_path / "poses.csv", poses)
    tp.write_poses(tmp_path / "scan.csv", scan)
    tp.write_observations(tmp_path / "o.csv", tp.BallObservations.from_sigma(x_D, 0.01, pose_id=poses.pose_id))
    write_manipulator(tmp_path / "hexapod.json", machine)
    truth = eq5_matrices(scanner, T_HT=T_HT, T_MH=real_motion(machine, scan, p).T_MH, alpha=scan.alpha)
    return tmp_path, machine, p, scan, truth


def calibrate(folder, *more):
    words = ["calibrate", "--scanner", folder / "scanner.json", "--poses", folder / "poses.csv"]
    return run([*map(str, [*words, "--observations", folder / "o.csv", "--quiet", *more])])


def scan_error(folder, cal, truth):
    """Largest pixel error of the scan's matrices after the rigid pose of the object that fits best."""
    from tomopose.calibration.uncertainty.trajectory import rms_px
    from tomopose.geometry.object_pose import without_object_pose

    words = ["matrices", "--calibration", folder / cal / "calibration.json", "--poses", folder / "scan.csv", "--quiet"]
    assert run([*map(str, words), "--out", str(folder / f"{cal}.npz")]) == 0
    return rms_px(without_object_pose(tp.read_matrices(folder / f"{cal}.npz").P, truth, CORNERS))


@pytest.mark.slow
def test_identified_errors_improve_the_scan(erring):
    folder, _, _, _, truth = erring
    assert calibrate(folder, "--model", "rigid", "--out", folder / "rigid") == 3
    assert calibrate(folder, "--manipulator", folder / "hexapod.json", "--out", folder / "auto") == 0
    assert tp.read_calibration(folder / "auto" / "calibration.json").model == "kinematic"
    assert scan_error(folder, "auto", truth) < scan_error(folder, "rigid", truth) / 10


@pytest.mark.slow
def test_commands_make_the_real_machine_reach_the_poses(erring):
    folder, machine, p, scan, _ = erring
    assert calibrate(folder, "--manipulator", folder / "hexapod.json", "--out", folder / "cal") == 0
    words = ["matrices", "--calibration", folder / "cal" / "calibration.json", "--poses", folder / "scan.csv"]
    more = ["--quiet", "--out", folder / "m.npz", "--commands", folder / "commands.csv"]
    assert run([*map(str, [*words, *more])]) == 0
    reached = real_motion(machine, tp.read_poses(folder / "commands.csv"), p).T_MH
    plain = real_motion(machine, scan, p).T_MH

    def wander(T):
        """A constant offset of the plate is the ball's and the mount's; what changes is what a scan sees."""
        return np.ptp((scan.T_MH @ T.inv).log(), axis=0).max()

    assert wander(reached) < wander(plain) / 5


def test_commands_need_identified_errors(erring, capsys):
    folder = erring[0]
    assert calibrate(folder, "--model", "rigid", "--out", folder / "rigid") == 3
    words = ["matrices", "--calibration", folder / "rigid" / "calibration.json", "--poses", folder / "scan.csv"]
    assert run([*map(str, [*words, "--out", folder / "m.npz", "--commands", folder / "c.csv"])]) == 1
    assert "no errors of the manipulator" in capsys.readouterr().err
    assert not (folder / "m.npz").exists()


def test_scale_bars_are_written_one_way(erring, capsys):
    folder = erring[0]
    assert calibrate(folder, "--distance", "0-1=25", "--out", folder / "x") == 2
    assert "--distance" in capsys.readouterr().err


@pytest.mark.slow
def test_matrices_separate_the_shared_part_from_the_scatter(erring, capsys):
    folder = erring[0]
    assert calibrate(folder, "--manipulator", folder / "hexapod.json", "--out", folder / "cal") == 0
    words = ["matrices", "--calibration", folder / "cal" / "calibration.json", "--poses", folder / "scan.csv"]
    capsys.readouterr()
    assert run([*map(str, [*words, "--out", folder / "m.npz"])]) == 0
    told = capsys.readouterr().out
    assert "shared by all views" in told
    assert "of the manipulator's scatter" in told
    read = tp.read_matrices(folder / "m.npz")
    assert (read.points_sigma > read.points_sigma_shared).all()
    ids = tp.read_poses(folder / "scan.csv").pose_id
    assert run([*map(str, [*words, "--quiet", "--home", ids[6], "--out", folder / "home.npz"])]) == 0
    again = tp.read_matrices(folder / "home.npz")
    np.testing.assert_allclose(again.decompose().d_SD, read.decompose().d_SD, rtol=1e-9)
    assert run([*map(str, [*words, "--quiet", "--home", "nowhere", "--out", folder / "x.npz"])]) == 1


@pytest.mark.slow
def test_the_plan_of_a_robot_alone_says_that_its_links_hold_the_scale(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks" / "manipulator"))
    from manipulator_cases import robot_experiment

    from tomopose.manipulator.virtual import typical_robot

    robot = typical_robot()
    for table, told in ((False, True), (True, False)):
        folder = tmp_path / str(table)
        folder.mkdir()
        e = robot_experiment(robot, 0, n=100, table=table)
        tp.write_scanner(folder / "scanner.json", e.scanner)
        tp.write_poses(folder / "poses.csv", e.poses)
        tp.write_observations(folder / "o.csv", e.observations)
        write_manipulator(folder / "robot.json", robot)
        words = [
            "calibrate",
            "--scanner",
            folder / "scanner.json",
            "--poses",
            folder / "poses.csv",
            "--observations",
            folder / "o.csv",
            "--manipulator",
            folder / "robot.json",
            "--out",
            folder / "cal",
        ]
        assert run([*map(str, words)]) == 0
        text = capsys.readouterr().out
        assert "errors of the manipulator" in text
        assert ("use table angles or a known distance between two balls" in text) == told


@pytest.mark.slow
def test_plan_for_a_robot_says_what_the_table_angles_are_for(erring, capsys):
    from tomopose.manipulator.virtual import typical_robot

    folder = erring[0]
    write_manipulator(folder / "robot.json", typical_robot())
    words = [
        "plan",
        "poses",
        "--optimal",
        "--for",
        "kinematic",
        "--scanner",
        folder / "scanner.json",
        "--images",
        "30",
        "--manipulator",
        folder / "robot.json",
        "--tilt-deg",
        "20",
    ]
    for angles, out in (("0", "still.csv"), ("0,90,180", "turned.csv")):
        assert run([*map(str, [*words, "--table-angles-deg", angles, "--out", folder / out])]) == 0
        told = capsys.readouterr().out
        assert ("scale of the object" in told) == (angles == "0")
    plan = tp.read_poses(folder / "turned.csv")
    assert len(plan) == 30
    assert plan.q is not None
    assert np.ptp(np.degrees(plan.q[:, 5])) > 180.0, "a robot turns about its tool"


# -- what cannot be meant ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"base_joints_mm": [[0.0, 1.0, 2.0]] * 5}, "holds 5 joints; a hexapod has 6"),
        ({"platform_joints_mm": "metres"}, "look like metres"),
        ({"leg_limits_mm": [249.0, 251.0]}, "outside 249 to 251"),
        ({"platform_joints_mm": "flat"}, "singular"),
        ({"joint_sigma_mm": 100.0}, "were micrometres meant?"),
        ({"joint_sigma_um": 100.0}, "unknown key 'joint_sigma_um'"),
    ],
)
def test_platforms_that_cannot_be_stop_a_calibration(erring, capsys, change, told):
    folder, machine, _, _, _ = erring
    joints = {
        "metres": (np.asarray(machine.platform_joints) / 1000).tolist(),
        "flat": (np.asarray(machine.base_joints) * [0.5, 0.5, 1.0] + [0.0, 0.0, 240.0]).tolist(),
    }
    change = {k: joints.get(v, v) if isinstance(v, str) else v for k, v in change.items()}
    path = folder / "hexapod.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    assert calibrate(folder, "--manipulator", path, "--out", folder / "cal") == 1
    assert told in capsys.readouterr().err
    assert not (folder / "cal").exists()


def rewritten(folder, **columns):
    """The pose table with columns exchanged."""
    poses = tp.read_poses(folder / "poses.csv")
    (folder / "poses.csv").unlink()
    tp.write_poses(folder / "poses.csv", replace(poses, **columns))


@pytest.mark.slow
def test_exchanged_balls_and_a_new_pivot_are_named(erring, scanner, T_HT, capsys):
    folder, machine, p, _, _ = erring
    poses = tp.read_poses(folder / "poses.csv")
    ball = np.arange(len(poses)) % 2
    centres = np.array([[9.0, -7.0, 14.0], [-8.0, 6.0, -9.0]])
    true = real_motion(machine, poses, p).T_MH

    def image(T_MH):
        x = project_ball(scanner, T_HT=T_HT, T_MH=T_MH, t=centres[ball], alpha=poses.alpha)
        x = x + np.random.default_rng(1).normal(scale=0.01, size=x.shape)
        seen = tp.BallObservations.from_sigma(x, 0.01, pose_id=poses.pose_id)
        tp.write_observations(folder / "o.csv", seen, force=True)

    words = ("--manipulator", folder / "hexapod.json", "--out", folder / "cal")
    image(true)
    said = ball.copy()
    said[[10, 11]] = said[[11, 10]]
    rewritten(folder, ball_id=said)
    assert calibrate(folder, *words) == 1
    assert "pose '10' is said to show ball 1 and shows ball 0" in capsys.readouterr().err
    change = np.array([0.3, -0.2, 0.4])
    t = true.t.copy()
    t[60:] += change - true.R[60:] @ change
    image(replace(true, t=t))
    rewritten(folder, ball_id=ball)
    assert calibrate(folder, *words) == 3
    reasons = json.loads((folder / "cal" / "calibration.json").read_text())["reasons"]
    assert any("pose 60" in reason for reason in reasons), reasons


@pytest.mark.parametrize(
    ("columns", "factor", "told"),
    [
        (5, 1.0, "joint values have shape (40, 5); (n, 6) are needed"),
        (6, np.pi / 180, "look like radians"),
        (6, 1.0, ""),
    ],
)
def test_joint_tables_are_checked(erring, rng, capsys, columns, factor, told):
    from tomopose.manipulator.virtual import typical_robot

    folder, robot = erring[0], typical_robot()
    write_manipulator(folder / "robot.json", robot)
    q = np.degrees(robot.q_start + rng.uniform(-0.1, 0.1, (40, 6)))[:, :columns] * factor
    rows = [f"{k}," + ",".join(map(repr, one.tolist())) for k, one in enumerate(q)]
    head = "pose_id," + ",".join(f"q{k + 1}_deg" for k in range(columns))
    (folder / "poses.csv").write_text("\n".join([head, *rows]) + "\n")
    observed = tp.read_observations(folder / "o.csv").select(slice(0, 40))
    tp.write_observations(folder / "o.csv", observed, force=True)
    code = calibrate(folder, "--manipulator", folder / "robot.json", "--model", "rigid", "--out", folder / "cal")
    assert code == (1 if told else 3), "centres of another machine fit no pose"
    assert told in capsys.readouterr().err
