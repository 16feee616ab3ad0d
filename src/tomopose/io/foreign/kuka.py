"""KUKA: KRL programs (.src), point lists (.dat), logs of $POS_ACT and RSI telegrams (.xml).  X Y Z in mm, A B C in deg.

R = R_z(A) R_y(B) R_x(C), moved axes; the pose is the tool's in the active base.  Source: KUKA System Software,
programming manual for integrators (E6POS, FRAME, LIN, PTP); KUKA.RobotSensorInterface (RIst, RSol, IPOC).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.io.foreign.clock_words import STAMP, iso_words, seconds_of
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import number_word, pairs_of
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, numbered, one_value, some
from tomopose.io.foreign.program_remarks import Remarks

FRAME = ("X", "Y", "Z", "A", "B", "C")
AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
DECLARATION = re.compile(
    r"^\s*(?:DECL\s+)?(?:GLOBAL\s+)?(?P<type>E[36]POS|POS|FRAME|E[36]AXIS|AXIS|FDAT)\s+(?P<name>\w+)\s*=\s*"
    r"\{(?P<body>[^{}]*)\}",
    re.IGNORECASE,
)
MOVE = re.compile(r"^\s*(?P<kind>S?PTP|S?LIN|S?CIRC|SPL)(?P<relative>_REL)?\s+(?P<rest>.*)$", re.IGNORECASE)
INLINE = re.compile(r"\{\s*(?:E?[36]?(?:POS|AXIS)|FRAME)?\s*:?([^{}]*)\}", re.IGNORECASE)
FOLD = re.compile(r"Tool\[(?P<tool>\d+)\].*?Base\[(?P<base>\d+)\]", re.IGNORECASE)
TELEGRAM = re.compile(r"<Rob\b.*?</Rob>", re.DOTALL)
RECORD = re.compile(
    r"\$POS_(?:ACT|ACT_MES|FOR)\s*[=:]?\s*\{(?:\s*(?:E[36]?POS|FRAME)\s*:)?(?P<body>[^{}]*)\}", re.IGNORECASE
)
"""A position that was read from the controller: `$POS_ACT={E6POS: X .., Y .., Z .., A .., B .., C ..}`."""
HOME = re.compile(r"X?HOME\d*|\$\w+", re.IGNORECASE)


@dataclass(frozen=True)
class _Point:
    """A declared point: its values by axis name, and its line."""

    name: str
    values: dict[str, str]
    line: int
    frame: bool = False  # declared as FRAME: a tool, a base or an offset, where other points are declared as positions


def recognise(file: ForeignFile) -> bool:
    """KRL text, or telegrams of a robot that calls itself KUKA."""
    if not file.is_text:
        return False
    text = file.text
    if "<Rob" in text and "<RIst" in text:
        return True
    if RECORD.search(text):
        return True
    krl = file.suffix in (".src", ".dat", ".sub") or re.search(r"^\s*(&ACCESS|DEFDAT|DEF)\b", text, re.MULTILINE)
    return bool(krl and any(DECLARATION.match(line) or MOVE.match(line) for line in file.lines))


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The poses of a KRL program, a point list or a stream of RSI telegrams."""
    if "<RIst" in file.text:
        return _telegrams(file)
    if any(RECORD.search(line) for line in file.lines) and not any(MOVE.match(line) for line in file.lines):
        return _records(file)
    return _program(file)


# -- programs and point lists ------------------------------------------------------------------------------------------


def _program(file: ForeignFile) -> PoseLog:
    points = _points(file)
    visited, left, remarks = _visited(file, points)
    notes: tuple[str, ...] = ()
    if visited:
        names = [p.name for p in visited]
        unseen = [n for n in points if n not in names and "X" in points[n].values]
        if unseen:
            notes += (f"points that no move visits are left out: {some(unseen)}",)
        if left:
            notes += (f"moves without a position are left out: {some(list(dict.fromkeys(left)))}",)
    else:
        positions = [p for p in points.values() if not p.frame]
        visited = positions or list(points.values())
        if len(visited) < len(points):
            notes = (f"frames that no move visits are left out: {some([p.name for p in points.values() if p.frame])}",)
    frames = [p for p in visited if all(a in p.values for a in FRAME)]
    chosen, kind = (frames, FRAME) if frames else ([p for p in visited if all(a in p.values for a in AXES)], AXES)
    if not chosen:
        raise InputError(f"{file.path}: no point has X, Y, Z, A, B and C, and none has A1 to A6")
    joint = [p.name or f"line {p.line}" for p in visited if p not in chosen]
    if joint:
        notes += (f"positions that are no full pose are left out: {some(joint)}",)
    rows = tuple(_row(p.values, kind, f"{file.path}: line {p.line}") for p in chosen)
    said = remarks.columns() if len(remarks.ids) == len(chosen) else {}
    if "pose_id" not in said and all(p.name for p in chosen):
        said["pose_id"] = numbered([p.name for p in chosen])
    log = PoseLog(
        path=file.path,
        convention="kuka",
        rows=rows if kind is FRAME else (),
        joints=rows if kind is AXES else None,
        source="set",
        lines=tuple(p.line for p in chosen),
        notes=notes,
        pose_id=said.get("pose_id"),
        alpha=said.get("alpha"),
    )
    return log.with_notes(_frame_note(file, [p.name for p in chosen]), _assigned_frames(file))


def _points(file: ForeignFile) -> dict[str, _Point]:
    found = {}
    for number, line in enumerate(file.lines, start=1):
        match = DECLARATION.match(line)
        if match and match["type"].upper() != "FDAT":
            frame = match["type"].upper() == "FRAME"
            found[match["name"]] = _Point(match["name"], pairs_of(match["body"], r"\s"), number, frame)
    return found


def _points_beside(file: ForeignFile) -> dict[str, _Point]:
    for suffix in (".dat", ".DAT", ".Dat"):
        beside = file.path.with_suffix(suffix)
        if beside.is_file() and beside != file.path:
            return _points(ForeignFile(beside))
    return {}


def _visited(file: ForeignFile, points: dict[str, _Point]) -> tuple[list[_Point], list[str], Remarks]:
    """The positions that the moves go to, in their order; names that have no position; remarks beside them."""
    remarks, visited, left = Remarks(), [], []
    beside: dict[str, _Point] | None = None
    for number, line in enumerate(file.lines, start=1):
        remarks.line(line)
        move = None if line.lstrip().startswith(";") else MOVE.match(line)
        if move is None:
            continue
        if move["relative"]:
            raise InputError(
                f"{file.path}: line {number}: {line.strip()[:40]!r} is relative to the pose before it, which the "
                "file does not hold; write absolute positions, or record them"
            )
        point: _Point | None
        if bodies := INLINE.findall(move["rest"]):
            point = _Point("", pairs_of(bodies[-1], r"\s"), number)
            if point.values.keys() & set(FRAME):  # a component that is not given stays as the pose before had it
                _row(point.values, FRAME, f"{file.path}: line {number}")
        else:
            name = _target(move)
            if name not in points and beside is None:
                beside = _points_beside(file)
            point = points.get(name) or (beside or {}).get(name)
            if point is None:
                _require_home(file, name, number)
                left.append(name)
                continue
        visited.append(point)
        remarks.pose()
    return visited, left, remarks


def _target(move: re.Match[str]) -> str:
    """The name of the point that a move goes to; of a circle its end."""
    words = [w.strip() for w in move["rest"].split(";")[0].split(",")]
    word = words[1 if move["kind"].upper().endswith("CIRC") and len(words) > 1 else 0].split()
    return word[0] if word else ""


def _require_home(file: ForeignFile, name: str, number: int) -> None:
    """InputError for a target that no list holds and that is not the home position."""
    if name and not HOME.fullmatch(name):
        raise InputError(
            f"{file.path}: line {number}: the position of {name} is in {file.path.with_suffix('.dat').name}; "
            "put that file beside the program"
        )


def _row(values: dict[str, str], names: tuple[str, ...], where: str) -> Row:
    missing = [name for name in names if name not in values]
    if missing:
        raise InputError(f"{where}: the position lacks {', '.join(missing)}")
    return tuple(number_word(values[name], where) for name in names)


def _frame_note(file: ForeignFile, names: list[str]) -> str:
    """Tool and base of the points (FDAT, or the folds of the program); InputError where they change."""
    said: dict[str, dict[str, str]] = {}
    for line in file.lines:
        match = DECLARATION.match(line)
        if match and match["type"].upper() == "FDAT":
            values = pairs_of(match["body"], r"\s")
            said[match["name"].upper()] = {"tool": values.get("TOOL_NO", ""), "base": values.get("BASE_NO", "")}
    used = [said[n.upper().replace("XP", "FP", 1)] for n in names if n.upper().replace("XP", "FP", 1) in said]
    if not used:
        used = [{"tool": m["tool"], "base": m["base"]} for line in file.lines if (m := FOLD.search(line))]
    if not used:
        return ""
    tool = one_value([u["tool"] for u in used], "the tool number", file.path)
    base = one_value([u["base"] for u in used], "the base number", file.path)
    return f"all poses are of tool {tool} in base {base}; both must stay as they are for the scan"


def _assigned_frames(file: ForeignFile) -> str:
    """`$TOOL = ...` and `$BASE = ...` lines; InputError where one changes."""
    said = []
    for name in ("$TOOL", "$BASE"):
        found = [line.split("=", 1)[1].strip() for line in file.lines if re.match(rf"\s*\{name}\s*=", line, re.I)]
        if found:
            said.append(f"{name} = {one_value(found, name, file.path)}")
    return "; ".join(said)


def _records(file: ForeignFile) -> PoseLog:
    """The positions of a log of `$POS_ACT`, with the time stamps that begin its lines."""
    rows, lines, stamps = [], [], []
    for number, line in enumerate(file.lines, start=1):
        if found := RECORD.search(line):
            rows.append(_row(pairs_of(found["body"], r"\s"), FRAME, f"{file.path}: line {number}"))
            lines.append(number)
            stamp = STAMP.match(line)
            stamps.append(stamp["stamp"] if stamp else None)
    times = tuple(s for s in stamps if s is not None)
    timed = seconds_of(times) if len(times) == len(rows) else None
    return PoseLog(
        path=file.path,
        convention="kuka",
        rows=tuple(rows),
        lines=tuple(lines),
        times=None if timed is None else (iso_words(times) or times),
        seconds=None if timed is None else timed[0],
        clock="" if timed is None else timed[1],
        notes=("$POS_ACT is the measured pose of the active tool in the active base",),
    )


# -- RSI -----------------------------------------------------------------------------------------------------------


def _telegrams(file: ForeignFile) -> PoseLog:
    blocks = TELEGRAM.findall(file.text)
    if not blocks:
        raise FileError(f"{file.path}: no telegram <Rob> ... </Rob> is whole; is the file truncated?", path=file.path)
    rows, commanded, times = [], [], []
    for k, block in enumerate(blocks):
        where = f"{file.path}: telegram {k + 1}"
        actual, target = _attributes(block, "RIst"), _attributes(block, "RSol")
        if actual is None:
            raise InputError(f"{where} has no <RIst>, the measured pose; configure RSI to send it")
        rows.append(_row(actual, FRAME, f"{where}, RIst"))
        commanded.append(None if target is None else _row(target, FRAME, f"{where}, RSol"))
        clock = re.search(r"<IPOC>\s*(\d+)\s*</IPOC>", block)
        times.append(clock[1] if clock else None)
    notes = ["the measured poses are RIst"]
    if file.text.rstrip().count("<Rob") > len(blocks):
        notes.append("the last telegram is not whole and is left out")
    if "<AIPos" in file.text:
        notes.append("joint angles (AIPos) are in the file too and are not used")
    both = [c for c in commanded if c is not None]
    if len(both) == len(rows):
        notes.append("the commanded poses are RSol")
    stamped = [t for t in times if t is not None]
    return PoseLog(
        path=file.path,
        convention="kuka",
        rows=tuple(rows),
        set_rows=tuple(both) if len(both) == len(rows) else None,
        times=tuple(stamped) if len(stamped) == len(rows) else None,
        seconds=np.array([int(t) / 1000.0 for t in stamped]) if len(stamped) == len(rows) else None,
        clock="IPOC of the controller, ms",
        notes=tuple(notes),
    )


def _attributes(block: str, tag: str) -> dict[str, str] | None:
    found = re.search(rf"<{tag}\b([^>]*)>", block)
    return dict(re.findall(r'(\w+)\s*=\s*"([^"]*)"', found[1])) if found else None


KIND = Kind(
    name="kuka",
    maker="KUKA",
    what="a KRL program or point list (.src, .dat), a log of $POS_ACT or a stream of RSI telegrams (.xml)",
    recognise=recognise,
    read_poses=read,
)
