"""Text tables: `# key: value` comments, one header line, rows of cells.

UTF-8 with or without a byte order mark, LF or CRLF.  The separator is read from the header line: a tab, else a
semicolon, else a comma.  In tables separated by tabs or semicolons numbers may be written with decimal commas, if all
of them are; that is reported as an InputWarning.
"""

from __future__ import annotations

import csv
import difflib
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tomopose.errors import InputError
from tomopose.io.notices import InputWarning
from tomopose.reading import read_text, reader
from tomopose.units import Array

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
DECIMAL_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")
NUMPY_REPR = re.compile(r"np\.float64\((?P<number>.*)\)")
"""What repr() of a NumPy 2 scalar leaves in tables written by scripts; the number in it is exact."""
PLACEHOLDER = re.compile(r"[+-]?9{4,}(\.9*0*)?")
"""9999, -99999, 9999.9 ...: how controllers and spreadsheets write "no value"."""
LONGEST_LINE, LONGEST_CELL = 100_000, 2000
"""Characters; the longest cell of a sound table is a file name or a reason in words."""
COMMENT = re.compile(r"#\s*(?P<key>[A-Za-z][A-Za-z0-9_ -]*?)\s*:\s*(?P<value>.*?)\s*$")


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table as text.  comments: key -> value; rows: cells; lines: line number of each row in the file, from 1."""

    path: Path
    comments: Mapping[str, str]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    decimal_comma: bool = False

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, row: int, column: str) -> str:
        """How messages name a cell."""
        return f"{self.path}: row {row + 1} (line {self.lines[row]}), column {column}"

    def words(self, column: str) -> tuple[str, ...]:
        """The cells of a column; InputError where one is blank."""
        k = self.columns.index(column)
        cells = tuple(row[k] for row in self.rows)
        for i, cell in enumerate(cells):
            if not cell:
                raise InputError(f"{self.where(i, column)}: the cell is blank")
        return cells

    def numbers(self, column: str, *, blank: Sequence[bool] | None = None) -> Array:
        """A column as numbers (n,).  Rows where `blank` is true may be blank or nan, and give nan.

        Raises InputError, naming row and column, for blank, nan, inf, text, and placeholders such as 9999.
        """
        k = self.columns.index(column)
        values = np.empty(len(self.rows))
        for i, row in enumerate(self.rows):
            cell = row[k]
            if blank is not None and blank[i] and cell.lower() in ("", "nan"):
                values[i] = np.nan
            else:
                values[i] = self._number(cell, i, column)
        return values

    def whole_numbers(self, column: str) -> np.ndarray:
        """A column of whole numbers from 0, (n,) int64.  InputError names row and column of any other."""
        values = self.numbers(column)
        for i in np.flatnonzero((values != np.round(values)) | (values < 0)):
            raise InputError(f"{self.where(int(i), column)}: {values[i]:g} is no whole number from 0")
        return values.astype(np.int64)

    def digits(self, cell: str) -> str:
        """A cell's number as Python writes it."""
        written = NUMPY_REPR.fullmatch(cell)
        cell = written["number"] if written else cell
        return cell.replace(",", ".") if self.decimal_comma else cell

    def _number(self, cell: str, row: int, column: str) -> float:
        if not cell:
            raise InputError(f"{self.where(row, column)}: the cell is blank; give the number or leave the row out")
        cell = self.digits(cell)
        if not NUMBER.fullmatch(cell):
            raise InputError(f"{self.where(row, column)}: {cell!r} is no finite number")
        if PLACEHOLDER.fullmatch(cell):
            raise InputError(f"{self.where(row, column)}: {cell} denotes a missing value; leave the row out")
        value = float(cell)
        if not np.isfinite(value):
            raise InputError(f"{self.where(row, column)}: {cell!r} is too large for a number")
        return value


@reader("table")
def read_table(path: str | Path) -> TextTable:
    """Read a table.  Blank lines are skipped; a comment key that returns with another value is refused."""
    path = Path(path)
    comments: dict[str, str] = {}
    header: tuple[str, ...] | None = None
    separator = ","
    rows: list[tuple[str, ...]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.lstrip().startswith("#"):
            _add_comment(comments, line.strip(), path, number)
            continue
        if not line.strip():
            continue
        if header is None:
            separator = next((s for s in "\t;" if s in line), ",")
        cells = _cells(line, separator, path, number)
        if header is None:
            header = cells
        elif len(cells) != len(header):
            raise InputError(
                f"{path}: line {number} has {len(cells)} cells, the header {len(header)} columns"
                + (" (decimal commas? separate the cells by ; or tabs then)" if separator == "," else "")
            )
        else:
            rows.append(cells)
            lines.append(number)
    if header is None or not rows:
        raise InputError(f"{path} holds no rows" if header else f"{path} holds no header line")
    twice = [name for name, count in Counter(header).items() if count > 1]
    if twice:
        raise InputError(f"{path}: column {twice[0]!r} appears more than once")
    return TextTable(
        path=path,
        comments=comments,
        columns=header,
        rows=tuple(rows),
        lines=tuple(lines),
        decimal_comma=_has_decimal_commas(path, separator, rows),
    )


def _cells(line: str, separator: str, path: Path, number: int) -> tuple[str, ...]:
    """The cells of a line; InputError where line or cell are too long to be a table's."""
    if len(line) > LONGEST_LINE:
        raise InputError(f"{path}: line {number} has {len(line)} characters; no table has lines like that")
    cells = tuple(cell.strip() for cell in next(csv.reader([line], delimiter=separator)))
    longest = max(map(len, cells))
    if longest > LONGEST_CELL:
        raise InputError(f"{path}: line {number} has a cell of {longest} characters; at most {LONGEST_CELL} are read")
    return cells


def _add_comment(comments: dict[str, str], line: str, path: Path, number: int) -> None:
    found = COMMENT.match(line)
    if not found:
        return
    key, value = found["key"], found["value"].strip().rstrip(",;\t ")  # spreadsheets pad comment lines with separators
    if comments.setdefault(key, value) != value:
        raise InputError(
            f"{path}: line {number}: {key} changes from {comments[key]!r} to {value!r} within the file; "
            "split the table where it changes"
        )


def _has_decimal_commas(path: Path, separator: str, rows: list[tuple[str, ...]]) -> bool:
    if separator == ",":
        return False
    cells = [cell for row in rows for cell in row]
    commas = [cell for cell in cells if DECIMAL_COMMA.fullmatch(cell)]
    if not commas:
        return False
    points = [cell for cell in cells if "." in cell and NUMBER.fullmatch(cell)]
    if points:
        raise InputError(f"{path}: numbers with decimal commas ({commas[0]}) and with points ({points[0]}) are mixed")
    warnings.warn(f"{path}: decimal commas were read as points ({commas[0]})", InputWarning, stacklevel=4)
    return True


def unknown_column(column: str, known: Sequence[str]) -> str:
    """The end of a message about an unknown name: what is near, and all that is known."""
    near = difflib.get_close_matches(column, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"{hint} Known are: {', '.join(known)}" if hint else f"; known are: {', '.join(known)}"


def format_table(comments: Mapping[str, str], columns: Mapping[str, Sequence[object]]) -> str:
    """CSV text: floats with all their digits (repr), values that are not finite as blank."""
    out = [f"# {key}: {value}" for key, value in comments.items()]
    lines: list[Sequence[object]] = [list(columns), *zip(*columns.values(), strict=True)]
    for row in lines:
        out.append(",".join(_cell(value) for value in row))
    return "\n".join(out) + "\n"


def _cell(value: object) -> str:
    if isinstance(value, (float, np.floating)):
        return repr(float(value)) if np.isfinite(value) else ""
    text = str(value)
    if any(c in text for c in "\r\n"):
        raise InputError(f"the text {text!r} holds a line break; a table cell cannot")
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',;"\t') else text
