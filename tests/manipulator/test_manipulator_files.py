"""hexapod.json and robot.json: what is read comes back, and what is wrong is named."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tomopose.errors import FileError, InputError, SchemaVersionError, ShapeError, UnitError
from tomopose.manipulator.files import read_manipulator, write_manipulator
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.serial import SerialRobot
from tomopose.manipulator.virtual import typical_hexapod, typical_robot


def hexapod_document() -> dict[str, Any]:
    """The four keys that everybody writes."""
    machine = typical_hexapod()
    return {
        "schema": "tomopose/hexapod/1",
        "base_joints_mm": machine.base_joints.tolist(),
        "platform_joints_mm": machine.platform_joints.tolist(),
        "joint_sigma_mm": 0.1,
        "leg_sigma_mm": 0.1,
    }


def robot_document() -> dict[str, Any]:
    return {"schema": "tomopose/serial/1", **typical_robot().to_json()}


def write(folder: Path, document: Any) -> Path:
    path = folder / "machine.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def test_four_keys_make_a_hexapod(tmp_path: Path) -> None:
    machine = read_manipulator(write(tmp_path, hexapod_document()))
    assert isinstance(machine, Hexapod)
    np.testing.assert_array_equal(machine.base_joints, typical_hexapod().base_joints)
    assert machine.repeatability.t_mm == 0.0005
    assert machine.repeatability.w_rad == 12e-6


def test_a_robot_is_read(tmp_path: Path) -> None:
    machine = read_manipulator(write(tmp_path, robot_document()))
    assert isinstance(machine, SerialRobot)
    assert machine.names == typical_robot().names
    np.testing.assert_allclose(machine.sigma, typical_robot().sigma, rtol=1e-12)
    q = typical_robot().q_start[None]
    np.testing.assert_allclose(machine.forward(q).matrix, typical_robot().forward(q).matrix, atol=1e-9)


@pytest.mark.parametrize(
    "machine",
    [
        replace(typical_hexapod(), leg_limits=(200.0, 300.0), leg_scale_sigma=1e-5, axes_sigma=1e-3, pivot_sigma=0.5),
        typical_robot(eccentricity_sigma=1e-4),
    ],
)
def test_written_machines_come_back(machine: Any, tmp_path: Path) -> None:
    write_manipulator(tmp_path / "m.json", machine)
    again = read_manipulator(tmp_path / "m.json")
    assert again.names == machine.names
    np.testing.assert_allclose(again.sigma, machine.sigma, rtol=1e-12)
    assert again.repeatability == machine.repeatability
    with pytest.raises(FileError, match="exists already"):
        write_manipulator(tmp_path / "m.json", machine)


def changed(document: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {k: v for k, v in {**document, **changes}.items() if v is not ...}


METRES = (np.array(hexapod_document()["base_joints_mm"]) / 1000).tolist()
MICROMETRES = (np.array(hexapod_document()["platform_joints_mm"]) * 1000).tolist()
FIVE = hexapod_document()["base_joints_mm"][:5]
TWICE = [hexapod_document()["base_joints_mm"][0]] * 2 + hexapod_document()["base_joints_mm"][2:]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"base_joints_mm": FIVE}, ShapeError, "holds 5 joints"),
        ({"base_joints_mm": ...}, ShapeError, "base_joints_mm is needed"),
        ({"platform_joints_mm": [[0, 0]] * 6}, ShapeError, "shape"),
        ({"platform_joints_mm": [["a", 0, 0]] * 6}, ShapeError, "does not hold"),
        ({"base_joints_mm": METRES}, UnitError, "look like metres"),
        ({"platform_joints_mm": MICROMETRES}, UnitError, "look like micrometres"),
        ({"base_joints_mm": TWICE}, InputError, "joints 1 and 2 are the same point"),
        ({"base_joints_m": METRES}, UnitError, "another unit or none"),
        ({"legs": 6}, InputError, "unknown key 'legs'"),
        ({"joint_sigma_mm": 100.0}, UnitError, "micrometres meant"),
        ({"joint_sigma_mm": "0.1"}, InputError, "a number is needed"),
        ({"joint_sigma_mm": True}, InputError, "a number is needed"),
        ({"leg_sigma_mm": -0.1}, InputError, "standard deviation >= 0"),
        ({"leg_limits_mm": [300, 200]}, InputError, "shortest, longest"),
        ({"repeatability": {"t_um": 0.5}}, InputError, "unknown key 't_um'"),
        ({"repeatability": 0.5}, InputError, "object with t_mm"),
        ({"schema": "tomopose/hexapod/2"}, SchemaVersionError, "newer than 1"),
        ({"schema": "tomopose/scanner/1"}, SchemaVersionError, "describes no manipulator"),
        ({"schema": ...}, SchemaVersionError, "describes no manipulator"),
    ],
)
def test_bad_hexapod_files_are_named(
    changes: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    path = write(tmp_path, changed(hexapod_document(), **changes))
    with pytest.raises(error, match=message) as caught:
        read_manipulator(path)
    assert str(path) in str(caught.value)


def joint(**changes: Any) -> dict[str, Any]:
    joints = robot_document()["joints"]
    return {"joints": [changed(joints[0], **changes), *joints[1:]]}


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"joints": []}, ShapeError, "one object for each joint"),
        ({"convention": ...}, InputError, "must be declared"),
        ({"convention": "craig"}, InputError, "must be declared"),
        ({"q_start_deg": [0, 0]}, ShapeError, "q_start_deg"),
        ({"tool": np.eye(3).tolist()}, ShapeError, "tool"),
        (joint(a_mm=...), InputError, "joint 1: the key 'a_mm' is missing"),
        (joint(a_m=0.075), UnitError, "another unit or none"),
        (joint(alpha_deg=-1.5708), UnitError, "were radians meant"),
        (joint(d_mm=float("1e7")), UnitError, "look like micrometres"),
        (joint(kind="round"), InputError, "turning or sliding"),
        (joint(sigma={"a": 0.2}), InputError, "sigma has the unknown key 'a'"),
        (joint(sigma={"alpha_mm": 0.2}), InputError, "sigma has the unknown key 'alpha_mm'"),
        ({"joints": [1, 2]}, InputError, "no object"),
    ],
)
def test_bad_robot_files_are_named(
    changes: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        read_manipulator(write(tmp_path, changed(robot_document(), **changes)))


def test_confirmed_units_are_believed(tmp_path: Path) -> None:
    document = changed(hexapod_document(), base_joints_mm=METRES, units="confirmed")
    assert isinstance(read_manipulator(write(tmp_path, document)), Hexapod)


def test_no_file_and_no_json(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="does not exist"):
        read_manipulator(tmp_path / "none.json")
    (tmp_path / "text.json").write_text("hexapod", encoding="utf-8")
    with pytest.raises(FileError, match="no JSON"):
        read_manipulator(tmp_path / "text.json")
