"""Universal Robots: script poses p[x, y, z, rx, ry, rz] and RTDE recordings.  m and rad; rx, ry, rz is a rotation
vector.

The pose is the TCP's in the base.  Source: Universal Robots, The URScript Programming Language (pose, movel);
Real-Time Data Exchange guide (actual_TCP_pose, target_TCP_pose, timestamp).
"""

from __future__ import annotations

import re

import numpy as np

from tomopose.errors import InputError, UnitError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import NUM, mm_words, number_word
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, numbered, some, visiting_order
from tomopose.io.foreign.program_remarks import Remarks

_N = rf"\s*({NUM})\s*"
POSE = re.compile(rf"\bp\[{_N},{_N},{_N},{_N},{_N},{_N}\]")
LIST = re.compile(rf"^[^\[\]]*\[{_N},{_N},{_N},{_N},{_N},{_N}\]\s*$")
"""Six numbers in brackets, as other languages print get_actual_tcp_pose(); read where format ur is asked for."""
MOVE = re.compile(r"\b(?:move[jlpc]|servo[jc])\s*\(\s*(?P<to>p\[[^\]]*\]|[A-Za-z_]\w*|\[[^\]]*\]|[^,)]*)")
ASSIGNED = re.compile(r"^\s*(?:global\s+|local\s+)?(?P<name>\w+)\s*=\s*(?=p\[)")
SAME_POSE = re.compile(r"\bget_inverse_kin\s*\(\s*(?P<of>p\[[^\]]*\]|[A-Za-z_]\w*)\s*(?:,[^()]*)?\)")
"""Joint angles of a pose: a move to them goes to that pose."""
NO_POSE = re.compile(r"\b(set_tcp|set_payload\w*|pose_trans|pose_add|pose_sub|pose_inv|get_inverse_kin)\s*\(")
LONGEST_REACH_M = 10.0
"""No UR robot reaches further than 2 m; numbers above are millimetres."""
RTDE = re.compile(r"(actual|target)_TCP_pose[_\[]?(\d)\]?")


def recognise_script(file: ForeignFile) -> bool:
    """Text with script poses."""
    return file.is_text and POSE.search(file.text) is not None


def read_script(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The poses that a script's moves go to; without any move, all poses of the text."""
    named: dict[str, tuple[Row, int]] = {}
    moves: list[tuple[str, Row | None, int]] = []
    alone: list[tuple[Row, int]] = []
    remarks, left = Remarks(), []
    pattern = POSE if POSE.search(file.text) else LIST
    for number, line in enumerate(file.lines, start=1):
        remarks.line(line)
        code = SAME_POSE.sub(r"\g<of>", line.split("#", 1)[0])
        poses = [_row(m, f"{file.path}: line {number}", options) for m in pattern.finditer(code)]
        move = MOVE.search(code)
        if move and NO_POSE.search(code):
            raise InputError(
                f"{file.path}: line {number}: the target is computed, which the file does not state; log "
                "get_actual_tcp_pose() instead, or write the poses out"
            )
        if move and poses:
            moves.append(("", poses[-1], number))
            remarks.pose()
        elif move:
            to = move["to"].strip()  # as the script has it here; it may be assigned anew
            moves.append((to, named[to][0] if to in named else None, number))
        elif poses and (name := ASSIGNED.match(code)):
            named[name["name"]] = poses[0], number
        elif poses and not NO_POSE.search(code):
            alone += [(pose, number) for pose in poses]
        elif poses:
            left.append(code.strip()[:50])
    log = _chosen(file, named, moves, alone, remarks)
    return log.with_notes(f"not poses of the run: {some(left)}" if left else "")


def _chosen(
    file: ForeignFile,
    named: dict[str, tuple[Row, int]],
    moves: list[tuple[str, Row | None, int]],
    alone: list[tuple[Row, int]],
    remarks: Remarks,
) -> PoseLog:
    notes: tuple[str, ...] = ("m and rotation vectors in rad; x, y, z are written in mm",)
    said: dict[str, tuple[str, ...]] = {}
    direct = [(name, row, line) for name, row, line in moves if row is not None]
    if direct:
        rows, names = [(row, line) for _, row, line in direct], [name for name, _, _ in direct]
        lost = [name for name, row, _ in moves if row is None]
        if lost:
            notes += (f"moves to joint positions or names are left out: {some(lost)}",)
        if any(names):
            _, more = visiting_order(list(named), [name for name in names if name])
            notes, said = (*notes, *more), {"pose_id": numbered([n or f"line {k}" for n, _, k in direct])}
        else:
            said = remarks.columns()
    elif named:
        rows, said = list(named.values()), {"pose_id": tuple(named)}
    else:
        rows = alone
    if not rows:
        raise InputError(f"{file.path}: no move goes to a pose p[x, y, z, rx, ry, rz], and no pose is given on its own")
    return PoseLog(
        path=file.path,
        convention="ur",
        rows=tuple(row for row, _ in rows),
        source="set" if moves or named else "encoder",
        lines=tuple(line for _, line in rows),
        notes=notes,
        pose_id=said.get("pose_id"),
        alpha=said.get("alpha"),
    )


def _row(match: re.Match[str], where: str, options: PoseOptions) -> Row:
    words = tuple(number_word(w, where) for w in match.groups())
    return (*_metres(words[:3], where, options), *words[3:])


def _metres(words: Row, where: str, options: PoseOptions) -> Row:
    """Positions of a script in mm; UnitError where they cannot be metres."""
    unit = options.units or "m"
    if unit == "m" and max(abs(float(w)) for w in words) > LONGEST_REACH_M:
        raise UnitError(f"{where}: {', '.join(words)} are no positions in m; if they are in mm, add --units mm")
    return mm_words(words, unit)


# -- RTDE ----------------------------------------------------------------------------------------------------------


def recognise_rtde(file: ForeignFile) -> bool:
    """A table whose header names actual_TCP_pose_0 ... 5."""
    return file.is_text and "TCP_pose_5" in (file.lines[0] if file.lines else "")


def read_rtde(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The rows of an RTDE recording: actual TCP poses, target poses beside them, and the controller's clock."""
    head = file.lines[0]
    separator = "," if "," in head else ";" if ";" in head else None
    names = [w.strip().strip('"') for w in head.split(separator)]
    roles = {found.groups(): i for i, name in enumerate(names) if (found := RTDE.fullmatch(name))}
    where = {kind: [roles[kind, str(k)] for k in range(6) if (kind, str(k)) in roles] for kind in ("actual", "target")}
    first = "actual" if len(where["actual"]) == 6 else "target"
    if len(where[first]) != 6:
        raise InputError(f"{file.path}: the six columns actual_TCP_pose_0 ... 5 are not all there")
    cells, lines = _cells(file, separator, len(names))

    def rows(kind: str) -> tuple[Row, ...]:
        out = []
        for row, line in zip(cells, lines, strict=True):
            place = f"{file.path}: line {line}"
            words = tuple(number_word(row[i], place) for i in where[kind])
            out.append((*_metres(words[:3], place, options), *words[3:]))
        return tuple(out)

    clock = names.index("timestamp") if "timestamp" in names else None
    times = None if clock is None else tuple(number_word(row[clock], f"{file.path}: timestamp") for row in cells)
    used = {*where["actual"], *where["target"], *([clock] if clock is not None else [])}
    unused = [n for i, n in enumerate(names) if i not in used]
    return PoseLog(
        path=file.path,
        convention="ur",
        rows=rows(first),
        set_rows=rows("target") if first == "actual" and len(where["target"]) == 6 else None,
        source="encoder" if first == "actual" else "set",
        times=times,
        seconds=None if times is None else np.array([float(t) for t in times]),
        clock="the controller's time stamp, s",
        lines=tuple(lines),
        notes=(
            "m and rotation vectors in rad; x, y, z are written in mm",
            *((f"columns not used: {some(unused)}",) if unused else ()),
        ),
    )


def _cells(file: ForeignFile, separator: str | None, count: int) -> tuple[list[list[str]], list[int]]:
    rows, lines = [], []
    for number, line in enumerate(file.lines[1:], start=2):
        if not line.strip():
            continue
        cells = line.split(separator)
        if len(cells) != count:
            raise InputError(f"{file.path}: line {number} has {len(cells)} cells, the header {count} columns")
        rows.append([c.strip() for c in cells])
        lines.append(number)
    return rows, lines


SCRIPT = Kind(
    name="ur",
    maker="Universal Robots",
    what="a script or a list of poses p[x, y, z, rx, ry, rz]",
    recognise=recognise_script,
    read_poses=read_script,
)
RECORDING = Kind(
    name="ur-rtde",
    maker="Universal Robots",
    what="an RTDE recording",
    recognise=recognise_rtde,
    read_poses=read_rtde,
)
