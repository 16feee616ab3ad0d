"""hexapod.json and robot.json: the nominal machine and how far its parts may be off."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, SchemaVersionError, ShapeError, UnitError
from tomopose.files import read_json, require_absent, write_json
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.real_poses import Repeatability
from tomopose.manipulator.serial import ERRORS, Joint, JointKind, SerialRobot
from tomopose.provenance import Provenance
from tomopose.reading import reader
from tomopose.units import Array

SMALLEST_PLATE_MM, LARGEST_PLATE_MM = 5.0, 5000.0
"""A plate's joints spread over less are taken for metres, over more for micrometres."""
SMALLEST_REACH_MM, LARGEST_REACH_MM = 20.0, 20000.0
LARGEST_JOINT_SIGMA_MM = 20.0
WHOLE_DEG = 0.1
"""Limits of a joint that come this near to whole degrees when they are read as rad, and are none as they are."""
CONFIRM = 'convert them, or add "units": "confirmed" if the numbers are right'

HEXAPOD_KEYS = (
    "schema",
    "base_joints_mm",
    "platform_joints_mm",
    "joint_sigma_mm",
    "leg_sigma_mm",
    "scale_sigma",
    "geometry_sigma",
    "leg_scale_sigma",
    "axes_sigma_rad",
    "pivot_sigma_mm",
    "leg_limits_mm",
    "repeatability",
    "units",
    "name",
    "comment",
    "provenance",
)
SERIAL_KEYS = (
    "schema",
    "convention",
    "joints",
    "tool",
    "q_start_deg",
    "repeatability",
    "units",
    "name",
    "comment",
    "provenance",
)
JOINT_KEYS = ("a_mm", "alpha_deg", "d_mm", "theta_offset_deg", "kind", "sigma", "limits_deg", "limits_mm", "name")


@reader("manipulator file")
def read_manipulator(path: str | Path) -> Hexapod | SerialRobot:
    """The machine of a hexapod.json or robot.json.

    Raises FileError or SchemaVersionError where it is no such file; ShapeError, UnitError or InputError where a joint
    is missing, a unit or key is unknown, or numbers belong to another unit.
    """
    found = {}
    for name, make in (("hexapod", hexapod_from_document), ("serial", serial_from_document)):
        try:
            return make(read_json(path, name), str(path))
        except SchemaVersionError as error:
            found[name] = error
        except InputError as error:
            raise error if str(path) in str(error) else type(error)(f"{path}: {error}") from error
    newer = [error for error in found.values() if "newer" in str(error)]
    if newer:
        raise newer[0]
    if "tomopose/twin/" in str(found["hexapod"]):
        raise SchemaVersionError(f"{path} describes twin robots; give it as --twin, with --source-poses", path=path)
    raise SchemaVersionError(
        f'{path} describes no manipulator: "schema" must be "tomopose/hexapod/1" or "tomopose/serial/1"', path=path
    )


def write_manipulator(
    path: str | Path, machine: Hexapod | SerialRobot, *, force: bool = False, provenance: Provenance | None = None
) -> None:
    """Write hexapod.json or robot.json; `read_manipulator` gives the same machine."""
    content = {**machine.to_json(), **({} if provenance is None else {"provenance": provenance.to_json()})}
    write_json(require_absent(path, force=force), machine.kind, content)


def hexapod_from_document(document: Mapping[str, Any], where: str) -> Hexapod:
    """A hexapod from the content of hexapod.json."""
    require_keys(document, HEXAPOD_KEYS, where, {"base_joints_m", "platform_joints_m", "base_joints"})
    joints = {name: _joints(document, name, where) for name in ("base_joints_mm", "platform_joints_mm")}
    confirmed = document.get("units") == "confirmed"
    for name, xyz in joints.items():
        size = float(np.ptp(xyz, axis=0).max())
        if not confirmed and size < SMALLEST_PLATE_MM:
            raise UnitError(
                f"{where}: {name} spreads over {size:.4g} mm only; these look like metres ({size * 1000:.4g} mm); "
                f"{CONFIRM}"
            )
        if not confirmed and size > LARGEST_PLATE_MM:
            raise UnitError(
                f"{where}: {name} spreads over {size:.4g} mm; these look like micrometres ({size / 1000:.4g} mm); "
                f"{CONFIRM}"
            )
        apart = np.linalg.norm(xyz[:, None] - xyz, axis=2) + np.eye(6) * 1e9
        _require_distinct(apart, name, where)
    sigma = {
        key: _number(document, key, default, where)
        for key, default in (
            ("joint_sigma_mm", 0.1),
            ("leg_sigma_mm", 0.1),
            ("scale_sigma", 0.05),
            ("geometry_sigma", 0.05),
            ("leg_scale_sigma", 0.0),
            ("axes_sigma_rad", 0.0),
            ("pivot_sigma_mm", 0.0),
        )
    }
    for key in ("joint_sigma_mm", "leg_sigma_mm"):
        if not confirmed and sigma[key] > LARGEST_JOINT_SIGMA_MM:
            raise UnitError(f"{where}: {key} is {sigma[key]:g} mm; were micrometres meant? {CONFIRM}")
    limits = document.get("leg_limits_mm")
    if limits is not None:
        limits = vector(limits, (2,), "leg_limits_mm", where)
        if not limits[0] < limits[1]:
            raise InputError(f"{where}: leg_limits_mm is {limits.tolist()}; (shortest, longest) is needed")
    return Hexapod(
        base_joints=joints["base_joints_mm"],
        platform_joints=joints["platform_joints_mm"],
        joint_sigma=sigma["joint_sigma_mm"],
        leg_sigma=sigma["leg_sigma_mm"],
        scale_sigma=sigma["scale_sigma"],
        geometry_sigma=sigma["geometry_sigma"],
        leg_scale_sigma=sigma["leg_scale_sigma"],
        axes_sigma=sigma["axes_sigma_rad"],
        pivot_sigma=sigma["pivot_sigma_mm"],
        leg_limits=None if limits is None else (float(limits[0]), float(limits[1])),
        repeatability=_repeatability(document, where),
    )


def serial_from_document(document: Mapping[str, Any], where: str) -> SerialRobot:
    """A serial robot from the content of robot.json."""
    require_keys(document, SERIAL_KEYS, where, {"q_start_rad", "tool_mm"})
    joints = document.get("joints")
    if not isinstance(joints, list) or not joints:
        raise ShapeError(f'{where}: "joints" is needed, a list with one object for each joint')
    confirmed = document.get("units") == "confirmed"
    made = tuple(_joint(j, f"{where}: joint {k + 1}", confirmed) for k, j in enumerate(joints))
    reach = float(sum(abs(j.a) + abs(j.d) for j in made))
    # Axes that meet in one point, as a C-arm's do, have no length that could be in a wrong unit.
    if reach and not confirmed and not SMALLEST_REACH_MM <= reach <= LARGEST_REACH_MM:
        meant = "metres" if reach < SMALLEST_REACH_MM else "micrometres"
        raise UnitError(f"{where}: the links add up to {reach:.4g} mm; these look like {meant}; {CONFIRM}")
    convention = document.get("convention")
    if convention not in ("dh", "modified-dh"):
        raise InputError(f'{where}: "convention" is {convention!r}; "dh" or "modified-dh" must be declared')
    q_start = document.get("q_start_deg")
    if q_start is not None:
        q_start = vector(q_start, (len(made),), "q_start_deg", where)
        q_start = np.where([j.kind == "turning" for j in made], np.radians(q_start), q_start)
    tool = document.get("tool")
    return SerialRobot(
        joints=made,
        convention=convention,
        tool=None if tool is None else vector(tool, (4, 4), "tool", where),
        q_start=q_start,
        repeatability=_repeatability(document, where),
    )


def _joint(block: object, where: str, confirmed: bool) -> Joint:
    if not isinstance(block, Mapping):
        raise InputError(f"{where} is no object with a_mm, alpha_deg, d_mm, theta_offset_deg")
    require_keys(block, JOINT_KEYS, where, {"a_m", "d_m", "alpha_rad", "theta_offset_rad", "a", "alpha", "d"})
    numbers = {key: _number(block, key, None, where) for key in ("a_mm", "alpha_deg", "d_mm")}
    offset = _number(block, "theta_offset_deg", 0.0, where)
    for key, angle in (("alpha_deg", numbers["alpha_deg"]), ("theta_offset_deg", offset)):
        # right angles are what twists and offsets usually are: one that is pi/2 or pi "deg" was meant in radians
        if not confirmed and any(abs(abs(angle) - k * np.pi / 2) < 1e-3 for k in (1, 2, 3)):
            raise UnitError(f"{where}: {key} is {angle:g}, a multiple of pi/2; were radians meant? {CONFIRM}")
    kind = block.get("kind", "turning")
    if kind not in get_args(JointKind):
        raise InputError(f"{where}: kind is {kind!r}; {' or '.join(get_args(JointKind))} is needed")
    sigma = {}
    for key, value in dict(block.get("sigma", {})).items():
        name, _, unit = str(key).rpartition("_")
        wanted = {"mm": "mm", "rad": "deg"}.get(ERRORS.get(name, ""), "")
        if not wanted or unit != wanted:
            known = ", ".join(f"{n}_{'mm' if u == 'mm' else 'deg'}" for n, u in ERRORS.items())
            raise InputError(f"{where}: sigma has the unknown key {key!r}; known are {known}")
        number = _finite(value, f"sigma {key}", where)
        sigma[name] = number if wanted == "mm" else float(np.radians(number))
    return Joint(
        a=numbers["a_mm"],
        alpha=float(np.radians(numbers["alpha_deg"])),
        d=numbers["d_mm"],
        theta_offset=float(np.radians(offset)),
        kind=kind,
        sigma=sigma,
        limits=_limits(block, kind, where, confirmed),
    )


def _limits(block: Mapping[str, Any], kind: str, where: str, confirmed: bool) -> tuple[float, float] | None:
    """(lowest, highest) joint value, rad or mm."""
    key, other = ("limits_deg", "limits_mm") if kind == "turning" else ("limits_mm", "limits_deg")
    if other in block:
        raise UnitError(f"{where}: a {kind} joint has {key}, not {other}")
    if key not in block:
        return None
    low, high = vector(block[key], (2,), key, where).tolist()
    if not low < high:
        raise InputError(f"{where}: {key} is [{low:g}, {high:g}]; [lowest, highest] is needed")
    if kind == "turning" and not confirmed and _look_like_radians((low, high)):
        raise UnitError(f"{where}: {key} is [{low:g}, {high:g}], whole degrees if they are rad; {CONFIRM}")
    return (float(np.radians(low)), float(np.radians(high))) if kind == "turning" else (low, high)


def _look_like_radians(limits: tuple[float, float]) -> bool:
    if max(abs(x) for x in limits) > 2 * np.pi + 1e-3 or all(float(x).is_integer() for x in limits):
        return False
    return all(abs(np.degrees(x) - round(np.degrees(x))) < WHOLE_DEG for x in limits)


def _repeatability(document: Mapping[str, object], where: str) -> Repeatability:
    block = document.get("repeatability")
    if block is None:
        return Repeatability()
    if not isinstance(block, Mapping):
        raise InputError(f'{where}: "repeatability" is an object with t_mm and w_rad')
    require_keys(block, ("t_mm", "w_rad"), f"{where}: repeatability", set())
    standard = Repeatability()
    return Repeatability(
        t_mm=_number(block, "t_mm", standard.t_mm, where), w_rad=_number(block, "w_rad", standard.w_rad, where)
    )


def _joints(document: Mapping[str, object], name: str, where: str) -> Array:
    rows = document.get(name)
    if not isinstance(rows, list):
        raise ShapeError(f"{where}: {name} is needed: six joints of three coordinates, mm")
    if len(rows) != 6:
        raise ShapeError(f"{where}: {name} holds {len(rows)} joints; a hexapod has 6")
    return vector(rows, (6, 3), name, where)


def _require_distinct(apart: Array, name: str, where: str) -> None:
    i, j = np.unravel_index(int(np.argmin(apart)), apart.shape)
    if apart[i, j] < 1e-6:
        raise InputError(f"{where}: {name}: joints {i + 1} and {j + 1} are the same point; one of them is mistyped")


def require_keys(document: Mapping[str, object], known: Iterable[str], where: str, other_units: set[str]) -> None:
    """InputError for an unknown key, UnitError for one of `other_units`."""
    known = tuple(known)
    for key in document:
        if key in known:
            continue
        if key in other_units:
            raise UnitError(f"{where}: the key {key!r} has another unit or none; known are {', '.join(known)}")
        raise InputError(f"{where}: unknown key {key!r}; known are {', '.join(known)}")


def _number(document: Mapping[str, object], key: str, default: float | None, where: str) -> float:
    if key not in document:
        if default is None:
            raise InputError(f"{where}: the key {key!r} is missing")
        return default
    return _finite(document[key], key, where)


def _finite(value: object, key: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise InputError(f"{where}: {key} is {value!r}; a number is needed")
    return float(value)


def vector(value: ArrayLike, shape: tuple[int, ...], name: str, where: str) -> Array:
    """Finite numbers of that shape, or ShapeError or InputError."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{where}: {name} does not hold {' x '.join(map(str, shape))} numbers") from error
    if array.shape != shape:
        raise ShapeError(f"{where}: {name} has shape {array.shape}; {shape} is needed")
    if not np.isfinite(array).all():
        raise InputError(f"{where}: {name} holds values that are not finite")
    return array
