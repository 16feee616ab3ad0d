"""Position logs of PI hexapod controllers (GCS commands): X Y Z in mm, U V W in deg, R = R_x(U) R_y(V) R_z(W).

A log of replies is read by this grammar; blank lines and lines that begin with # are skipped:

    log    = { query reply } | { reply }         without any query line the replies are those of POS?
    line   = [time stamp] [">>" | "<<" | "TX:"]  what a terminal writes before each line
    query  = [">"] NAME "?" [arguments]          POS? MOV? SPI? KEN? KLN? KLS? *IDN? and others, one a line
    reply  = { line }                            up to the next query or command
    POS?   : X= Y= Z= U= V= W=                   where the encoders say that the plate is; one or several on a line
    MOV?   : X= Y= Z= U= V= W=                   the commanded pose
    SPI?   : R= S= T=  or  X= Y= Z=              the pivot point, mm

One POS? reply, one MOV? reply, or one of each, in either order, is a pose; a second reply of the same kind begins the
next.  Axes A and B, which are no axes of the plate, are passed over.  Other queries are kept as text: if the reply to
SPI?, KEN?, KLN?, KLS? or *IDN? changes, or a command that changes the coordinate system, the pivot or the reference
is between the poses (SPI, KEN, KSD, KSF, KST, KSW, KLN, KLD, FRF), the log is refused, since its poses then
belong to two systems.

A list of MOV commands without any reply gives the set poses; remarks `; pose_id NAME` and `; table to X deg` name them.

A recording is a table (tabs, semicolons or commas) with the columns X Y Z U V W, optionally X_set ... W_set and the
columns alpha_deg, image, ball_id, time_utc, pose_id and comment lines of poses.csv.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tomopose.errors import InputError
from tomopose.io.foreign.clock_words import STAMP, iso_words, seconds_of
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row
from tomopose.io.foreign.program_remarks import Remarks
from tomopose.io.poses_csv import poses_from_table
from tomopose.io.table_text import NUMBER, TextTable, read_table
from tomopose.manipulator.poses import PoseSequence
from tomopose.reading import read_text, reader

AXES = ("X", "Y", "Z", "U", "V", "W")
COLUMNS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
OTHER_AXES = ("A", "B")
PIVOT_AXES = (("R", "S", "T"), ("X", "Y", "Z"))
SETTLED = ("SPI?", "KEN?", "KLN?", "KLS?", "*IDN?")
CHANGING = ("SPI", "KEN", "KSD", "KSF", "KST", "KSW", "KLN", "KLD", "FRF")
DIRECTION = re.compile(r"^(>>|<<|->|<-|(?:TX|RX|SEND|SENT|RECV|RECEIVED)\b:?)\s*", re.IGNORECASE)
PROMPT = re.compile(r"^[A-Za-z][\w .-]{0,30}>\s*(?=\*?[A-Z]{3}\b)")
"""What a terminal writes before a command that is typed, as in `PI-E-816>POS?`."""
LINE_OF_QUERY = re.compile(r">?\s*(\*?[A-Z]{3}\?)(\s.*)?")
LINE_OF_COMMAND = re.compile(r">?\s*([A-Z]{3})(\s.*)?")
ASSIGNMENT = re.compile(r"([A-Z])\s*=\s*(\S+)")
MOVE = re.compile(r">?\s*MOV\s+(?P<rest>[A-Z]\s.*)")
PIVOT_COMMAND = re.compile(r">?\s*SPI\s+(?P<rest>[A-Z]\s.*)")


@dataclass(kw_only=True)
class _Reply:
    query: str
    line: int
    stamp: str | None = None
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
    return read(ForeignFile(path), PoseOptions()).poses(units_confirmed=units_confirmed)


def recognise(file: ForeignFile) -> bool:
    """Lines of a controller's replies `X=1.0`, queries POS?, or MOV commands of six axes."""
    if not file.is_text:
        return False
    for line in file.lines[:200]:
        bare = _bare(line)[1]
        if re.fullmatch(r"([XYZUVW]\s*=\s*[-+.\deE]+\s*)+", bare) or re.match(r">?\s*(POS|MOV)\?(\s|$)", bare):
            return True
        if (move := MOVE.fullmatch(bare)) and set(_arguments(move["rest"])) >= set(AXES):
            return True
    return False


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The poses of a log of replies, or of a list of commands where nothing was replied."""
    replies = _replies(file)
    answered = any(r.values for r in replies if r.query in ("POS?", "MOV?"))
    if not answered and any(MOVE.fullmatch(_bare(line)[1]) for line in file.lines):
        return _commands(file)
    poses = _pair(file.path, replies)
    kinds = poses[0]
    rows = {q: tuple(tuple(p[q].values[a] for a in AXES) for p in poses) for q in kinds}
    main = "POS?" if "POS?" in kinds else "MOV?"
    stamps = [p[main].stamp for p in poses]
    times = tuple(s for s in stamps if s is not None)
    timed = seconds_of(times) if len(times) == len(poses) else None
    return PoseLog(
        path=file.path,
        convention="pi-hexapod",
        rows=rows[main],
        set_rows=rows.get("MOV?") if main == "POS?" else None,
        source="encoder" if main == "POS?" else "set",
        pivot=_pivot(file.path, replies),
        times=None if timed is None else (iso_words(times) or times),
        seconds=None if timed is None else timed[0],
        clock="" if timed is None else timed[1],
        lines=tuple(next(iter(p.values())).line for p in poses),
    )


def _commands(file: ForeignFile) -> PoseLog:
    """The set poses of MOV commands that nobody answered: a list that is still to be sent."""
    remarks, rows, lines, pivots = Remarks(), [], [], []
    for number, line in enumerate(file.lines, start=1):
        remarks.line(line)
        bare = _bare(line)[1]
        if pivot := PIVOT_COMMAND.fullmatch(bare):
            pivots.append((number, _arguments(pivot["rest"])))
        move = MOVE.fullmatch(bare)
        if move is None:
            continue
        values = _arguments(move["rest"])
        missing = [a for a in AXES if a not in values]
        if missing:
            raise InputError(
                f"{file.path}: line {number}: the command does not move {', '.join(missing)}; where those axes are is "
                "not in the file"
            )
        rows.append(_words(file.path, number, values))
        lines.append(number)
        remarks.pose()
    if any(number > lines[0] for number, _ in pivots):
        raise InputError(f"{file.path}: SPI changes the pivot between two poses; split the list there")
    pivot_words = tuple(pivots[-1][1].get(a, "0") for a in PIVOT_AXES[0]) if pivots else None
    said = remarks.columns()
    return PoseLog(
        path=file.path,
        convention="pi-hexapod",
        rows=tuple(rows),
        source="set",
        lines=tuple(lines),
        pivot=pivot_words if pivot_words is None else (pivot_words[0], pivot_words[1], pivot_words[2]),
        notes=("commands without replies: these are the set poses",),
        pose_id=said.get("pose_id"),
        alpha=said.get("alpha"),
    )


def _arguments(text: str) -> dict[str, str]:
    """`X 1 Y 2` as {"X": "1", "Y": "2"}."""
    words = text.split()
    return dict(zip(words[0::2], words[1::2], strict=False))


def _words(path: Path, number: int, values: Mapping[str, str]) -> Row:
    for axis in AXES:
        if not NUMBER.fullmatch(values[axis]):
            raise InputError(f"{path}: line {number}: {axis} {values[axis]} is no finite number")
    return tuple(values[a] for a in AXES)


def _bare(line: str) -> tuple[str | None, str]:
    """The time stamp of a terminal's line, and the line without stamp, direction and prompt."""
    stamp = STAMP.match(line)
    rest = line[stamp.end() :] if stamp else line
    return (stamp["stamp"] if stamp else None), PROMPT.sub("", DIRECTION.sub("", rest.strip())).strip()


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


def _replies(file: ForeignFile) -> list[_Reply]:
    path = file.path
    replies: list[_Reply] = []
    commands: list[tuple[int, str]] = []
    for number, whole in enumerate(file.lines, start=1):
        stamp, line = _bare(whole)
        if not line or line[0] in "#;":
            continue
        if query := LINE_OF_QUERY.fullmatch(line):
            replies.append(_Reply(query=query[1], line=number, stamp=stamp))
            continue
        current = replies[-1] if replies else _Reply(query="POS?", line=number, stamp=stamp)
        found = ASSIGNMENT.findall(line)
        if found and ASSIGNMENT.sub("", line).strip(" ,;\t") == "" and current.query in ("POS?", "MOV?", "SPI?"):
            if not replies:
                replies.append(current)
            for axis, value in found:
                if axis in replies[-1].values:  # the next reply, without a query line before it
                    replies.append(_Reply(query=current.query, line=number, stamp=stamp))
                if not replies[-1].values:
                    replies[-1].stamp = stamp  # the reply's own time, not the question's
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


def _pivot(path: Path, replies: list[_Reply]) -> tuple[str, str, str] | None:
    spi = next((r for r in replies if r.query == "SPI?"), None)
    if spi is None:
        return None
    axes = next((axes for axes in PIVOT_AXES if set(axes) == set(spi.values)), None)
    if axes is None:
        raise InputError(f"{path}: line {spi.line}: the reply to SPI? has {', '.join(spi.values)}; R, S, T are needed")
    return spi.values[axes[0]], spi.values[axes[1]], spi.values[axes[2]]


KIND = Kind(
    name="pi-gcs",
    maker="PI",
    what="a log of a controller's replies (POS?, MOV?, SPI?) or a list of MOV commands",
    recognise=recognise,
    read_poses=read,
)
