"""limits.toml: what the machine may do, and what the part must stay clear of.

[travel]
x_mm = [-10, 10]            # y_mm, z_mm, rx_deg, ry_deg, rz_deg, alpha_deg
[time]
speed_mm_s = 2              # speed_deg_s, settle_s, image_s, limit_s
[keep_out]
tube = {file = "tube.stl", frame = "W"}
plate = {box = [[-60, -60, -40], [60, 60, -25]], frame = "T"}      # lower and upper corner, mm
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from tomopose.errors import FileError, InputError
from tomopose.geometry.box import BOX_CORNERS
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.mesh.mesh_files import read_mesh
from tomopose.planning.part.keep_out import Obstacle
from tomopose.reading import parse_toml, read_text, reader
from tomopose.trajectory.feasibility import TravelLimits

AXES = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg", "alpha_deg")
TIME = ("speed_mm_s", "speed_deg_s", "settle_s", "image_s", "limit_s")
DEFAULT_MM, DEFAULT_DEG = 10.0, 5.0
"""Travel of a hexapod's axes that the file does not name: the paper's, sec. 4.1."""


@dataclass(frozen=True, kw_only=True)
class MoveTime:
    """speed: mm/s and speed_deg: deg/s of every axis;  settle: s after a move;  image: s an image;  limit: s for
    all."""

    speed: float = 2.0
    speed_deg: float = 5.0
    settle: float = 0.5
    image: float = 1.0
    limit: float = math.inf

    def __post_init__(self) -> None:
        for name in ("speed", "speed_deg", "limit"):
            if not getattr(self, name) > 0:
                raise InputError(f"limits: [time] {name} is {getattr(self, name)}; a positive number is needed")
        for name in ("settle", "image"):
            if not getattr(self, name) >= 0:
                raise InputError(f"limits: [time] {name} is {getattr(self, name)}; a number from 0 is needed")


def default_travel() -> TravelLimits:
    """+-10 mm, +-5 deg, and a table that turns freely."""
    return _travel({})


@dataclass(frozen=True, kw_only=True)
class ScanLimits:
    """travel of the axes, times, obstacles;  assumed: axes whose travel the file did not name."""

    travel: TravelLimits = field(default_factory=default_travel)
    time: MoveTime = field(default_factory=MoveTime)
    obstacles: tuple[Obstacle, ...] = ()
    assumed: tuple[str, ...] = AXES


def _interval(name: str, given: object) -> tuple[float, float]:
    if not (isinstance(given, list) and len(given) == 2 and all(isinstance(v, (int, float)) for v in given)):
        raise InputError(f"limits: {name} is {given!r}; [low, high] is needed")
    low, high = (float(v) for v in given)
    if math.isnan(low) or math.isnan(high):
        raise InputError(f"limits: {name} is {given!r}, which is not a number")
    if low > high:
        raise InputError(
            f"limits: {name} contradicts itself: its lower limit {low:g} is above its upper limit {high:g}"
        )
    return low, high


def _travel(given: dict[str, object]) -> TravelLimits:
    unknown = sorted(set(given) - set(AXES))
    if unknown:
        raise InputError(f"limits: [travel] does not know {', '.join(unknown)}; it knows {', '.join(AXES)}")
    bounds = []
    for name in AXES:
        default = [0.0, 360.0] if name == "alpha_deg" else [-1.0, 1.0]
        size = 1.0 if name == "alpha_deg" else DEFAULT_MM if name.endswith("_mm") else DEFAULT_DEG
        bounds.append(_interval(name, given.get(name, [size * v for v in default])))
    low, high = (np.array([b[k] for b in bounds]) for k in (0, 1))
    for side in (low, high):
        side[3:] = np.radians(side[3:])
    return TravelLimits(low=low, high=high)


def _time(given: dict[str, object]) -> MoveTime:
    unknown = sorted(set(given) - set(TIME))
    if unknown:
        raise InputError(f"limits: [time] does not know {', '.join(unknown)}; it knows {', '.join(TIME)}")
    numbers = {k: v for k, v in given.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    wrong = sorted(set(given) - set(numbers))
    if wrong:
        raise InputError(f"limits: [time] {wrong[0]} is {given[wrong[0]]!r}; a number is needed")
    names = {
        "speed_mm_s": "speed",
        "speed_deg_s": "speed_deg",
        "settle_s": "settle",
        "image_s": "image",
        "limit_s": "limit",
    }
    return MoveTime(**{names[k]: float(v) for k, v in numbers.items()})


def _obstacle(name: str, given: object, folder: Path) -> Obstacle:
    keys = set(given) - {"frame"} if isinstance(given, dict) else set()
    if not isinstance(given, dict) or keys not in ({"file"}, {"box"}) or not isinstance(given.get("file", ""), str):
        raise InputError(
            f'limits: [keep_out] {name} is {given!r}; {{file = "tube.stl", frame = "W"}} or {{box = [[x, y, z], '
            '[x, y, z]], frame = "W"}, with the lower and the upper corner in mm, is needed'
        )
    frame = given.get("frame", "W")
    if frame not in ("W", "T"):
        raise InputError(f"limits: [keep_out] {name}: frame is {frame!r}; W (fixed) or T (on the table) is needed")
    mesh = _box(name, given["box"]) if "box" in given else read_mesh(folder / given["file"])
    return Obstacle(name=name, mesh=mesh, frame=frame)


def _box(name: str, given: object) -> Mesh:
    """The twelve triangles of a box from its lower and upper corner."""
    try:
        corners = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.full((2, 3), np.nan)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or (corners[0] >= corners[1]).any():
        raise InputError(
            f"limits: [keep_out] {name}: box is {given!r}; [[x, y, z], [x, y, z]], lower corner first, is needed"
        )
    hull = ConvexHull(corners.mean(axis=0) + BOX_CORNERS * np.ptp(corners, axis=0) / 2)
    a, b, c = (hull.points[hull.simplices[:, k]] for k in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    return Mesh(points=hull.points, faces=np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices))


@reader("limits")
def read_limits(path: str | Path) -> ScanLimits:
    """limits.toml as ScanLimits.  FileError where it is missing or not TOML, InputError for what it may not say."""
    path = Path(path)
    document = parse_toml(read_text(path), path)
    unknown = sorted(set(document) - {"travel", "time", "keep_out"})
    if unknown:
        raise InputError(f"{path.name}: {', '.join(unknown)} is not known; [travel], [time] and [keep_out] are")
    for name, table in document.items():
        if not isinstance(table, dict):
            raise FileError(f"{path.name}: {name} is {table!r}; a table [{name}] is needed", path=path)
    travel = document.get("travel", {})
    return ScanLimits(
        travel=_travel(travel),
        time=_time(document.get("time", {})),
        obstacles=tuple(_obstacle(k, v, path.parent) for k, v in document.get("keep_out", {}).items()),
        assumed=tuple(a for a in AXES if a not in travel),
    )
