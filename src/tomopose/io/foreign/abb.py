"""ABB: RAPID modules (.mod, .prg, .sys) and lists of robtargets or jointtargets.  mm, quaternions (w, x, y, z), deg.

The pose is the tool's in the active work object.  Source: ABB Technical reference manual, RAPID data types
(robtarget: trans, rot, robconf, extax; jointtarget: robax, extax).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import NUM, number_word
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, numbered, one_value, some, visiting_order
from tomopose.io.foreign.program_remarks import Remarks

_N = rf"\s*({NUM})\s*"
TARGET = re.compile(rf"\[\s*\[{_N},{_N},{_N}\]\s*,\s*\[{_N},{_N},{_N},{_N}\](?P<rest>[^;]*)")
JOINTS = re.compile(rf"\[\s*\[{_N},{_N},{_N},{_N},{_N},{_N}\]\s*,\s*\[")
NAMED = re.compile(r"\b(?:robtarget|jointtarget)\s+(\w+)\s*:=", re.IGNORECASE)
ASSIGNED = re.compile(r"^\s*(\w+)\s*:=")
OTHER_DATA = re.compile(r"\b(?:CONST|PERS|VAR)\s+(?!robtarget\b|jointtarget\b)\w+\s+(\w+)", re.IGNORECASE)
"""Tools, work objects, loads and poses hold a position and a quaternion too, and are nowhere that the robot goes."""
MOVE = re.compile(r"\bMove(?P<kind>L|J|C|AbsJ)\w*\s*(?P<to>[^;]*);", re.IGNORECASE)
COMPUTED = re.compile(r"\b(Offs|RelTool)\s*\(", re.IGNORECASE)
EXTERNAL = re.compile(rf"\[((?:\s*{NUM}\s*,){{5}}\s*{NUM}\s*)\]\s*\]")
HOME = re.compile(r"[pj]?_?home\w*", re.IGNORECASE)
UNUSED_AXIS = 9e8
"""RAPID writes 9E9 for an external axis that is not there."""


@dataclass(frozen=True)
class _Target:
    name: str  # of the declaration, "" where the target is written in a move or stands alone
    words: Row
    line: int
    external: str

    @property
    def key(self) -> str:
        return self.name or f"line {self.line}"


def recognise(file: ForeignFile) -> bool:
    """RAPID text, or lines that hold robtargets."""
    if not file.is_text:
        return False
    if re.search(r"\b(robtarget|jointtarget)\b", file.text, re.IGNORECASE):
        return True
    return bool(TARGET.search(file.text) and (file.suffix in (".mod", ".prg", ".sys", ".txt", ".log", ".csv")))


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The robtargets of a module, in the order of its moves; jointtargets where it has nothing else."""
    targets, remarks = _targets(file, TARGET)
    if not targets:
        return _joints(file)
    moves = list(_moves(file))
    if computed := next((line for line, _, to in moves if COMPUTED.search(to)), None):
        raise InputError(
            f"{file.path}: line {computed}: the target is computed (Offs, RelTool), which the file does not state; "
            "log the robot's positions (CRobT), or write the targets out"
        )
    named = any(t.name for t in targets)
    chosen, notes = _visited(file.path, targets, moves) if named else (targets, ())
    said = remarks.columns() if len(remarks.ids) == len(chosen) else {}
    if "pose_id" not in said and named:
        said["pose_id"] = numbered([t.key for t in chosen])
    log = PoseLog(
        path=file.path,
        convention="abb",
        rows=tuple(t.words for t in chosen),
        source="set" if moves or named else "encoder",
        lines=tuple(t.line for t in chosen),
        notes=notes,
        pose_id=said.get("pose_id"),
        alpha=said.get("alpha"),
    )
    return log.with_notes(_frames(file, moves), _external(chosen))


def _visited(
    path: Path, targets: list[_Target], moves: list[tuple[int, str, str]]
) -> tuple[list[_Target], tuple[str, ...]]:
    """The targets in the order in which the moves go there, named or written in the move, and what is left out.

    InputError for a target that the file does not hold: without it the poses after it would belong to other images.
    """
    left: list[str] = []
    visited: list[_Target] = []
    for line, kind, to in moves:
        name = _name(kind, to)
        key = (name or f"line {line}").lower()
        known = [t for t in targets if t.key.lower() == key]
        if known:  # a target that is assigned anew counts as the program's text has it at the move
            visited.append(([t for t in known if t.line <= line] or known)[-1])
        elif HOME.fullmatch(name):
            left.append(name)
        elif kind != "absj":
            raise InputError(
                f"{path}: line {line}: the file does not hold the target {name or to[:30]!r}; add its declaration from "
                "the module that holds it, or log the robot's positions (CRobT)"
            )
    _, notes = visiting_order([t.key for t in targets], [t.key for t in visited])
    if left:
        notes += (f"moves without a position are left out: {some(list(dict.fromkeys(left)))}",)
    return visited or targets, notes


def _code(line: str) -> str:
    """A line without its remark."""
    return line.split("!", 1)[0]


def _targets(file: ForeignFile, pattern: re.Pattern[str]) -> tuple[list[_Target], Remarks]:
    found, remarks = [], Remarks()
    others = {name.lower() for line in file.lines for name in OTHER_DATA.findall(_code(line))}
    name = ""  # of the declaration or assignment that this line belongs to
    for number, line in enumerate(file.lines, start=1):
        remarks.line(line)
        code = _code(line)
        if begun := NAMED.search(code) or OTHER_DATA.search(code) or ASSIGNED.search(code):
            name = begun[1]
        targets = [] if name.lower() in others else list(pattern.finditer(code))
        for match in targets:
            words = tuple(number_word(w, f"{file.path}: line {number}") for w in match.groups()[:7] if w is not None)
            rest = EXTERNAL.search(match.group(0))
            found.append(_Target(name, words, number, rest[1] if rest else ""))
            remarks.pose()
        if ";" in code:
            name = ""
    return found, remarks


def _moves(file: ForeignFile) -> list[tuple[int, str, str]]:
    return [
        (number, m["kind"].lower(), m["to"])
        for number, line in enumerate(file.lines, start=1)
        for m in MOVE.finditer(_code(line))
    ]


def _name(kind: str, to: str) -> str:
    """The name of the target of a move; of a circle its end."""
    words = [w.strip() for w in to.lstrip("\\").split(",")]
    word = words[1] if kind == "c" and len(words) > 1 else words[0]
    return word if re.fullmatch(r"[A-Za-z]\w*", word) else ""


def _joints(file: ForeignFile) -> PoseLog:
    targets, _ = _targets(file, JOINTS)
    if not targets:
        raise InputError(f"{file.path}: no robtarget and no jointtarget holds numbers")
    moves = [_name(kind, to) for _, kind, to in _moves(file)]
    named = {t.name or f"line {t.line}": t for t in targets}
    names, notes = visiting_order(list(named), moves)
    return PoseLog(
        path=file.path,
        convention="abb",
        joints=tuple(named[n].words for n in names),
        source="set",
        pose_id=numbered(names),
        lines=tuple(named[n].line for n in names),
        notes=(*notes, "joint angles alone: the robot's file (--manipulator robot.json) turns them into poses"),
    )


def _frames(file: ForeignFile, moves: list[tuple[int, str, str]]) -> str:
    """Tool and work object of the moves; InputError where they change between poses."""
    linear = [to for _, kind, to in moves if kind != "absj"]
    tools = [re.split(r"\\", to.rsplit(",", 1)[-1])[0].strip() for to in linear]
    objects = [m[1] if (m := re.search(r"\\WObj\s*:=\s*(\w+)", to, re.IGNORECASE)) else "wobj0" for to in linear]
    if not linear:
        return ""
    tool, wobj = one_value(tools, "the tool", file.path), one_value(objects, "the work object", file.path)
    return f"all poses are of tool {tool} in work object {wobj}; both must stay as they are for the scan"


def _external(targets: list[_Target]) -> str:
    """External axes that are in use: a table may be among them."""
    used = [[w for w in t.external.split(",") if w.strip() and abs(float(w)) < UNUSED_AXIS] for t in targets]
    if not any(used):
        return ""
    return f"external axes are in use (first pose: {', '.join(w.strip() for w in used[0])}) and are not read as alpha"


KIND = Kind(
    name="abb",
    maker="ABB",
    what="a RAPID module or a list of robtargets",
    recognise=recognise,
    read_poses=read,
)
