"""Positions as Python prints them: `OrderedDict([('X', 1.0), ...])` or `{'X': 1.0, ...}`, one pose a line.

That is what a script that asks a PI controller through a Python library writes to its log (qPOS, qMOV).
"""

from __future__ import annotations

import re

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import number_word
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, some

AXES = ("X", "Y", "Z", "U", "V", "W")
ENTRY = re.compile(r"""\(?\s*['"](?P<axis>[A-Z])['"]\s*[:,]\s*(?P<value>np\.float64\([^)]*\)|[^,)}\s]+)""")
COMMANDED = re.compile(r"\bqMOV\b|\bMOV\b|\b(set|target|soll)\b", re.IGNORECASE)


def recognise(file: ForeignFile) -> bool:
    """Lines in which a dictionary has the axes X and U."""
    return file.is_text and any(_axes(line) >= {"X", "Y", "Z", "U", "V", "W"} for line in file.lines[:50])


def _axes(line: str) -> set[str]:
    return {m["axis"] for m in ENTRY.finditer(line)}


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """A pose a line; lines that name qMOV are the commanded poses of the measured ones beside them."""
    measured, commanded, lines, left = [], [], [], []
    for number, line in enumerate(file.lines, start=1):
        values = {m["axis"]: m["value"] for m in ENTRY.finditer(line)}
        if not values:
            if line.strip() and not line.lstrip().startswith("#"):
                left.append(f"line {number}")
            continue
        missing = [a for a in AXES if a not in values]
        if missing:
            raise InputError(f"{file.path}: line {number}: the dictionary lacks {', '.join(missing)}")
        row: Row = tuple(number_word(values[a], f"{file.path}: line {number}: {a}") for a in AXES)
        if COMMANDED.search(line.split("{")[0].split("(")[0]):
            commanded.append(row)
        else:
            measured.append(row)
            lines.append(number)
    if commanded and measured and len(commanded) != len(measured):
        raise InputError(f"{file.path}: {len(measured)} measured and {len(commanded)} commanded poses do not pair")
    rows = measured or commanded
    return PoseLog(
        path=file.path,
        convention="pi-hexapod",
        rows=tuple(rows),
        set_rows=tuple(commanded) if commanded and measured else None,
        source="encoder" if measured else "set",
        lines=tuple(lines) if measured else None,
        notes=(f"lines without a dictionary are passed over: {some(left)}",) if left else (),
    )


KIND = Kind(
    name="pi-python",
    maker="PI",
    what="positions that a Python script printed as dictionaries",
    recognise=recognise,
    read_poses=read,
)
