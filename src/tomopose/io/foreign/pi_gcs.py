"""Position logs of PI hexapod controllers (GCS commands): X Y Z in mm, U V W in deg, R = R_x(U) R_y(V) R_z(W).

A log of replies is read by this grammar; blank lines and lines that begin with # are skipped:

    log    = { query reply } | { reply }         without any query line the replies are those of POS?
    query  = [">"] NAME "?" [arguments]          POS? MOV? SPI? KEN? KLN? KLS? *IDN? and others, one a line
    reply  = { line }                            up to the next query or command
    POS?   : X= Y= Z= U= V= W=                   where the encoders say that the plate stands; one or several on a line
    MOV?   : X= Y= Z= U= V= W=                   where it was told to go
    SPI?   : R= S= T=  or  X= Y= Z=              the pivot point, mm

One POS? reply, one MOV? reply, or one of each, in either order, is a pose; a second reply of the same kind begins the
next.  Axes A and B, which are no axes of the plate, are passed over.  Other queries are kept as text: if the reply to
SPI?, KEN?, KLN?, KLS? or *IDN? changes, or a command that changes the coordinate system, the pivot or the reference
stands between the poses (SPI, KEN, KSD, KSF, KST, KSW, KLN, KLD, FRF), the log is refused, since its poses then
belong to two systems.

A recording is a table (tabs, semicolons or commas) with the columns X Y Z U V W, optionally X_set ... W_set and the
columns alpha_deg, image, ball_id, time_utc, pose_id and comment lines of poses.csv.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tomopose.errors import InputError
from tomopose.io.poses_csv import poses_from_table
from tomopose.io.table_text import NUMBER, TextTable, read_table, read_text
from tomopose.manipulator.poses import PoseSequence
from tomopose.reading import reader

AXES = ("X", "Y", "Z", "U", "V", "W")
COLUMNS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
OTHER_AXES = ("A", "B")
PIVOT_AXES = (("R", "S", "T"), ("X", "Y", "Z"))
SETTLED = ("SPI?", "KEN?", "KLN?", "KLS?", "*IDN?")
CHANGING = ("SPI", "KEN", "KSD", "KSF", "KST", "KSW", "KLN", "KLD", "FRF")
LINE_OF_QUERY = re.compile(r">?\s*(\*?[A-Z]{3}\?)(\s.*)?")
LINE_OF_COMMAND = re.compile(r">?\s*([A-Z]{3})(\s.*)?")
ASSIGNMENT = re.compile(r"([A-Z])\s*=\s*(\S+)")


@dataclass(kw_only=True)
class _Reply:
    query: str
    line: int
    values: dict[str, str] = field(default_factory=dict)
    text: list[str] = field(default_factory=list)


@reader("position log")
def read_gcs_log(path: str | Path, *, units_confirmed: bool = False) -> PoseSequence:
    """Read a log of replies or a recording, by the grammar above.

    Encoder poses are those of POS?, set poses those of MOV?, the pivot that of SPI?; ids count the poses from 0.

    Raises InputError, naming the line, for an axis that is missing or no number, a line that is no reply, a pivot,
    coordinate system or reference that changes within the log; UnitError as `read_poses` does; FileError.
    """
    path = Path(path)
    first = next((line for line in read_text(path).splitlines() if line.strip() and line.lstrip()[0] != "#"), "")
    if all(re.search(rf"(^|[\t;,])\s*\"?{axis}\"?\s*($|[\t;,])", first) for axis in AXES):
        return poses_from_table(_renamed(read_table(path)), units_confirmed=units_confirmed)
    replies = _replies(path)
    poses = _pair(path, replies)
    columns: dict[str, list[str]] = {"pose_id": [str(k) for k in range(len(poses))]}
    for query, names in (("POS?", COLUMNS), ("MOV?", tuple(_set(c) for c in COLUMNS))):
        if query in poses[0]:
            columns |= {c: [p[query].values[a] for p in poses] for c, a in zip(names, AXES, strict=True)}
    table = TextTable(
        path=path,
        comments=_pivot_comment(path, replies),
        columns=tuple(columns),
        rows=tuple(zip(*columns.values(), strict=True)),
        lines=tuple(next(iter(p.values())).line for p in poses),
    )
    return poses_from_table(table, units_confirmed=units_confirmed)


def _set(column: str) -> str:
    return column.replace("_", "_set_")


def _renamed(table: TextTable) -> TextTable:
    """A recording with the column names of poses.csv."""
    names: Mapping[str, str] = dict(zip(AXES, COLUMNS, strict=True)) | {
        f"{a}_set": _set(c) for a, c in zip(AXES, COLUMNS, strict=True)
    }
    columns, rows = tuple(names.get(c, c) for c in table.columns), table.rows
    if "pose_id" not in columns:
        columns, rows = ("pose_id", *columns), tuple((str(k), *row) for k, row in enumerate(rows))
    return TextTable(
        path=table.path,
        comments=table.comments,
        columns=columns,
        rows=rows,
        lines=table.lines,
        decimal_comma=table.decimal_comma,
    )


def _replies(path: Path) -> list[_Reply]:
    replies: list[_Reply] = []
    commands: list[tuple[int, str]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        if query := LINE_OF_QUERY.fullmatch(line):
            replies.append(_Reply(query=query[1], line=number))
            continue
        current = replies[-1] if replies else _Reply(query="POS?", line=number)
        found = ASSIGNMENT.findall(line)
        if found and ASSIGNMENT.sub("", line).strip(" ,;\t") == "" and current.query in ("POS?", "MOV?", "SPI?"):
            if not replies:
                replies.append(current)
            for axis, value in found:
                if axis in replies[-1].values:  # the next reply, without a query line before it
                    replies.append(_Reply(query=current.query, line=number))
                _take(path, number, replies[-1], axis, value)
        elif command := LINE_OF_COMMAND.fullmatch(line):
            commands.append((number, command[1]))
        elif current.query in ("POS?", "MOV?", "SPI?"):
            raise InputError(f"{path}: line {number}: {line[:60]!r} is no reply to {current.query} (X=1.234 is)")
        else:
            current.text.append(line)
    _require_settled(path, replies, commands)
    return replies


def _take(path: Path, number: int, reply: _Reply, axis: str, value: str) -> None:
    known = AXES + OTHER_AXES if reply.query != "SPI?" else PIVOT_AXES[0] + PIVOT_AXES[1]
    if axis not in known:
        raise InputError(f"{path}: line {number}: axis {axis!r} is unknown in a reply to {reply.query}")
    value = value.rstrip(",;")
    if not NUMBER.fullmatch(value):
        raise InputError(f"{path}: line {number}: {axis}={value} is no finite number")
    reply.values[axis] = value


def _require_settled(path: Path, replies: list[_Reply], commands: list[tuple[int, str]]) -> None:
    """Refuse a log whose pivot, coordinate system or reference changes between poses."""
    said: dict[str, _Reply] = {}
    for reply in replies:
        before = said.setdefault(reply.query, reply)
        if reply.query not in SETTLED:
            continue
        same = {a: float(x) for a, x in before.values.items()} == {a: float(x) for a, x in reply.values.items()}
        if not same or before.text != reply.text:
            raise InputError(
                f"{path}: line {reply.line}: the reply to {reply.query} differs from that in line {before.line}; pivot "
                "and coordinate system must stay the same in a run: split the log there"
            )
    lines = [r.line for r in replies if r.query in ("POS?", "MOV?")]
    for number, name in commands:
        if name in CHANGING and lines and lines[0] < number < lines[-1]:
            raise InputError(
                f"{path}: line {number}: {name} changes pivot, coordinate system or reference between two poses; split "
                "the log there"
            )


def _pair(path: Path, replies: list[_Reply]) -> list[dict[str, _Reply]]:
    """Replies to POS? and MOV? as poses; all have the same kinds."""
    poses: list[dict[str, _Reply]] = []
    for reply in replies:
        if reply.query not in ("POS?", "MOV?"):
            continue
        missing = [a for a in AXES if a not in reply.values]
        if missing:
            raise InputError(f"{path}: line {reply.line}: the reply to {reply.query} lacks {', '.join(missing)}")
        if not poses or reply.query in poses[-1]:
            poses.append({})
        poses[-1][reply.query] = reply
    if not poses:
        raise InputError(f"{path} holds no reply to POS? or MOV?, and no header X Y Z U V W")
    for k, pose in enumerate(poses):
        if pose.keys() != poses[0].keys():
            line, has, first = next(iter(pose.values())).line, " and ".join(pose), " and ".join(poses[0])
            raise InputError(
                f"{path}: pose {k} (line {line}) has {has}, pose 0 {first}; every pose needs the same replies"
            )
    return poses


def _pivot_comment(path: Path, replies: list[_Reply]) -> dict[str, str]:
    spi = next((r for r in replies if r.query == "SPI?"), None)
    if spi is None:
        return {}
    axes = next((axes for axes in PIVOT_AXES if set(axes) == set(spi.values)), None)
    if axes is None:
        raise InputError(f"{path}: line {spi.line}: the reply to SPI? has {', '.join(spi.values)}; R, S, T are needed")
    return {"pivot_mm": ", ".join(spi.values[a] for a in axes)}
