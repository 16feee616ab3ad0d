"""Text as a table of cells: separator, header, a row of units, decimal commas, comment lines."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.table_text import COMMENT, DECIMAL_COMMA, NUMBER

FEWEST_COLUMNS = 6
UNITS = re.compile(r"[\[(]?(mm|m|cm|um|µm|deg|°|rad|s|ms|inch|-|)[\])]?", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class Cells:
    """A table as cells: header, rows, their lines, what the comment lines say."""

    headers: list[str]
    units_row: list[str] | None
    rows: list[list[str]]
    lines: list[int]
    comments: dict[str, str]
    decimal_comma: bool


def read_cells(file: ForeignFile, *, fewest: int = FEWEST_COLUMNS) -> Cells:
    """Header and rows.  The separator is that which gives all rows the header's number of cells, `fewest` or more."""
    comments: dict[str, str] = {}
    numbered = []
    for number, line in enumerate(file.lines, start=1):
        if line.lstrip().startswith(("#", "%", "//")):
            if found := COMMENT.match(line.strip()):
                comments[found["key"]] = found["value"].rstrip(",;\t ")
        elif line.strip():
            numbered.append((number, line))
    if len(numbered) < 2:
        raise InputError(f"{file.path} holds no table: {len(numbered)} lines of content")
    for separator in ("\t", ";", ",", None):
        split = [(n, _split(line, separator)) for n, line in numbered]
        start = _header_at(split, fewest)
        if start is not None:
            return _cells(file, split[start:], comments, separator)
    raise InputError(f"{file.path}: the lines have no common number of cells, with tabs, ;, commas or blanks between")


def _split(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    return [c.strip() for c in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]


def _header_at(split: list[tuple[int, list[str]]], fewest: int) -> int | None:
    """The index of the header: the first line from which on all lines have one number of cells."""
    width = len(split[-1][1])
    if width < fewest:
        return None
    start = len(split)
    while start > 0 and len(split[start - 1][1]) == width:
        start -= 1
    return start if start < len(split) - 1 and start <= 10 else None


def _cells(
    file: ForeignFile, split: list[tuple[int, list[str]]], comments: dict[str, str], separator: str | None
) -> Cells:
    headers, body = split[0][1], split[1:]
    if all(_is_number(c) for c in headers):
        headers, body = [str(k + 1) for k in range(len(headers))], split
    units = None
    if body and all(UNITS.fullmatch(c) for c in body[0][1]):
        units, body = body[0][1], body[1:]
    rows = [cells for _, cells in body]
    commas = separator != "," and any(DECIMAL_COMMA.fullmatch(c) for row in rows for c in row)
    points = [c for row in rows for c in row if "." in c and NUMBER.fullmatch(c)]
    if commas and points:
        raise InputError(f"{file.path}: numbers with decimal commas and with points ({points[0]}) are mixed")
    return Cells(
        headers=headers,
        units_row=units,
        rows=rows,
        lines=[n for n, _ in body],
        comments=comments,
        decimal_comma=commas,
    )


def _is_number(cell: str) -> bool:
    return NUMBER.fullmatch(cell) is not None or DECIMAL_COMMA.fullmatch(cell) is not None
