"""The examples run, and say what the documentation says that they say."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.simulated import write_run
from tomopose.geometry.rotations import rotation_angle_between
from tomopose.studies.demo import demo_setup

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_second_table_angle_shows_what_the_residual_cannot(capsys):
    still, turned = load("what_poses_can_tell").main().values()
    assert still.d_rms == pytest.approx(turned.d_rms, rel=0.15)  # the fit looks as good
    for name, gain in (("d_SR", 20.0), ("u_0", 20.0), ("t_HT_x", 20.0)):
        u = [next(p.u for p in c.parameters if p.name == name) for c in (still, turned)]
        assert u[0] > gain * u[1], name
    assert "table at 0 and 90 degrees" in capsys.readouterr().out


def test_matrices_mean_the_same_by_hand_and_through_a_file(tmp_path, capsys):
    assert load("own_geometry_check").main(tmp_path / "geometry") < 1e-6
    assert "largest difference" in capsys.readouterr().out


@pytest.mark.slow
def test_from_radiographs_to_geometry_files(tmp_path, capsys):
    setup = demo_setup(small=True, views=36)
    run = tp.simulate_ball_run(
        setup.scanner,
        T_HT=setup.T_HT,
        t=setup.t,
        poses=setup.poses,
        ball_diameter=setup.ball_diameter,
        snr=setup.snr,
        seed=setup.seed,
    )
    write_run(tmp_path, run)
    tp.write_poses(tmp_path / "scan.csv", setup.scan)
    calibration = load("calibrate_and_export").main(tmp_path)
    assert np.abs(calibration.T_HT.t - setup.T_HT.t).max() < 0.01
    assert rotation_angle_between(calibration.T_HT.R, setup.T_HT.R) < 1e-4
    assert (tmp_path / "exported" / "rtk.xml").is_file()
    assert "d_rms" in capsys.readouterr().out


def test_every_example_is_run_here():
    tested = {"what_poses_can_tell", "own_geometry_check", "calibrate_and_export"}
    assert {p.stem for p in EXAMPLES.glob("*.py")} == tested
