"""Any table of poses: separator, decimal commas, header, units and columns are found, or named by the caller.

Nothing is passed over in silence: columns that are not used are named, units that nobody states are said, and rotations
whose names several makers use need `--convention`.
"""

from __future__ import annotations

import math
import re

from tomopose.errors import InputError
from tomopose.geometry.rotations import Convention
from tomopose.io.foreign import column_roles as roles
from tomopose.io.foreign.clock_words import iso_words, seconds_of
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import mm_words, number_word
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions, Row, some
from tomopose.io.foreign.table_cells import FEWEST_COLUMNS, Cells, read_cells


def recognise(file: ForeignFile) -> bool:
    """Text whose lines have six or more cells in columns."""
    if not file.is_text:
        return False
    try:
        cells = read_cells(file)
    except InputError:
        return False
    return len(cells.headers) >= FEWEST_COLUMNS and len(cells.rows) > 0


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The poses of a table."""
    cells = read_cells(file)
    columns = roles.columns_of(cells.headers, cells.units_row)
    notes: list[str] = []
    stated = cells.comments.get("convention", "").removesuffix("confirmed").rstrip(" ,")
    convention = roles.named_convention(options.convention or stated or None)
    if convention is None:
        convention, note = roles.convention_of(columns, file.path)
        notes.append(note)
    plain = {role: c for role in roles.NAMES if (c := roles.plain_role(columns, role)) is not None}
    if options.columns:
        position, angles, named = roles.chosen_columns(columns, options.columns, convention)
        plain |= named
    else:
        position, angles = _found(columns, convention, file)
    plain = {role: c for role, c in plain.items() if c not in (*position, *angles)}
    unit, note = roles.length_unit(position, options.units, file.path)
    notes += [note] if note else []
    angle_unit = roles.angle_unit(angles, convention, file.path)
    rows = _rows(file, cells, position, angles, unit, angle_unit, convention)
    set_position = roles.position_columns(columns, commanded=True)
    set_angles = roles.angle_columns(columns, convention, commanded=True)
    set_rows = None
    if set_position and set_angles and not options.columns:
        set_rows = _rows(file, cells, set_position, set_angles, unit, angle_unit, convention)
    else:
        set_position = set_angles = None
    used = {c.index for c in (*position, *angles, *plain.values(), *(set_position or ()), *(set_angles or ()))}
    unused = [c.header for c in columns if c.index not in used]
    if unused:
        notes.append(f"columns not used: {some(unused)}")
    if cells.decimal_comma:
        notes.append("decimal commas were read as points")
    return _log(file, cells, convention, rows, set_rows, plain, tuple(notes))


def _log(
    file: ForeignFile,
    cells: Cells,
    convention: Convention,
    rows: tuple[Row, ...],
    set_rows: tuple[Row, ...] | None,
    plain: dict[str, roles.Column],
    notes: tuple[str, ...],
) -> PoseLog:
    def words(role: str) -> tuple[str, ...] | None:
        column = plain.get(role)
        return None if column is None else tuple(row[column.index] for row in cells.rows)

    stamps = words("time")
    timed = None if stamps is None else seconds_of(stamps)
    source = cells.comments.get("source", "encoder")
    pivot = re.split(r"[\s,;]+", cells.comments.get("pivot_mm", "").strip("[]() "))
    alpha = words("alpha")
    return PoseLog(
        path=file.path,
        convention=convention.name,
        rows=rows,
        set_rows=set_rows,
        source="set" if source == "set" else "encoder",
        pose_id=words("pose_id"),
        image=words("image"),
        alpha=None if alpha is None else tuple(_number(w, cells, f"{file.path}: alpha") for w in alpha),
        ball_id=words("ball_id"),
        times=None if timed is None or stamps is None else (iso_words(stamps) or stamps),
        seconds=None if timed is None else timed[0],
        clock="" if timed is None else timed[1],
        pivot=(pivot[0], pivot[1], pivot[2]) if len(pivot) == 3 else None,
        lines=tuple(cells.lines),
        notes=notes if timed is not None or stamps is None else (*notes, "the time column holds no times; not used"),
    )


def _found(
    columns: list[roles.Column], convention: Convention, file: ForeignFile
) -> tuple[list[roles.Column], list[roles.Column]]:
    position = roles.position_columns(columns, commanded=False)
    angles = roles.angle_columns(columns, convention, commanded=False)
    if position is None or angles is None:
        stems = [c.rpartition("_")[0] or c for c in convention.columns]
        example = ",".join(f"{s}=..." for s in ("x", "y", "z", *stems))
        raise InputError(
            f"{file.path}: columns of x, y, z and {', '.join(stems)} (convention {convention.name}) were not "
            f"recognised among {', '.join(c.header for c in columns)}; name them: --columns {example}"
        )
    return position, angles


def _rows(
    file: ForeignFile,
    cells: Cells,
    position: list[roles.Column],
    angles: list[roles.Column],
    unit: str,
    angle_unit: str,
    convention: Convention,
) -> tuple[Row, ...]:
    out = []
    for row, line in zip(cells.rows, cells.lines, strict=True):
        where = f"{file.path}: line {line}"
        x = tuple(_number(row[c.index], cells, f"{where}, column {c.header}") for c in position)
        a = tuple(_number(row[c.index], cells, f"{where}, column {c.header}") for c in angles)
        out.append((*mm_words(x, unit), *(_angle(w, angle_unit, convention.unit) for w in a)))
    return tuple(out)


def _angle(word: str, unit: str, wanted: str) -> str:
    """An angle in the unit of the convention; exact where nothing has to be turned."""
    if wanted in (unit, "none"):
        return word
    value = float(word) * {"deg": 1.0, "rad": 180 / math.pi, "mrad": 0.18 / math.pi}[unit]
    return repr(value if wanted == "deg" else math.radians(value))


def _number(cell: str, cells: Cells, where: str) -> str:
    word = cell.strip().strip('"')
    if cells.decimal_comma:
        word = word.replace(",", ".")
    if not word:
        raise InputError(f"{where}: the cell is blank; give the number or leave the row out")
    return number_word(word, where)


KIND = Kind(name="csv", maker="any maker", what="a table of poses", recognise=recognise, read_poses=read)
