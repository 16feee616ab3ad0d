"""Source and detector that move about a fixed object, through the front door: one manipulator, and twin robots."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.calibration.uncertainty.trajectory import rms_px
from tomopose.cli.main import run
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import eq5_matrices, project_ball
from tomopose.manipulator.files import write_manipulator
from tomopose.manipulator.serial import poses_from_joints
from tomopose.manipulator.virtual import Disturbance, real_motion, typical_hexapod, typical_robot

CORNERS = np.array([[x, y, z] for x in (-15.0, 15.0) for y in (-15.0, 15.0) for z in (-30.0, 30.0)])
SIGMA = 0.015


def words(*parts):
    return [str(p) for p in parts]


def calibrate(folder, out, *more):
    return run(
        words(
            "calibrate",
            "--scanner",
            folder / "scanner.json",
            "--poses",
            folder / "poses.csv",
            "--observations",
            folder / "o.csv",
            "--out",
            folder / out,
            "--quiet",
            *more,
        )
    )


def matrices(folder, cal, *more):
    return run(
        words(
            "matrices",
            "--calibration",
            folder / cal / "calibration.json",
            "--poses",
            folder / "scan.csv",
            "--out",
            folder / f"{cal}.npz",
            "--quiet",
            "--force",
            *more,
        )
    )


# -- one manipulator that carries source and detector ---------------------------------------------------------------


@pytest.fixture
def gantry(tmp_path, scanner, rng):
    """A hexapod with joints 0.1 mm off carries the scanner: two fixed balls, 150 poses; a tilting scan."""
    machine = replace(typical_hexapod(), scale_sigma=0.0, geometry_sigma=0.0)
    p = rng.standard_normal(len(machine.names)) * machine.sigma
    mount = tp.RigidTransform.from_angles([0.02, -0.01, 0.03], [3.0, 1.0, -2.0], source=tp.Frame.H, target=tp.Frame.T)
    balls = np.array([[14.0, -16.0, 15.0], [-11.0, 12.0, -17.0]])
    poses = tp.PoseSequence.from_table(
        rng.uniform(-12, 12, (150, 3)), rng.uniform(-6, 6, (150, 3)), ball_id=np.arange(150) % 2
    )
    angle = np.linspace(0, 2 * np.pi, 30)
    scan = tp.PoseSequence.from_table(
        np.zeros((30, 3)), np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), np.zeros(30)])
    )
    real = tp.inverse_poses(real_motion(machine, poses, p, disturbance=Disturbance(), rng=rng))
    x = project_ball(scanner, T_HT=mount, T_MH=real.T_MH, t=balls[np.asarray(poses.ball_id)])
    x = x + SIGMA * rng.standard_normal(x.shape)
    tp.write_scanner(tmp_path / "scanner.json", scanner.exact())
    tp.write_poses(tmp_path / "poses.csv", poses)
    tp.write_poses(tmp_path / "scan.csv", scan)
    tp.write_observations(tmp_path / "o.csv", tp.BallObservations.from_sigma(x, SIGMA, pose_id=poses.pose_id))
    write_manipulator(tmp_path / "hexapod.json", machine)
    home = scanner.T_TW(0.0) @ mount
    true = tp.inverse_poses(real_motion(machine, scan, p)).T_MH.matrix
    P = np.array([scanner.P_S @ scanner.T_WS.matrix @ home.matrix @ T @ np.linalg.inv(home.matrix) for T in true])
    return tmp_path, machine, p, scan, P, balls, mount


@pytest.mark.slow
def test_moving_scanner_from_files_to_matrices(gantry, capsys):
    folder, _, _, _, truth, balls, _ = gantry
    moving = ("--arrangement", "moving-scanner")
    length = float(np.linalg.norm(balls[0] - balls[1]))
    assert calibrate(folder, "rigid", *moving, "--model", "rigid") == 3
    assert (
        calibrate(
            folder, "auto", *moving, "--manipulator", folder / "hexapod.json", "--distance", f"0,1={length:.4f}(0.0005)"
        )
        == 0
    )
    cal = tp.read_calibration(folder / "auto" / "calibration.json")
    assert cal.model == "kinematic"
    assert cal.arrangement == "moving-scanner"
    assert cal.provenance.arguments["arrangement"] == "moving-scanner"
    assert np.linalg.norm(cal.balls[0] - cal.balls[1]) == pytest.approx(length, abs=0.003)
    error = {}
    for name in ("rigid", "auto"):
        assert matrices(folder, name) == 0
        found = tp.read_matrices(folder / f"{name}.npz")
        error[name] = rms_px(without_object_pose(found.P, truth, CORNERS))
    assert error["auto"] < error["rigid"] / 10
    assert error["auto"] < 0.05
    assert (found.points_sigma > found.points_sigma_shared).all()
    assert 0.3 < error["auto"] / (np.sqrt(2) * np.sqrt(np.mean(found.points_sigma_shared**2))) < 3
    assert (folder / "auto" / "report.html").stat().st_size > 1000


@pytest.mark.parametrize(("scatter_mm", "code"), [(0.0, 0), (2.0, 3)])
def test_a_d_sd_that_varies_from_view_to_view_is_not_trusted(tmp_path, scanner, rng, scatter_mm, code):
    """An arm that sags moves the panel along the beam: the centres move along the line from the piercing point."""
    poses = tp.PoseSequence.from_table(rng.uniform(-12, 12, (150, 3)), rng.uniform(-6, 6, (150, 3)))
    mount = tp.RigidTransform.from_angles([0.02, -0.01, 0.03], [3.0, 1.0, -2.0], source=tp.Frame.H, target=tp.Frame.T)
    x = project_ball(scanner, T_HT=mount, T_MH=tp.inverse_poses(poses).T_MH, t=[14.0, -16.0, 15.0])
    pierced = np.array([scanner.u_0, scanner.v_0])
    scale = 1.0 + scatter_mm / scanner.d_SD * rng.standard_normal(len(poses))
    x = pierced + (x - pierced) * scale[:, None] + SIGMA * rng.standard_normal(x.shape)
    tp.write_scanner(tmp_path / "scanner.json", scanner.exact())
    tp.write_poses(tmp_path / "poses.csv", poses)
    tp.write_observations(tmp_path / "o.csv", tp.BallObservations.from_sigma(x, SIGMA, pose_id=poses.pose_id))
    assert calibrate(tmp_path, "cal", "--arrangement", "moving-scanner") == code


@pytest.mark.slow
def test_commands_move_the_scanner_where_it_was_wanted(gantry):
    """The machine that errs, commanded so, images as a perfect one with the mount that was found."""
    folder, machine, p, scan, _, _, mount = gantry
    assert calibrate(folder, "cal", "--arrangement", "moving-scanner", "--manipulator", folder / "hexapod.json") == 0
    assert matrices(folder, "cal", "--commands", folder / "c.csv") == 0
    cal = tp.read_calibration(folder / "cal" / "calibration.json")

    def seen(T_HT, poses):
        turned = tp.inverse_poses(poses)
        return eq5_matrices(cal.scanner, T_HT=T_HT, T_MH=turned.T_MH, alpha=turned.alpha)

    wanted = seen(cal.T_HT, scan)
    commanded, plain = (
        rms_px(without_object_pose(seen(mount, real_motion(machine, table, p)), wanted, CORNERS))
        for table in (tp.read_poses(folder / "c.csv"), scan)
    )
    assert commanded < plain / 10


@pytest.mark.slow
def test_a_moving_scanner_of_unknown_kinematics(gantry, capsys):
    """A map of pose errors serves the inverse chain too, and says what the balls cannot determine."""
    folder, truth = gantry[0], gantry[4]
    moving = ("--arrangement", "moving-scanner")
    assert calibrate(folder, "rigid", *moving, "--model", "rigid") == 3
    assert calibrate(folder, "slack", *moving, "--model", "slack") in (0, 3)
    error = {}
    for name in ("rigid", "slack"):
        assert matrices(folder, name) == 0
        found = tp.read_matrices(folder / f"{name}.npz")
        error[name] = rms_px(without_object_pose(found.P, truth, CORNERS))
    assert error["slack"] < error["rigid"]
    assert calibrate(folder, "x", *moving, "--model", "slack", "--d-sd-sigma-mm", "0.2") == 1
    assert "cannot be distinguished from poses that scatter" in capsys.readouterr().err


def test_a_scanner_that_moves_is_named(gantry):
    folder = gantry[0]
    assert calibrate(folder, "wrong") == 3
    reasons = " ".join(tp.read_calibration(folder / "wrong" / "calibration.json").reasons)
    assert "it is the scanner that moves" in reasons
    assert "--arrangement moving-scanner" in reasons


def test_an_object_that_moves_is_named(files):
    table = tp.read_poses(files.folder / "poses.csv")
    (files.folder / "poses.csv").unlink()
    (files.folder / "observations.csv").unlink()
    still = replace(table, alpha=np.zeros(len(table)))
    x = project_ball(files.scanner, T_HT=files.T_HT, T_MH=still.T_MH, t=[6.0, -4.0, 11.0])
    tp.write_poses(files.folder / "poses.csv", still)
    tp.write_observations(
        files.folder / "observations.csv", tp.BallObservations.from_sigma(x, 0.01, pose_id=still.pose_id)
    )
    assert run([*files.calibrate("cal"), "--arrangement", "moving-scanner"]) == 3
    reasons = " ".join(tp.read_calibration(files.folder / "cal" / "calibration.json").reasons)
    assert "leave out --arrangement moving-scanner" in reasons


def test_a_convention_that_is_wrong_is_found_for_a_moving_scanner_too(gantry):
    """The signs of the angles belong to the table as it was written, not to its inverse."""
    folder = gantry[0]
    table = tp.read_poses(folder / "poses.csv")
    (folder / "poses.csv").unlink()
    angles = np.degrees(table.T_MH.angles) * [1, -1, 1]
    tp.write_poses(folder / "poses.csv", tp.PoseSequence.from_table(table.T_MH.t, angles, ball_id=table.ball_id))
    assert calibrate(folder, "cal", "--arrangement", "moving-scanner", "--model", "rigid") == 3
    best = tp.read_calibration(folder / "cal" / "calibration.json").hypotheses[0]
    assert best.name == "sign of V"


@pytest.mark.slow
def test_one_more_number_a_view(gantry, scanner, rng):
    """A C-arm that sags: d_SD differs from view to view; a robot with joint columns alone."""
    folder = gantry[0]
    robot = typical_robot()
    q = robot.q_start + rng.uniform(-0.12, 0.12, (120, 6))
    poses = poses_from_joints(robot, q)
    T_0 = robot.forward(robot.q_start[None])[0]
    mount = tp.RigidTransform.from_angles([0.1, 0.2, 0.3], [5.0, 6.0, -4.0], source=tp.Frame.H, target=tp.Frame.T)
    ball = T_0.apply(mount.inv.apply(np.zeros((1, 3))))[0] + [3.0, 4.0, 5.0]
    d_SD = scanner.d_SD + 0.5 * rng.standard_normal(120)
    turned = tp.inverse_poses(poses)
    x = np.concatenate(
        [
            project_ball(replace(scanner, d_SD=d), T_HT=mount, T_MH=turned.T_MH[k : k + 1], t=ball)
            for k, d in enumerate(d_SD)
        ]
    ) + SIGMA * rng.standard_normal((120, 2))
    header = "pose_id," + ",".join(f"q{k}_deg" for k in range(1, 7))
    rows = [f"{i}," + ",".join(map(repr, np.degrees(one).tolist())) for i, one in zip(poses.pose_id, q, strict=True)]
    (folder / "poses.csv").write_text("\n".join([header, *rows]) + "\n")
    (folder / "scan.csv").write_text("\n".join([header, *rows[:10]]) + "\n")
    (folder / "o.csv").unlink()
    tp.write_observations(folder / "o.csv", tp.BallObservations.from_sigma(x, SIGMA, pose_id=poses.pose_id))
    write_manipulator(folder / "robot.json", robot)
    more = ("--arrangement", "moving-scanner", "--manipulator", folder / "robot.json", "--model", "rigid")
    assert calibrate(folder, "fixed", *more) == 3, "a d_SD that is not fixed shows"
    assert calibrate(folder, "free", *more, "--d-sd-sigma-mm", "0.5") == 0
    cal = tp.read_calibration(folder / "free" / "calibration.json")
    fixed = tp.read_calibration(folder / "fixed" / "calibration.json")
    assert (fixed.errors.scatter.w > 10 * cal.errors.scatter.w).all()
    assert calibrate(folder, "links", *more[:4], "--model", "kinematic", "--d-sd-sigma-mm", "0.5") in (0, 3)
    notes = tp.read_calibration(folder / "links" / "calibration.json").observability.notes
    assert any("; use a known distance between two balls" in note for note in notes), "the links alone hold the scale"
    views = cal.views
    found, u = views.d_SD, views.u
    assert views.pose_id == cal.pose_id
    assert np.mean(np.abs(found - d_SD) < 3 * u + 0.05) > 0.95
    assert matrices(folder, "free", "--home", "0", "--manipulator", folder / "robot.json") == 0
    with_views = tp.read_matrices(folder / "free.npz")
    own = np.sqrt(np.mean(with_views.points_sigma**2 - with_views.points_sigma_shared**2))
    r = np.abs(with_views.P[:, :2, 3] / with_views.P[:, 2, 3:]).max()
    assert own > 0.05, f"half a millimetre of d_SD moves points {r:.0f} px from the middle"


@pytest.mark.slow
def test_a_c_arm_with_a_lift(gantry, scanner, rng, capsys):
    """A C-arm of one sliding and two turning joints, by joint values alone."""
    from tomopose.studies.improvements import c_arm

    folder, arm = gantry[0], c_arm()
    p = rng.standard_normal(len(arm.names)) * arm.sigma
    q = np.column_stack([rng.uniform(-20, 20, 100), *np.radians(rng.uniform(-1, 1, (2, 100)) * [[45], [100]])])
    mount = tp.RigidTransform.from_angles([0.02, -0.03, 1.6], [1.0, -2.0, 1.5], source=tp.Frame.H, target=tp.Frame.T)
    balls = np.array([[20.0, -15.0, 12.0], [-18.0, 15.0, -15.0]])
    table = poses_from_joints(arm, q, ball_id=np.arange(100) % 2)
    turn = np.radians(np.linspace(-90, 90, 20))
    scan = poses_from_joints(arm, np.column_stack([np.zeros(20), np.radians(8) * np.sin(5 * turn), turn]))
    real = tp.inverse_poses(real_motion(arm, table, p, disturbance=Disturbance(), rng=rng))
    x = project_ball(scanner, T_HT=mount, T_MH=real.T_MH, t=balls[np.asarray(table.ball_id)])
    x = x + SIGMA * rng.standard_normal(x.shape)
    for name, one in (("poses", table), ("scan", scan)):
        (folder / f"{name}.csv").unlink()
        tp.write_poses(folder / f"{name}.csv", one, joint_units=arm.joint_units)
        assert "q1_mm,q2_deg,q3_deg" in (folder / f"{name}.csv").read_text()
    seen = tp.BallObservations.from_sigma(x, SIGMA, pose_id=table.pose_id)
    tp.write_observations(folder / "o.csv", seen, force=True)
    write_manipulator(folder / "robot.json", arm)
    length = float(np.linalg.norm(balls[0] - balls[1]))
    more = ("--manipulator", folder / "robot.json", "--distance", f"0,1={length:.5f}(0.0005)", "--model", "kinematic")
    assert calibrate(folder, "cal", "--arrangement", "moving-scanner", *more) == 0
    assert matrices(folder, "cal", "--commands", folder / "c.csv") == 1
    assert "a machine of 3 joints cannot be commanded to correct all six" in capsys.readouterr().err
    assert not (folder / "cal.npz").exists()
    assert matrices(folder, "cal") == 0
    home = tp.inverse_poses(real_motion(arm, scan, p))
    truth = eq5_matrices(scanner, T_HT=mount, T_MH=home.T_MH, alpha=home.alpha)
    error = rms_px(without_object_pose(tp.read_matrices(folder / "cal.npz").P, truth, CORNERS))
    assert error < 0.15


def test_options_that_contradict_one_another(gantry, capsys):
    folder = gantry[0]
    for more, told in (
        (("--arrangement", "sideways"), "moving-object, moving-scanner"),
        (("--d-sd-sigma-mm", "0.1"), "--arrangement"),
        (("--twin", folder / "hexapod.json"), "--source-poses"),
        (("--source-poses", folder / "poses.csv"), "--twin"),
        (("--twin", folder / "t", "--source-poses", folder / "s", "--manipulator", folder / "hexapod.json"), "both"),
    ):
        assert calibrate(folder, "x", *more) == 2
        assert told in " ".join(capsys.readouterr().err.split())
    assert calibrate(folder, "x", "--arrangement", "moving-scanner", "--free", "d_SR") == 1
    assert "where W begins" in capsys.readouterr().err
    assert not (folder / "x").exists()


# -- twin robots ------------------------------------------------------------------------------------------------------


@pytest.fixture
def twins(tmp_path, monkeypatch):
    """Two 6R robots, links 0.2 mm and 0.02 deg off; files of 200 views and of a scan."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks" / "manipulator"))
    from twin_cases import twin_experiment

    e = twin_experiment(typical_robot(), 1)
    scanner = e.scanner
    tp.write_scanner(tmp_path / "scanner.json", scanner.exact())
    for name, table in (
        ("poses", e.poses),
        ("source", e.twin.source_poses),
        ("scan", e.scan),
        ("scan_source", e.scan_source),
    ):
        tp.write_poses(tmp_path / f"{name}.csv", table)
    tp.write_observations(tmp_path / "o.csv", e.observations)
    write_manipulator(tmp_path / "robot.json", typical_robot())
    T_HS = scanner.T_WS @ scanner.T_TW(0.0) @ e.mount
    write_twin(
        tmp_path,
        {
            "schema": "tomopose/twin/1",
            "detector": "robot.json",
            "source": json.loads((tmp_path / "robot.json").read_text()),
            "base": {"t_mm": e.twin.base.t.tolist(), "angles_deg": np.degrees(e.twin.base.angles).tolist()},
            "focus_mm": e.twin.focus.tolist(),
            "panel": {
                "origin_mm": (T_HS.R.T @ ([0.0, 0.0, scanner.d_SD] - T_HS.t)).tolist(),
                "u_axis": (-T_HS.R[0]).tolist(),
                "v_axis": T_HS.R[1].tolist(),
            },
        },
    )
    return tmp_path, e


def write_twin(folder, document):
    (folder / "twin.json").write_text(json.dumps(document))


def twin_words(folder, *more):
    return ("--twin", folder / "twin.json", "--source-poses", folder / "source.csv", *more)


@pytest.mark.slow
def test_twin_robots_from_files_to_matrices(twins, capsys):
    from tomopose.manipulator.twin_file import read_twin

    folder, e = twins
    drawn = read_twin(folder / "twin.json")
    np.testing.assert_allclose(drawn.mount(e.scanner).matrix, e.mount.matrix, atol=1e-9)
    np.testing.assert_allclose(drawn.base.matrix, e.twin.base.matrix, atol=1e-9)
    assert calibrate(folder, "rigid", *twin_words(folder, "--model", "rigid")) == 0
    assert calibrate(folder, "auto", *twin_words(folder)) == 0
    cal = tp.read_calibration(folder / "auto" / "calibration.json")
    assert cal.model == "kinematic"
    assert cal.arrangement == "twin"
    assert cal.provenance.arguments["arrangement"] == "twin"
    names = {p.name for p in cal.parameters}
    assert {"detector_joint_1_d", "source_joint_1_d", "base_t_x", "focus_z"} <= names
    x_M = e.middle + CORNERS
    error, stated = {}, {}
    for name in ("rigid", "auto"):
        assert matrices(folder, name, "--source-poses", folder / "scan_source.csv") == 0
        found = tp.read_matrices(folder / f"{name}.npz")
        error[name], stated[name] = twin_error(found, e, x_M)
    assert error["auto"] < error["rigid"] / 4
    assert error["auto"] < 0.06
    assert error["auto"] < 3 * stated["auto"]
    assert (found.points_sigma > found.points_sigma_shared).all()
    assert matrices(folder, "auto", "--source-poses", folder / "scan_source.csv", "--binning", "2") == 0
    assert tp.read_matrices(folder / "auto.npz").n_u == e.scanner.n_u // 2


def twin_error(found, e, x_M):
    """(error, stated), px, the object's rigid pose removed; any frame near W serves."""
    to_W = e.scanner.T_TW(0.0) @ e.mount @ tp.inverse_poses(e.scan).T_MH[0]
    x_W = to_W.apply(x_M)
    d = without_object_pose(found.P, e.P_true @ np.linalg.inv(to_W.matrix), x_W)
    return rms_px(d), float(np.sqrt(2 * np.mean(found.points_sigma_shared**2)))


@pytest.mark.slow
def test_joint_values_alone_serve_twin_robots(twins):
    folder, _ = twins
    for name in ("poses", "source", "scan", "scan_source"):
        table = tp.read_poses(folder / f"{name}.csv")
        header = "pose_id," + ",".join(f"q{k}_deg" for k in range(1, 7))
        rows = [
            f"{i}," + ",".join(map(repr, np.degrees(q).tolist())) for i, q in zip(table.pose_id, table.q, strict=True)
        ]
        (folder / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n")
    assert calibrate(folder, "auto", *twin_words(folder)) == 0
    assert matrices(folder, "auto", "--source-poses", folder / "scan_source.csv") == 0
    assert calibrate(folder, "rigid", *twin_words(folder, "--model", "rigid")) == 0
    assert matrices(folder, "rigid", "--source-poses", folder / "scan_source.csv") == 1, "it holds no robot"
    twin = ("--manipulator", folder / "twin.json")
    assert matrices(folder, "rigid", "--source-poses", folder / "scan_source.csv", *twin) == 0


@pytest.mark.slow
def test_a_pitch_may_be_freed_and_the_mount_takes_the_rest(twins, capsys):
    folder, e = twins
    content = json.loads((folder / "scanner.json").read_text())
    wrong = {**content, "p_u_mm": e.scanner.p_u * 1.002}
    (folder / "scanner.json").write_text(json.dumps(wrong))
    assert calibrate(folder, "free", *twin_words(folder, "--free", "pitch_ratio")) == 0
    cal = tp.read_calibration(folder / "free" / "calibration.json")
    ratio = next(p for p in cal.parameters if p.name == "pitch_ratio")
    assert abs(ratio.value - e.scanner.p_u / e.scanner.p_v) < 4 * ratio.u < 2e-3
    assert matrices(folder, "free", "--source-poses", folder / "scan_source.csv") == 0
    assert twin_error(tp.read_matrices(folder / "free.npz"), e, e.middle + CORNERS)[0] < 0.06
    for name, told in (
        ("d_SD", "taken up exactly by the mount"),
        ("eta", "taken up exactly by the mount"),
        ("d_SR", "where W begins"),
        ("translation_scale", "no meaning for two robots"),
    ):
        assert calibrate(folder, "x", *twin_words(folder, "--free", name)) == 1
        assert told in capsys.readouterr().err


@pytest.mark.slow
def test_matrices_need_the_tables_of_their_arrangement(twins, capsys):
    folder, _ = twins
    assert calibrate(folder, "cal", *twin_words(folder, "--model", "rigid")) == 0
    assert matrices(folder, "cal") == 1
    assert "--source-poses with the source robot's table is missing" in capsys.readouterr().err
    source = ("--source-poses", folder / "scan_source.csv")
    assert matrices(folder, "cal", *source, "--home", "3") == 1
    assert "W is that of the first view" in capsys.readouterr().err
    short = tp.read_poses(folder / "scan_source.csv").select(slice(0, 20))
    (folder / "scan_source.csv").unlink()
    tp.write_poses(folder / "scan_source.csv", short)
    assert matrices(folder, "cal", *source) == 1
    assert "40 of 60 views have no row in the source robot's table, the first is '20'" in capsys.readouterr().err


def test_a_plain_calibration_takes_no_source_table(files, capsys):
    assert run(files.calibrate("cal")) == 0
    cal = files.folder / "cal" / "calibration.json"
    poses = files.folder / "poses.csv"
    more = ("--poses", poses, "--source-poses", poses, "--out", files.folder / "m.npz")
    assert run(words("matrices", "--calibration", cal, *more)) == 1
    assert "not of twin robots" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"source": None}, ""),
        ({"source": 5}, "a robot's file"),
        ({"detector": "nowhere.json"}, "does not exist"),
        ({"focus_mm": [1.0, 2.0]}, "focus_mm has shape"),
        ({"focus_m": [0.0, 0.0, 0.1]}, "another unit"),
        ({"base": {"t_mm": [1.5, 0.0, 0.2], "angles_deg": [0, 0, 180]}}, "metres?"),
        ({"base": {"t_mm": [1500, 0.0, 0.0], "angles_deg": [0, 0, 3.14159]}}, "radians?"),
        ({"base": {"t_mm": [1500, 0.0, 0.0]}}, "angles_deg missing"),
        ({"panel": {"origin_mm": [0, 0, 0], "u_axis": [1, 0, 0], "v_axis": [1, 1, 0]}}, "not 90"),
        ({"panel": {"origin_mm": [0, 0, 0], "u_axis": [0, 0, 0], "v_axis": [1, 1, 0]}}, "has a length"),
        ({"schema": "tomopose/hexapod/1"}, '"tomopose/twin/1" is needed'),
        ({"focus_sigma_mm": 0}, "standard deviation > 0"),
    ],
)
def test_twin_files_are_checked(twins, capsys, change, told):
    folder, _ = twins
    good = json.loads((folder / "twin.json").read_text())
    write_twin(folder, {**good, **change})
    code = calibrate(folder, "x", *twin_words(folder, "--model", "rigid"))
    assert code == (1 if told else 0)
    assert told in capsys.readouterr().err


def test_twin_files_that_lack_a_part(twins, capsys):
    folder, _ = twins
    good = json.loads((folder / "twin.json").read_text())
    write_twin(folder, {k: v for k, v in good.items() if k not in ("detector", "panel")})
    assert calibrate(folder, "x", *twin_words(folder)) == 1
    assert "detector, panel missing" in capsys.readouterr().err
    write_twin(folder, good)
    assert calibrate(folder, "x", "--manipulator", folder / "twin.json") == 1
    assert "give it as --twin" in capsys.readouterr().err
