"""Which column of somebody's table is what: names in many spellings to roles, units and conventions."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tomopose.errors import ConventionError, InputError, UnitError
from tomopose.geometry.rotations import CONVENTIONS, Convention, convention_named

UNIT_OF_HEADER = re.compile(
    r"^(?P<name>.*?)[\s_]*(?:[\[(/]\s*|[\s_]+(?:in\s+)?)(?P<unit>mm|m|cm|um|µm|μm|nm|inch|in|deg|degree|degrees|°|rad|mrad)"
    r"\s*[\])]?$",
    re.IGNORECASE,
)
SET_SUFFIX = re.compile(r"[_\s](set|soll|cmd|commanded|target|nominal)$", re.IGNORECASE)
NAMES: Mapping[str, tuple[str, ...]] = {
    "pose_id": ("pose_id", "pose", "id", "nr", "no", "number", "index", "idx", "point", "punkt", "n", "#", "name"),
    "image": ("image", "file", "filename", "image_file", "bild", "picture", "frame_file", "projection"),
    "alpha": ("alpha", "table", "table_angle", "turntable", "drehtisch", "rotary_table", "rotation_angle"),
    "ball_id": ("ball_id", "ball", "sphere", "kugel"),
    "time": ("time_utc", "time", "timestamp", "datetime", "date_time", "zeit", "zeitstempel", "t"),
}
POSITION: Mapping[str, tuple[str, ...]] = {
    k: (k, f"t{k}", f"pos_{k}", f"{k}_pos", f"position_{k}", f"p{k}") for k in ("x", "y", "z")
}
ANGLE_SETS: Mapping[tuple[str, ...], tuple[str, ...]] = {
    ("u", "v", "w"): ("pi-hexapod",),
    ("a", "b", "c"): ("kuka",),
    ("w", "p", "r"): ("fanuc",),
    ("o", "a", "t"): ("kawasaki",),
    ("q1", "q2", "q3", "q4"): ("abb",),
    ("qw", "qx", "qy", "qz"): ("quaternion-wxyz",),
    ("qx", "qy", "qz", "qw"): ("quaternion-xyzw",),
    ("rx", "ry", "rz"): ("pi-hexapod", "symetrie-hexapod", "yaskawa", "staubli", "ur"),
}
"""Orientation columns by their names, and the conventions that write them; where there are several, the caller says
which.
"""


@dataclass(frozen=True)
class Column:
    """A column of a table: its place, its name without unit, its unit ("" where none is stated), set or
    measured.
    """

    index: int
    header: str
    name: str
    unit: str
    commanded: bool


def columns_of(headers: Sequence[str], units_row: Sequence[str] | None = None) -> list[Column]:
    """Headers such as `X_mm`, `X [mm]`, `X (mm)`, `x_set_mm` as columns."""
    out = []
    for k, header in enumerate(headers):
        text, unit = header.strip().strip('"'), ""
        if (found := UNIT_OF_HEADER.match(text)) and found["name"]:
            text, unit = found["name"], _unit(found["unit"])
        if units_row is not None and not unit:
            unit = _unit(units_row[k].strip().strip("[]()"))
        commanded = SET_SUFFIX.search(text) is not None
        name = re.sub(r"[\s.\-]+", "_", SET_SUFFIX.sub("", text).strip().lower()).strip("_")
        out.append(Column(k, header, name, unit, commanded))
    return out


def _unit(word: str) -> str:
    word = word.lower()
    return {"°": "deg", "degree": "deg", "degrees": "deg", "μm": "um", "µm": "um", "in": "inch"}.get(word, word)


def plain_role(columns: Sequence[Column], role: str) -> Column | None:
    """The column of a plain role (pose_id, image, alpha, ball_id, time) by its known names, the surest name first."""
    for name in NAMES[role]:
        for column in columns:
            if column.name == name and not column.commanded:
                return column
    return None


def position_columns(columns: Sequence[Column], *, commanded: bool) -> list[Column] | None:
    """The columns of x, y, z; None unless all three are there."""
    found = []
    for names in POSITION.values():
        column = next((c for c in columns for n in names if c.name == n and c.commanded == commanded), None)
        if column is None:
            return None
        found.append(column)
    return found


def angle_columns(columns: Sequence[Column], convention: Convention, *, commanded: bool) -> list[Column] | None:
    """The orientation columns of a convention; None unless all are there."""
    stems = [c.rpartition("_")[0] or c for c in convention.columns]
    for names in (stems, *(s for s, owners in ANGLE_SETS.items() if convention.name in owners)):
        found = [next((c for c in columns if c.name == n and c.commanded == commanded), None) for n in names]
        if all(c is not None for c in found):
            return [c for c in found if c is not None]
    return None


def convention_of(columns: Sequence[Column], path: object) -> tuple[Convention, str]:
    """The convention that the names of the orientation columns show, and the remark about it.

    ConventionError, with the line to type, where several makers use those names; InputError where no set is there.
    """
    names = {c.name for c in columns if not c.commanded}
    for stems, owners in ANGLE_SETS.items():
        if not set(stems) <= names:
            continue
        if len(owners) == 1:
            c = CONVENTIONS[owners[0]]
            return c, f"columns {', '.join(stems)} are read as {c.name} ({c.source}); --convention NAME says otherwise"
        units = {c.unit for c in columns if c.name in stems}
        if units == {"rad"}:
            return CONVENTIONS["ur"], "rx, ry, rz in rad are read as a rotation vector; --convention says otherwise"
        raise ConventionError(
            f"{path}: rotations {', '.join(stems)} mean different things to different makers; say whose they are: "
            f"--convention {' | '.join(owners)}"
        )
    raise InputError(
        f"{path}: no orientation columns were recognised among {', '.join(c.header for c in columns)}; name them: "
        "--convention kuka --columns x=X,y=Y,z=Z,a=A,b=B,c=C (with your columns behind the =)"
    )


def chosen_columns(
    columns: Sequence[Column], wanted: Mapping[str, str], convention: Convention
) -> tuple[list[Column], list[Column], dict[str, Column]]:
    """The columns that the caller names: positions, orientations, and the rest by role."""
    by_header = {c.header.strip().strip('"'): c for c in columns} | {str(c.index + 1): c for c in columns}
    by_name = {c.name: c for c in columns}
    roles: dict[str, Column] = {}
    for role, header in wanted.items():
        column = by_header.get(header) or by_name.get(header.strip().lower())
        if column is None:
            raise InputError(
                f"--columns {role}={header}: there is no column {header!r}; there are "
                f"{', '.join(c.header for c in columns)}"
            )
        roles[role.lower()] = column
    stems = [c.rpartition("_")[0] or c for c in convention.columns]
    other = next((s for s, owners in ANGLE_SETS.items() if convention.name in owners and set(s) <= set(roles)), None)
    plain = [f"r{k}" for k in range(1, len(stems) + 1)]
    names = next((n for n in (stems, list(other or ()), plain) if n and all(k in roles for k in n)), None)
    position = [roles.pop(k) for k in ("x", "y", "z") if k in roles]
    if len(position) < 3 or names is None:
        raise InputError(
            f"--columns must name x, y, z and {', '.join(stems)} (or r1, r2, ...) of convention {convention.name}; "
            f"it names {', '.join(wanted)}"
        )
    angles = [roles.pop(k) for k in names]
    unknown = [r for r in roles if r not in NAMES]
    if unknown:
        raise InputError(
            f"--columns: unknown role {unknown[0]!r}; known are x, y, z, {', '.join(stems)}, {', '.join(NAMES)}"
        )
    return position, angles, roles


def length_unit(columns: Sequence[Column], given: str | None, path: object) -> tuple[str, str]:
    """The one unit of the position columns and a remark where nobody stated it; UnitError where they differ."""
    units = {c.unit for c in columns}
    if len(units) > 1:
        raise UnitError(f"{path}: positions are in {' and '.join(sorted(u or 'no unit' for u in units))}")
    unit = units.pop()
    if unit and given and unit != given:
        raise UnitError(f"{path}: the header says {unit}, --units {given}")
    if unit or given:
        return unit or given or "mm", ""
    return "mm", "the position columns state no unit; mm is taken (--units m says otherwise)"


def angle_unit(columns: Sequence[Column], convention: Convention, path: object) -> str:
    """The unit of the orientation columns: the header's, or else the convention's own."""
    units = {c.unit for c in columns}
    if len(units) > 1:
        raise UnitError(f"{path}: orientations are in {' and '.join(sorted(u or 'no unit' for u in units))}")
    return units.pop() or convention.unit


def named_convention(name: str | None) -> Convention | None:
    """The convention of that name, None for none."""
    return None if name is None else convention_named(name)
