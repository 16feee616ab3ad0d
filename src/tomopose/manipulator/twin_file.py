"""twin.json: two robots, one with the source, one with the detector, as they are in the drawing.

    {"schema": "tomopose/twin/1",
     "detector": "robot.json",             the robot's file beside this one, its content, or null: it is trusted
     "source": "robot.json",
     "base": {"t_mm": [1500, 0, 0], "angles_deg": [0, 0, 180], "sigma_t_mm": 20, "sigma_deg": 1.1},
     "focus_mm": [0, 0, 120], "focus_sigma_mm": 5,
     "panel": {"origin_mm": [0, 0, 100], "u_axis": [1, 0, 0], "v_axis": [0, -1, 0]}}

base: pose of the source robot's base in that of the detector's, R = R_x R_y R_z.  focus_mm: focal spot on the flange of
the source's robot.  panel, on the flange of the detector's robot: where the pixel (u_0, v_0) of scanner.json lies, and
the directions in which u and v grow.  These are starts; what is found replaces them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import InputError, SchemaVersionError, UnitError
from tomopose.files import read_json
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import rotation_from_angles
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.files import (
    hexapod_from_document,
    read_manipulator,
    require_keys,
    serial_from_document,
    vector,
)
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel
from tomopose.manipulator.twin import TwinRobots
from tomopose.reading import reader
from tomopose.units import Array, float_array
from tomopose.values import value

KEYS = (
    "schema",
    "detector",
    "source",
    "base",
    "focus_mm",
    "focus_sigma_mm",
    "panel",
    "units",
    "name",
    "comment",
    "provenance",
)
OTHER_UNITS = {"focus_m", "focus", "focus_sigma_m"}
BASE_KEYS, PANEL_KEYS = ("t_mm", "angles_deg", "sigma_t_mm", "sigma_deg"), ("origin_mm", "u_axis", "v_axis")
SQUARE = 1e-3
"""Largest cosine between the panel's axes."""
NEAREST_BASES_MM = 20.0
"""Two robots whose bases are nearer to each other are drawn in metres."""
CONFIRM = 'convert them, or add "units": "confirmed" if the numbers are right'


@value
class TwinDrawing:
    """Twin robots before a run: machines (None: trusted), nominal setup, and the panel's place on its flange.

    origin (3,) mm, u_axis, v_axis (3,): unit vectors on the detector's flange.  Else as in `TwinRobots`.
    """

    detector: ErrorModel | None
    source: ErrorModel | None
    base: RigidTransform
    focus: Array
    origin: Array
    u_axis: Array
    v_axis: Array
    base_t_sigma: float = 20.0
    base_w_sigma: float = 0.02
    focus_sigma: float = 5.0

    def robots(self, source_poses: PoseSequence) -> TwinRobots:
        """The twins with the poses of the source's flange in its own base."""
        return TwinRobots(
            detector=self.detector,
            source=self.source,
            source_poses=source_poses,
            base=self.base,
            focus=self.focus,
            base_t_sigma=self.base_t_sigma,
            base_w_sigma=self.base_w_sigma,
            focus_sigma=self.focus_sigma,
        )

    def mount(self, scanner: Scanner) -> RigidTransform:
        """H (the detector's flange) -> T: S has x against u, y along v, z to the panel, d_SD behind its origin."""
        R = np.stack([-self.u_axis, self.v_axis, np.cross(self.v_axis, self.u_axis)])
        T_HS = RigidTransform(
            R=R, t=np.array([0.0, 0.0, scanner.d_SD]) - R @ self.origin, source=Frame.H, target=Frame.S
        )
        return (scanner.T_WS @ scanner.T_TW(0.0)).inv @ T_HS


@reader("twin.json")
def read_twin(path: str | Path) -> TwinDrawing:
    """Read twin.json.

    Raises FileError or SchemaVersionError where it is no such file; InputError, UnitError, ShapeError naming the key.
    """
    path = Path(path)
    return twin_drawing(read_json(path, "twin"), str(path), folder=path.parent)


def twin_drawing(document: Mapping[str, Any], where: str, *, folder: Path | None = None) -> TwinDrawing:
    """The drawing in a JSON object; folder: where files that it names lie."""
    require_keys(document, KEYS, where, OTHER_UNITS)
    missing = [k for k in ("detector", "source", "base", "focus_mm", "panel") if k not in document]
    if missing:
        raise InputError(
            f"{where}: {', '.join(missing)} missing; twin robots are a detector and a source (a robot's file, its "
            "content, or null where it is trusted), base, focus_mm and panel"
        )
    base, panel = (_object(document, key, keys, where) for key, keys in (("base", BASE_KEYS), ("panel", PANEL_KEYS)))
    for key, block, needed in (("base", base, BASE_KEYS[:2]), ("panel", panel, PANEL_KEYS)):
        lost = [k for k in needed if k not in block]
        if lost:
            raise InputError(f"{where}: {key}: {', '.join(lost)} missing")
    angles, t = (vector(base[k], (3,), k, f"{where}: base") for k in ("angles_deg", "t_mm"))
    if document.get("units") != "confirmed":
        if any(abs(abs(a) - k * np.pi / 2) < 1e-3 for a in angles for k in (1, 2, 3)):
            raise UnitError(f"{where}: base: angles_deg {angles.tolist()} hold a multiple of pi/2, radians? {CONFIRM}")
        if 0 < np.linalg.norm(t) < NEAREST_BASES_MM:
            raise UnitError(f"{where}: base: the bases are {np.linalg.norm(t):.4g} mm apart, metres? {CONFIRM}")
    u, v = (_direction(panel[k], f"{where}: panel: {k}") for k in PANEL_KEYS[1:])
    if abs(u @ v) > SQUARE:
        raise InputError(
            f"{where}: panel: u_axis and v_axis form an angle of {np.degrees(np.arccos(u @ v)):.4g} deg, not 90"
        )
    v = v - (u @ v) * u
    machines = {who: _machine(document[who], f"{where}: {who}", folder) for who in ("detector", "source")}
    return TwinDrawing(
        **machines,
        base=RigidTransform(R=rotation_from_angles(np.radians(angles)), t=t, source=Frame.H, target=Frame.H),
        focus=vector(document["focus_mm"], (3,), "focus_mm", where),
        origin=vector(panel["origin_mm"], (3,), "origin_mm", f"{where}: panel"),
        u_axis=float_array(u),
        v_axis=float_array(v / np.linalg.norm(v)),
        base_t_sigma=_sigma(base, "sigma_t_mm", 20.0, f"{where}: base"),
        base_w_sigma=float(np.radians(_sigma(base, "sigma_deg", float(np.degrees(0.02)), f"{where}: base"))),
        focus_sigma=_sigma(document, "focus_sigma_mm", 5.0, where),
    )


def _machine(value: object, where: str, folder: Path | None) -> ErrorModel | None:
    if value is None:
        return None
    if isinstance(value, str):
        return read_manipulator((folder or Path()) / value)
    if isinstance(value, Mapping):
        schema = str(value.get("schema", ""))
        if "/serial/" in schema:
            return serial_from_document(value, where)
        if "/hexapod/" in schema:
            return hexapod_from_document(value, where)
        raise SchemaVersionError(f'{where}: "schema" must be "tomopose/serial/1" or "tomopose/hexapod/1"')
    raise InputError(f"{where} is {value!r}; the name of a robot's file, its content, or null is needed")


def _object(document: Mapping[str, object], key: str, known: tuple[str, ...], where: str) -> Mapping[str, Any]:
    block = document[key]
    if not isinstance(block, Mapping):
        raise InputError(f"{where}: {key} is an object with {', '.join(known)}")
    require_keys(block, known, f"{where}: {key}", {"t_m", "t", "angles_rad", "angles", "origin_m", "origin"})
    return block


def _direction(value: Any, where: str) -> Array:
    x = vector(value, (3,), "the direction", where)
    length = float(np.linalg.norm(x))
    if length == 0:
        raise InputError(f"{where} is {list(value)}; a direction has a length")
    return x / length


def _sigma(block: Mapping[str, object], key: str, default: float, where: str) -> float:
    value = block.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (np.isfinite(value) and value > 0):
        raise InputError(f"{where}: {key} is {value!r}; a standard deviation > 0 is needed")
    return float(value)
