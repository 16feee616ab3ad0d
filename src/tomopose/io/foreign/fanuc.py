"""FANUC: TP programs as text (.ls).  X Y Z in mm, W P R in deg about the fixed axes x, y, z: R = R_z(R) R_y(P) R_x(W).

The pose is the tool frame's (UT) in the user frame (UF).  Source: FANUC, KAREL and TP program listing (/POS section:
P[n]{ GP1: UF, UT, CONFIG, X, Y, Z, W, P, R }; or J1 ... J6).
"""

from __future__ import annotations

import re

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import number_word, pairs_of
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, numbered, one_value, some, visiting_order

FRAME = ("X", "Y", "Z", "W", "P", "R")
JOINTS = ("J1", "J2", "J3", "J4", "J5", "J6")
POINT = re.compile(r"\bP\[\s*(?P<n>\d+)\s*(?::[^\]]*)?\]\s*\{(?P<body>.*?)\}\s*;", re.DOTALL)
MOVE = re.compile(r"^\s*\d*\s*:\s*[JLCA]\s+P\[\s*(\d+)[^\]]*\]", re.MULTILINE)
SHIFTED = re.compile(
    r"^\s*\d*\s*:\s*[JLCA]\s+PR?\[[^\]]*\].*?\b(?P<how>INC|(?:Tool_)?Offset|VOFFSET)\b", re.MULTILINE | re.IGNORECASE
)
"""A move relative to the point before, or shifted by a register that the listing does not hold."""
REGISTER = re.compile(r"^\s*\d*\s*:\s*[JLCA]\s+(PR\[[^\]]*\])", re.MULTILINE)
SECOND_GROUP = re.compile(r"\bGP[2-9]\s*:.*", re.DOTALL)


def recognise(file: ForeignFile) -> bool:
    """A listing with /PROG and /POS."""
    return file.is_text and re.search(r"^/PROG\b", file.text, re.MULTILINE) is not None and "/POS" in file.text


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The points of a listing, in the order of its moves."""
    program, _, positions = file.text.partition("/POS")
    found: dict[str, dict[str, str]] = {}
    lines: dict[str, int] = {}
    groups = False
    for match in POINT.finditer(positions):
        body = match["body"]
        groups |= SECOND_GROUP.search(body) is not None
        found[match["n"]] = pairs_of(SECOND_GROUP.sub("", body), r"[=:]")
        lines[match["n"]] = file.text[: len(program) + 4 + match.start()].count("\n") + 1
    if not found:
        raise InputError(f"{file.path}: the section /POS holds no point P[n]{{ ... }};")
    if shifted := SHIFTED.search(program):
        raise InputError(
            f"{file.path}: {shifted[0].strip()!r} goes to a place that the listing does not state ({shifted['how']}); "
            "write absolute points, or record the robot's positions"
        )
    names, notes = visiting_order(list(found), MOVE.findall(program))
    if registers := list(dict.fromkeys(REGISTER.findall(program))):
        notes += (f"moves to position registers, which the listing does not hold, are left out: {some(registers)}",)
    frames = [n for n in names if all(a in found[n] for a in FRAME)]
    kind, chosen = (FRAME, frames) if frames else (JOINTS, [n for n in names if all(a in found[n] for a in JOINTS)])
    if not chosen:
        raise InputError(f"{file.path}: no point has X, Y, Z, W, P and R, and none has J1 to J6")
    left = [f"P[{n}]" for n in names if n not in chosen]
    if left:
        notes += (f"points of another kind are left out: {some(left)}",)
    if groups:
        notes += ("a second motion group (GP2) is in the file; if it is the table, give its angles as alpha_deg",)
    rows = tuple(_row(found[n], kind, f"{file.path}: P[{n}]") for n in chosen)
    uf = one_value([found[n].get("UF", "?") for n in chosen], "the user frame (UF)", file.path)
    ut = one_value([found[n].get("UT", "?") for n in chosen], "the tool frame (UT)", file.path)
    return PoseLog(
        path=file.path,
        convention="fanuc",
        rows=rows if kind is FRAME else (),
        joints=rows if kind is JOINTS else None,
        source="set",
        pose_id=numbered([f"P{n}" for n in chosen]),
        lines=tuple(lines[n] for n in chosen),
        notes=(*notes, f"all poses are of tool frame {ut} in user frame {uf}; both must stay as they are for the scan"),
    )


def _row(values: dict[str, str], names: tuple[str, ...], where: str) -> Row:
    return tuple(number_word(values[name], where) for name in names)


KIND = Kind(name="fanuc", maker="FANUC", what="a TP program listing (.ls)", recognise=recognise, read_poses=read)
