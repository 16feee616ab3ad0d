"""Yaskawa Motoman: INFORM jobs (.jbi).  X Y Z in mm, Rx Ry Rz in deg about fixed axes: R = R_z R_y R_x.

Positions that a job keeps as encoder pulses say nothing without the robot's gears and are refused with how to proceed.
Source: Yaskawa, INFORM language manual (//POS, ///POSTYPE, ///RECTAN, ///PULSE, C00000=...).
"""

from __future__ import annotations

import re

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import number_word
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, numbered, one_value, visiting_order

POSITION = re.compile(r"^\s*(?P<name>[CP]\d{3,5})\s*=\s*(?P<values>.+?)\s*$")
HEADING = re.compile(r"^\s*///\s*(?P<key>[A-Z]+)\s*(?P<value>.*?)\s*$")
MOVE = re.compile(r"^\s*S?MOV[JLCS]\b.*?\b([CP]\d{3,5})\b")

SHIFTED = re.compile(r"^\s*(IMOV|SFTON)\b")


def recognise(file: ForeignFile) -> bool:
    """A job: it begins with /JOB."""
    return file.is_text and re.match(r"\s*/JOB\b", file.text) is not None


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The rectangular positions of a job, in the order of its moves."""
    kind, said = "", {"TOOL": "?", "POSTYPE": "?", "USER": ""}
    found: dict[str, tuple[str, ...]] = {}
    lines: dict[str, int] = {}
    frames: list[str] = []
    visited: list[str] = []
    for number, line in enumerate(file.lines, start=1):
        if heading := HEADING.match(line):
            if heading["key"] in ("RECTAN", "PULSE"):
                kind = heading["key"]
            elif heading["key"] in said:
                said[heading["key"]] = heading["value"]
        elif (position := POSITION.match(line)) and kind == "RECTAN":
            words = position["values"].split(",")
            if len(words) < 6:
                raise InputError(f"{file.path}: line {number}: {position['name']} has {len(words)} numbers, not 6")
            found[position["name"]] = tuple(number_word(w, f"{file.path}: line {number}") for w in words[:6])
            lines[position["name"]] = number
            frames.append(f"tool {said['TOOL']} in {said['POSTYPE']} {said['USER']}".strip())
        elif SHIFTED.match(line):
            raise InputError(
                f"{file.path}: line {number}: {line.strip()[:40]!r} moves relative to where the robot is; write "
                "absolute positions, or record them"
            )
        elif move := MOVE.match(line):
            visited.append(move[1])
    if not found:
        raise InputError(
            f"{file.path} keeps its positions as encoder pulses (///PULSE), which mean nothing without the robot's "
            "gears; convert the job to rectangular positions on the controller (relative job), or log Rx, Ry, Rz"
        )
    names, notes = visiting_order(list(found), visited)
    frame = one_value(frames, "tool or coordinate system", file.path)
    return PoseLog(
        path=file.path,
        convention="yaskawa",
        rows=tuple(found[n] for n in names),
        source="set",
        pose_id=numbered(names),
        lines=tuple(lines[n] for n in names),
        notes=(*notes, f"all poses are of {frame}; both must stay as they are for the scan"),
    )


KIND = Kind(name="yaskawa", maker="Yaskawa Motoman", what="an INFORM job (.jbi)", recognise=recognise, read_poses=read)
