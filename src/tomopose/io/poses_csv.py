"""poses.csv, read: the commanded poses of the manipulator and those of its encoders."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Literal, cast

import numpy as np

from tomopose.errors import ConventionError, InputError, UnitError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import (
    CONVENTIONS,
    Convention,
    convention_named,
    rotation_angle_between,
    rotation_from_convention,
)
from tomopose.geometry.transforms import RigidTransform
from tomopose.io import unit_checks
from tomopose.io.notices import InputWarning
from tomopose.io.table_text import TextTable, read_table, unknown_column
from tomopose.manipulator.poses import PoseSequence
from tomopose.reading import reader
from tomopose.units import Array

POSITION = ("x_mm", "y_mm", "z_mm")
PLAIN = ("pose_id", "alpha_deg", "image", "ball_id", "time_utc")
JOINT = re.compile(r"q([1-9]\d?)_(deg|mm)")
COMMENT_KEYS = ("convention", "pivot_mm", "source", "units")
SET_FAR_MM, SET_FAR_RAD = 0.5, np.radians(0.5)
"""Encoder and set pose further apart than this are no positioning error but rows that do not belong together."""


def set_name(column: str) -> str:
    """The name of a set pose's column: x_mm -> x_set_mm, qw -> qw_set."""
    stem, dash, unit = column.rpartition("_")
    return f"{stem}_set_{unit}" if dash else f"{column}_set"


def pose_columns(convention: Convention, *, commanded: bool = False) -> tuple[str, ...]:
    """The columns of a pose in that convention."""
    names = (*POSITION, *convention.columns)
    return tuple(set_name(c) for c in names) if commanded else names


CONFIRMED = "confirmed"


@reader("pose table")
def read_poses(
    path: str | Path,
    *,
    units_confirmed: bool = False,
    convention_confirmed: bool = False,
    forward: Callable[[Array], RigidTransform] | None = None,
) -> PoseSequence:
    """Read poses.csv.

    Parameters
    ----------
    path:             the table; columns and comment keys as in docs/formats/files.md.
    units_confirmed:  the numbers are right although they look like radians, metres or micrometres.
    convention_confirmed: the orientation columns are in the convention of the table, whatever else fits as well; as
                      `# convention: NAME, confirmed`.
    forward:          joint values q (n, m) (rad, mm) -> T_MH, for tables that hold joints and no pose.

    Raises
    ------
    InputError, UnitError, ConventionError
        Naming row and column: unknown or missing columns, units, conventions; cells that are no numbers; ids that
        repeat; a pivot that changes.
    FileError
        If the file cannot be read.
    """
    found = poses_from_table(read_table(path), units_confirmed=units_confirmed, forward=forward)
    return replace(found, convention_confirmed=True) if convention_confirmed else found


def poses_from_table(
    table: TextTable,
    *,
    units_confirmed: bool = False,
    forward: Callable[[Array], RigidTransform] | None = None,
) -> PoseSequence:
    """The poses of a table that is already read; see `read_poses`."""
    convention = _convention(table)
    source = _source(table)
    joints = _joint_columns(table)
    _require_known(table, convention)
    confirmed = units_confirmed or _units(table, convention)
    measured = _pose(table, convention, commanded=False, confirmed=confirmed)
    commanded = _pose(table, convention, commanded=True, confirmed=confirmed)
    q = None
    if joints:
        turning = [c for c in joints if c.endswith("_deg")]
        if turning and not confirmed:
            values = np.column_stack([table.numbers(c) for c in turning])
            unit_checks.require_joint_degrees(values, f"{table.path}: {turning[0]} ... {turning[-1]}")
        q = np.column_stack([np.radians(table.numbers(c)) if c.endswith("_deg") else table.numbers(c) for c in joints])
        if measured is None and commanded is None and forward is not None:
            measured = forward(q)
    if measured is None and commanded is None:
        raise InputError(
            f"{table.path}: the pose columns {', '.join(pose_columns(convention))} are missing"
            + (", and joint values alone need the robot's forward kinematics (forward=)" if joints else "")
        )
    if commanded is not None and source == "set":
        raise ConventionError(f"{table.path}: '# source: set' makes x_mm ... set poses, but x_set_mm ... are there too")
    if measured is None:
        measured, commanded, source = commanded, None, "set"
    assert measured is not None
    if commanded is not None:
        _warn_if_far(table, measured, commanded)
    alpha = table.numbers("alpha_deg") if "alpha_deg" in table.columns else np.zeros(len(table))
    if not confirmed:
        unit_checks.require_table_degrees(alpha, f"{table.path}: alpha_deg")
    return PoseSequence(
        T_MH=measured,
        pose_id=_pose_id(table),
        alpha=np.radians(alpha),
        ball_id=table.whole_numbers("ball_id") if "ball_id" in table.columns else None,
        image=_image(table),
        time_utc=_time(table),
        T_MH_set=commanded,
        pivot=_pivot(table),
        convention=convention.name,
        source=source,
        q=q,
        orientations=_orientations(table, convention),
        units_confirmed=confirmed,
        convention_confirmed=_confirms_convention(table),
    )


# -- comment lines -----------------------------------------------------------------------------------------------------


def _convention(table: TextTable) -> Convention:
    try:
        return convention_named(without_confirmation(table.comments.get("convention", "pi-hexapod")))
    except ConventionError as error:
        raise ConventionError(f"{table.path}: {error}") from error


def without_confirmation(text: str) -> str:
    """NAME of `NAME, confirmed`."""
    return text.removesuffix(CONFIRMED).rstrip(" ,")


def _confirms_convention(table: TextTable) -> bool:
    """`# convention: NAME, confirmed`, or a named convention in a table whose units the user vouches for."""
    if "convention" not in table.comments:
        return True  # the columns rx_deg, ry_deg, rz_deg are then what the format says that they are
    named = table.comments.get("convention", "")
    return bool(named) and (named.endswith(CONFIRMED) or table.comments.get("units") == CONFIRMED)


def _source(table: TextTable) -> Literal["encoder", "set"]:
    source = table.comments.get("source", "encoder")
    if source not in ("encoder", "set"):
        raise ConventionError(f"{table.path}: source is {source!r}; 'encoder' or 'set' is needed")
    return cast(Literal["encoder", "set"], source)


def _units(table: TextTable, convention: Convention) -> bool:
    """Whether the table confirms its units.  `# units: mm, deg` only repeats the columns and must agree with them."""
    declared = table.comments.get("units")
    if declared == CONFIRMED:
        return True
    allowed = {"mm"} | ({convention.unit} - {"none"}) | {"deg"}
    words = set(re.split(r"[\s,;]+", declared.strip())) if declared else {"mm"}
    if not words <= allowed:
        raise UnitError(
            f"{table.path}: units are {declared!r}; columns of a pose table are in {', '.join(sorted(allowed))} "
            "('confirmed' says that unusual numbers are right)"
        )
    return False


def _pivot(table: TextTable) -> Array | None:
    for key in table.comments:
        stem = key.split("_")[0].lower()
        if stem in ("pivot", "convention", "source", "units", "unit") and key not in COMMENT_KEYS:
            kind = UnitError if stem == "pivot" else InputError
            raise kind(f"{table.path}: unknown comment key {key!r}{unknown_column(key, COMMENT_KEYS)}")
    text = table.comments.get("pivot_mm")
    if text is None or text in ("", "unknown"):
        return None
    try:
        pivot = np.array([float(word) for word in re.split(r"[\s,;]+", text.strip("[]() "))])
    except ValueError:
        pivot = np.empty(0)
    if pivot.shape != (3,) or not np.isfinite(pivot).all():
        raise InputError(f"{table.path}: pivot_mm is {text!r}; three numbers 'x, y, z' in mm are needed")
    return pivot


# -- columns -----------------------------------------------------------------------------------------------------------


def _joint_columns(table: TextTable) -> list[str]:
    found = {int(m[1]): c for c in table.columns if (m := JOINT.fullmatch(c))}
    if found and sorted(found) != list(range(1, len(found) + 1)):
        raise InputError(f"{table.path}: joint columns {', '.join(found.values())} do not count from q1 without a gap")
    return [found[k] for k in sorted(found)]


def _require_known(table: TextTable, convention: Convention) -> None:
    known = (*PLAIN[:1], *pose_columns(convention), *PLAIN[1:], *pose_columns(convention, commanded=True), "q1_deg")
    stems = {_stem(c): c for c in known if _stem(c) != c}
    for column in table.columns:
        if column in known or JOINT.fullmatch(column):
            continue
        where = f"{table.path}: column {column!r}"
        owners = [c.name for c in CONVENTIONS.values() if column in pose_columns(c) + pose_columns(c, commanded=True)]
        if owners:
            raise ConventionError(
                f"{where} belongs to convention {' or '.join(owners)}, but the table's convention is "
                f"{convention.name} (columns {', '.join(convention.columns)}); add '# convention: NAME'"
            )
        if column in stems:
            raise UnitError(f"{where} has no unit; write {stems[column]!r} and give it in that unit")
        if _stem(column) in stems:
            raise UnitError(f"{where} is in another unit; convert it to {stems[_stem(column)]!r}")
        raise InputError(f"{where} is unknown{unknown_column(column, known)}")
    if "pose_id" not in table.columns:
        raise InputError(f"{table.path}: column 'pose_id' is missing; found {', '.join(table.columns)}")


def _stem(column: str) -> str:
    stem, dash, unit = column.rpartition("_")
    known_units = ("mm", "deg", "rad", "px", "m", "um", "cm", "mrad", "urad", "in", "inch", "µm")
    return stem if dash and unit in known_units else column


def _pose(table: TextTable, convention: Convention, *, commanded: bool, confirmed: bool) -> RigidTransform | None:
    columns = pose_columns(convention, commanded=commanded)
    present = [c for c in columns if c in table.columns]
    if not present:
        return None
    missing = [c for c in columns if c not in table.columns]
    if missing:
        raise InputError(f"{table.path}: columns {', '.join(missing)} are missing beside {', '.join(present)}")
    values = np.column_stack([table.numbers(c) for c in columns])
    positions, orientations = values[:, :3], values[:, 3:]
    if not confirmed:
        if convention.unit == "deg":
            unit_checks.require_degrees(orientations, f"{table.path}: {', '.join(columns[3:])}")
        if convention.unit == "rad":
            unit_checks.require_radians(orientations, f"{table.path}: {', '.join(columns[3:])}")
        where = f"{table.path}: {', '.join(columns[:3])}"
        unit_checks.require_millimetres(positions, where, convention=convention.name)
        unit_checks.require_one_unit(positions, orientations if convention.unit == "deg" else None, where)
    try:
        R = rotation_from_convention(orientations, convention.name)
    except InputError as error:
        raise InputError(f"{table.path}: {error}") from error
    return RigidTransform(R=R, t=positions, source=Frame.M, target=Frame.H)


def _orientations(table: TextTable, convention: Convention) -> Array | None:
    """(n, 3 or 4) the orientation columns of the poses that are used, as written; None where there are no such
    values."""
    for commanded in (False, True):
        columns = pose_columns(convention, commanded=commanded)[len(POSITION) :]
        if all(c in table.columns for c in columns):
            return np.column_stack([table.numbers(c) for c in columns])
    return None


def _pose_id(table: TextTable) -> tuple[str, ...]:
    ids = table.words("pose_id")
    _require_different(table, "pose_id", ids)
    return ids


def _require_different(table: TextTable, column: str, cells: Sequence[object]) -> None:
    twice = [(c, n) for c, n in Counter(cells).items() if n > 1]
    if twice:
        rows = [i for i, cell in enumerate(cells) if cell == twice[0][0]][:2]
        name = twice[0][0][0] if isinstance(twice[0][0], tuple) else twice[0][0]
        raise InputError(
            f"{table.path}: {column} {name!r} appears in rows {rows[0] + 1} and {rows[1] + 1} "
            f"({len(twice)} repeat); each may appear once"
        )


def _image(table: TextTable) -> tuple[str, ...] | None:
    if "image" not in table.columns:
        return None
    images = table.words("image")
    balls = table.words("ball_id") if "ball_id" in table.columns else ("0",) * len(images)
    _require_different(table, "image", list(zip(images, balls, strict=True)))
    return images


def _time(table: TextTable) -> tuple[str, ...] | None:
    if "time_utc" not in table.columns:
        return None
    cells = table.words("time_utc")
    times = []
    for i, cell in enumerate(cells):
        try:
            times.append(datetime.fromisoformat(cell))
        except ValueError:
            raise InputError(f"{table.where(i, 'time_utc')}: {cell!r} is no ISO 8601 time") from None
    naive = {t.tzinfo is None for t in times}
    if len(naive) > 1:
        raise InputError(f"{table.path}: time_utc mixes times with and without a time zone")
    for i in range(1, len(times)):
        if times[i] < times[i - 1]:
            warnings.warn(f"{table.where(i, 'time_utc')}: the clock runs backwards", InputWarning, stacklevel=3)
            break
    return cells


def _warn_if_far(table: TextTable, measured: RigidTransform, commanded: RigidTransform) -> None:
    far = np.linalg.norm(measured.t - commanded.t, axis=1)
    turned = rotation_angle_between(measured.R, commanded.R)
    bad = np.flatnonzero((far > SET_FAR_MM) | (turned > SET_FAR_RAD))
    if bad.size:
        i = int(bad[0])
        warnings.warn(
            f"{table.path}: encoder and set pose differ by {far[i]:.3g} mm and {np.degrees(turned[i]):.3g} deg in row "
            f"{i + 1} ({bad.size} rows); the encoder's is used. Are the columns shifted?",
            InputWarning,
            stacklevel=3,
        )
