"""A hexapod that errs, through the front door: identified from the ball alone, applied to a scan, corrected."""

from __future__ import annotations

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
    truth = eq5_matrices(
        scanner, T_HT=T_HT, T_MH=real_motion(machine, scan, p).T_MH, alpha=scan.alpha
    )
    return tmp_path, machine, p, scan, truth


def calibrate(folder, *more):
    words = ["calibrate", "--scanner", folder / "scanner.json", "--poses", folder / "poses.csv"]
    return run([*map(str, [*words, "--observations", folder / "o.csv", "--quiet", *more])])


def scan_error(folder, cal, truth):
    """Largest pixel error of the scan's matrices after the rigid pose of the object that fits best."""
    from tomopose.calibration.kinematic_trajectory import rms_px, without_object_pose

    words = ["matrices", "--calibration", folder / cal / "calibration.json", "--poses", folder / "scan.csv", "--quiet"]
    assert run([*map(str, words), "--out", str(folder / f"{cal}.npz")]) == 0
    return rms_px(without_object_pose(tp.read_matrices(folder / f"{cal}.npz").P, truth, CORNERS))


def test_identified_errors_improve_the_scan(erring):
    folder, _, _, _, truth = erring
    assert calibrate(folder, "--model", "rigid", "--out", folder / "rigid") == 3
    assert calibrate(folder, "--manipulator", folder / "hexapod.json", "--out", folder / "auto") == 0
    assert tp.read_calibration(folder / "auto" / "calibration.json").model == "kinematic"
    assert scan_error(folder, "auto", truth) < scan_error(folder, "rigid", truth) / 10


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


def test_matrices_tell_the_shared_part_from_the_scatter(erring, capsys):
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


def test_plan_for_a_robot_says_what_the_table_angles_are_for(erring, capsys):
    from tomopose.manipulator.virtual import typical_robot

    folder = erring[0]
    write_manipulator(folder / "robot.json", typical_robot())
    words = ["plan", "poses", "--optimal", "--for", "kinematic", "--scanner", folder / "scanner.json", "--images", "30",
             "--manipulator", folder / "robot.json", "--tilt-deg", "20"]
    for angles, out in (("0", "still.csv"), ("0,90,180", "turned.csv")):
        assert run([*map(str, [*words, "--table-angles-deg", angles, "--out", folder / out])]) == 0
        told = capsys.readouterr().out
        assert ("scale of the object" in told) == (angles == "0")
    plan = tp.read_poses(folder / "turned.csv")
    assert len(plan) == 30
    assert plan.q is not None
    assert np.ptp(np.degrees(plan.q[:, 5])) > 180.0, "a robot turns about its tool"
