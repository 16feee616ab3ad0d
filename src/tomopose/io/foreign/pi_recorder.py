"""PI's GCS array: what a controller's data recorder writes, a header of # lines and a table of numbers.

The header names each column (NAME0 = Actual Position of Axis AXIS:X), the separator as a character code and the sample
time.  Axes X Y Z in mm, U V W in deg.  Source: PI, GCS 2.0 manuals, "GCS array" and the data recorder.
"""

from __future__ import annotations

import re

import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import number_word
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, some

AXES = ("X", "Y", "Z", "U", "V", "W")
HEADER = re.compile(r"^\s*#\s*(?P<key>[A-Z][A-Z0-9_]*)\s*=\s*(?P<value>.*?)\s*$")
AXIS = re.compile(r"\bAXIS\s*:?\s*(?P<axis>[XYZUVW])\b", re.IGNORECASE)
MEASURED = re.compile(r"\b(actual|current|real)\b.*\bposition\b", re.IGNORECASE)
COMMANDED = re.compile(r"\b(commanded|target)\b.*\bposition\b", re.IGNORECASE)


def recognise(file: ForeignFile) -> bool:
    """A header with END_HEADER and column names."""
    return file.is_text and "END_HEADER" in file.text[:20000] and "NAME0" in file.text[:20000]


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The poses of a recording: measured, and commanded where they were recorded too."""
    header, names, first = _header(file)
    code = int(header.get("SEPARATOR", "32"))
    cells, lines = [], []
    for number, line in enumerate(file.lines[first:], start=first + 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = line.split() if code in (9, 32) else [w.strip() for w in line.split(chr(code))]
        if len(words) != len(names):
            raise InputError(f"{file.path}: line {number} has {len(words)} numbers, the header {len(names)} columns")
        cells.append([number_word(w, f"{file.path}: line {number}") for w in words])
        lines.append(number)
    if "NDATA" in header and int(header["NDATA"]) != len(cells):
        raise FileError(
            f"{file.path}: the header announces {header['NDATA']} rows, {len(cells)} follow; is the file truncated?",
            path=file.path,
        )
    measured, commanded = _columns(names, MEASURED), _columns(names, COMMANDED)
    main = measured or commanded
    missing = [a for a in AXES if a not in main]
    if missing:
        raise InputError(
            f"{file.path}: no recorded position of axis {', '.join(missing)}; a pose needs X, Y, Z, U, V and W "
            f"(recorded are: {'; '.join(names)})"
        )

    def rows(where: dict[str, int]) -> tuple[Row, ...]:
        return tuple(tuple(row[where[a]] for a in AXES) for row in cells)

    time = next((k for k, name in enumerate(names) if re.search(r"\btime\b", name, re.IGNORECASE)), None)
    times, seconds, clock = None, None, ""
    if time is not None:
        times, clock = tuple(row[time] for row in cells), "the recorder's time column, s"
        seconds = np.array([float(t) for t in times])
    elif "SAMPLE_TIME" in header:
        seconds, clock = float(header["SAMPLE_TIME"]) * np.arange(len(cells)), "sample time x row, s"
    both = measured and all(a in commanded for a in AXES)
    used = {*main.values(), *(commanded.values() if both else ()), *([time] if time is not None else [])}
    unused = [name for k, name in enumerate(names) if k not in used]
    return PoseLog(
        path=file.path,
        convention="pi-hexapod",
        rows=rows(main),
        set_rows=rows(commanded) if both else None,
        source="encoder" if measured else "set",
        times=times,
        seconds=seconds,
        clock=clock,
        lines=tuple(lines),
        notes=(f"columns not used: {some(unused)}",) if unused else (),
    )


def _header(file: ForeignFile) -> tuple[dict[str, str], list[str], int]:
    """Keys, column names, and the index of the line after the header."""
    keys: dict[str, str] = {}
    end = len(file.lines)
    for number, line in enumerate(file.lines):
        if "END_HEADER" in line:
            end = number + 1
            break
        if found := HEADER.match(line):
            keys[found["key"]] = found["value"]
    names: list[str] = []
    while f"NAME{len(names)}" in keys:
        names.append(keys[f"NAME{len(names)}"])
    if "DIM" in keys and int(keys["DIM"]) != len(names):
        raise InputError(f"{file.path}: the header announces {keys['DIM']} columns and names {len(names)}")
    return keys, names, end


def _columns(names: list[str], wanted: re.Pattern[str]) -> dict[str, int]:
    """Axis -> column of the positions of that kind."""
    return {m["axis"].upper(): k for k, name in enumerate(names) if wanted.search(name) and (m := AXIS.search(name))}


KIND = Kind(
    name="pi-recorder",
    maker="PI",
    what="a recording of the controller's data recorder (GCS array)",
    recognise=recognise,
    read_poses=read,
)
