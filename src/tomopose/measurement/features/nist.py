"""Reader of NIST's "L2 reference pairs": points (.ds) with reference least-squares fits (.fit).

Origin: https://www.nist.gov/pml/sensor-science/dimensional-metrology/algorithm-testing; 240 pairs are free there.  The
line order of a .fit: plane and line point, direction; circle centre, normal, diameter; sphere centre, diameter;
cylinder axis point, direction, diameter; cone axis point, direction, orthogonal distance from that point, full apex
angle in degrees.  The pairs serve self-checking and do not replace an independent test.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tomopose.errors import FileError
from tomopose.reading import reader
from tomopose.units import Array

FOLDERS = {
    "Plane": "plane",
    "Line3d": "line",
    "Circle3d": "circle",
    "Sphere": "sphere",
    "Cylinder": "cylinder",
    "Cone": "cone",
}
NUMBERS = {"plane": 6, "line": 6, "circle": 7, "sphere": 4, "cylinder": 7, "cone": 8}


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferencePair:
    """points (n, 3) mm and the reference fit: point (3,), direction (3,), diameter mm, distance mm, apex angle rad."""

    kind: str
    points: Array
    point: Array
    direction: Array
    diameter: float = np.nan
    distance: float = np.nan
    apex_angle: float = np.nan

    @property
    def apex(self) -> Array:
        """Apex (3,) of a reference cone: the axis point lies `distance` inside the surface, on the wide side."""
        result: Array = self.point - self.direction * (self.distance / np.sin(self.apex_angle / 2))
        return result


def reference_pairs(folder: str | Path) -> dict[str, Path]:
    """Name -> path of the .ds file, of all pairs below a folder that has one folder a kind."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileError(f"{folder} is no folder; give the one that holds Plane, Sphere, ...", path=folder)
    files = [p for kind in FOLDERS for p in sorted((folder / kind).glob("*.ds"))]
    found = {p.stem: p for p in files if p.with_suffix(".fit").exists()}
    if not found:
        raise FileError(f"{folder} holds no pair of .ds and .fit files", path=folder)
    return found


@reader("reference pair")
def read_reference_pair(path: str | Path) -> ReferencePair:
    """One pair from its .ds file; the .fit lies beside it and the folder's name says the kind."""
    path = Path(path)
    kind = FOLDERS.get(path.parent.name)
    if kind is None:
        raise FileError(f"{path}: the folder must be one of {', '.join(FOLDERS)}", path=path)
    try:
        rows = path.read_text(encoding="ascii").split("\n")
        points = np.array([[float(v) for v in row.split()] for row in rows[1:] if row.strip()])
        fit = np.array([float(v) for v in path.with_suffix(".fit").read_text(encoding="ascii").split()])
        announced = int(rows[0])
    except (OSError, ValueError) as error:
        raise FileError(f"{path} is no readable reference pair: {error}", path=path) from error
    if points.shape != (announced, 3) or fit.shape != (NUMBERS[kind],):
        raise FileError(
            f"{path}: {announced} points announced, {points.shape} found; fit of {len(fit)} numbers where a {kind} has "
            f"{NUMBERS[kind]}",
            path=path,
        )
    if kind == "sphere":
        return ReferencePair(kind=kind, points=points, point=fit[:3], direction=np.full(3, np.nan), diameter=fit[3])
    if kind == "cone":
        return ReferencePair(
            kind=kind, points=points, point=fit[:3], direction=fit[3:6], distance=fit[6], apex_angle=np.radians(fit[7])
        )
    diameter = fit[6] if len(fit) > 6 else np.nan
    return ReferencePair(kind=kind, points=points, point=fit[:3], direction=fit[3:6], diameter=diameter)
