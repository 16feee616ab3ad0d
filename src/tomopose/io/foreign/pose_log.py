"""What every reader of a pose log gives: poses as words, exactly as the file wrote them, and what else it said.

The words become a table in the columns of poses.csv, which the one reader of that table checks like any other: units,
repeated ids, blank cells.  Nothing passes through a matrix on its way from a controller's file to poses.csv.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import convention_named
from tomopose.geometry.transforms import RigidTransform
from tomopose.io.poses_csv import pose_columns, poses_from_table
from tomopose.io.table_text import TextTable, format_table
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array
from tomopose.values import value

Row = tuple[str, ...]
SHOWN = 6


@dataclass(frozen=True, kw_only=True)
class PoseOptions:
    """What the caller says beside the file.

    convention: a named convention, where the file does not show its own.
    columns:    role -> column of a table: {"x": "X_mm", "a": "A_deg"}.
    units:      unit of length of numbers that carry none: "mm", "m", ...
    """

    convention: str | None = None
    columns: dict[str, str] = field(default_factory=dict)
    units: str | None = None


@value
class PoseLog:
    """Poses of a file, as words.

    rows:       per pose x, y, z (mm) and the convention's orientation columns; empty where the file holds joints alone.
    set_rows:   the commanded poses beside the measured ones.
    joints:     per pose the joint values, in joint_unit.
    pose_id:    one a pose; image, alpha (deg), ball_id: one a pose, or None.
    times:      the file's own time stamps; seconds: the same as numbers; clock: which clock that is, in words.
    lines:      where each pose begins in the file, from 1.
    notes:      what was read how, and what was left out, in words.
    """

    path: Path
    convention: str
    rows: tuple[Row, ...] = ()
    set_rows: tuple[Row, ...] | None = None
    source: Literal["encoder", "set"] = "encoder"
    joints: tuple[Row, ...] | None = None
    joint_unit: Literal["deg", "mm"] = "deg"
    pose_id: tuple[str, ...] | None = None
    image: tuple[str, ...] | None = None
    alpha: tuple[str, ...] | None = None
    ball_id: tuple[str, ...] | None = None
    times: tuple[str, ...] | None = None
    seconds: Array | None = None
    clock: str = ""
    pivot: tuple[str, str, str] | None = None
    lines: tuple[int, ...] | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rows) or len(self.joints or ())

    def table(self, *, units_confirmed: bool = False) -> TextTable:
        """The same in the columns of poses.csv."""
        n = len(self)
        if n == 0:
            raise InputError(f"{self.path} holds no pose")
        columns: dict[str, Sequence[str]] = {"pose_id": self.pose_id or tuple(str(k) for k in range(n))}
        convention = convention_named(self.convention)
        for rows, commanded in ((self.rows, False), (self.set_rows or (), True)):
            if rows:
                columns |= dict(
                    zip(pose_columns(convention, commanded=commanded), zip(*rows, strict=True), strict=True)
                )
        for name in ("alpha", "image", "ball_id"):
            words = getattr(self, name)
            if words is not None:
                columns["alpha_deg" if name == "alpha" else name] = words
        if self.times is not None and self.clock == ABSOLUTE:
            columns["time_utc"] = self.times
        if self.joints:
            for k, words in enumerate(zip(*self.joints, strict=True), start=1):
                columns[f"q{k}_{self.joint_unit}"] = words
        comments = {"convention": convention.name, "source": self.source}
        if self.pivot is not None:
            comments["pivot_mm"] = ", ".join(self.pivot)
        if units_confirmed:
            comments["units"] = "confirmed"
        return TextTable(
            path=self.path,
            comments=comments,
            columns=tuple(columns),
            rows=tuple(zip(*columns.values(), strict=True)),
            lines=self.lines or tuple(range(1, n + 1)),
        )

    def poses(self, *, units_confirmed: bool = False) -> PoseSequence:
        """The poses, checked as every pose table is.  Joints alone give poses at zero: a robot's file turns them."""
        return poses_from_table(self.table(units_confirmed=units_confirmed), forward=_unknown_pose)

    def with_notes(self, *notes: str) -> PoseLog:
        """The same with more notes."""
        return replace(self, notes=(*self.notes, *(n for n in notes if n)))


ABSOLUTE = "date and time"
"""The clock of time stamps that carry their date."""


def _unknown_pose(q: Array) -> RigidTransform:
    return RigidTransform(
        R=np.repeat(np.eye(3)[None], len(q), axis=0), t=np.zeros((len(q), 3)), source=Frame.M, target=Frame.H
    )


def table_text(table: TextTable) -> str:
    """The text of poses.csv; cells keep their digits."""
    k = range(len(table.columns))
    return format_table(table.comments, {table.columns[i]: [row[i] for row in table.rows] for i in k})


def some(items: Sequence[object]) -> str:
    """The first few of many, for a message."""
    more = f" ... ({len(items)} in all)" if len(items) > SHOWN else ""
    return ", ".join(str(i) for i in items[:SHOWN]) + more


def numbered(names: Sequence[str]) -> tuple[str, ...]:
    """Names that differ: a name that returns gets #2, #3 ... behind it."""
    seen: Counter[str] = Counter()
    out = []
    for name in names:
        seen[name] += 1
        out.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
    return tuple(out)


def visiting_order(declared: Sequence[str], visited: Sequence[str]) -> tuple[list[str], tuple[str, ...]]:
    """The names of the poses in the order in which a program visits them, and what to say about it.

    Where the program visits none of the declared points, their own order is all there is.
    """
    known = [name for name in visited if name in declared]
    if not known:
        return list(declared), ()
    left = [name for name in declared if name not in known]
    lost = [name for name in dict.fromkeys(visited) if name and name not in declared]
    notes: tuple[str, ...] = (f"points that no move visits are left out: {some(left)}",) if left else ()
    if lost:
        notes += (f"moves without a position are left out: {some(lost)}",)
    if known != [name for name in declared if name in known]:
        notes += ("the poses are in the order of the moves, not of the declarations",)
    return known, notes


def one_value(found: Sequence[str], what: str, path: Path) -> str:
    """The one value that all poses share; InputError where it changes, since the poses then lie in several frames."""
    values = list(dict.fromkeys(found))
    if len(values) > 1:
        raise InputError(
            f"{path}: {what} changes from {values[0]} to {values[1]} between the poses; poses of several frames "
            "cannot be in one table: split the file, or record all poses in one frame"
        )
    return values[0] if values else ""
