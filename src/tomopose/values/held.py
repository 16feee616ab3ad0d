"""Values that one can hold: frozen, compared by content, shown on one screen, read as tables.

`@value` makes a frozen, keyword-only dataclass with

    ==, hash     by content: arrays element by element (NaN equals NaN, 0.0 equals -0.0), never by identity;
    repr         one line a field, arrays by shape and range; `_repr_html_` the same as a table, for notebooks.

`Rows` adds to a value of n rows with names: len, indexing by number, by pose id, by slice or mask, iteration, and
`to_dataframe`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import html
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar, dataclass_transform, overload

import numpy as np

from tomopose.errors import EngineMissingError, InputError

if TYPE_CHECKING:
    import pandas

T = TypeVar("T")
Column = Sequence[object] | np.ndarray
R = TypeVar("R", bound="Rows")

WIDEST = 120
MOST_LINES = 22
"""Lines of a repr under its first: a screen of a terminal has 24."""

SHOWN = 96
"""Characters of a field in a repr; longer ones are cut with an ellipsis, so that a value fits one screen."""


def equal(a: object, b: object) -> bool:
    """Whether two fields hold the same: arrays, mappings and sequences by content, NaN equal to NaN."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = np.asarray(a), np.asarray(b)
        if a.shape != b.shape or a.dtype.kind != b.dtype.kind:
            return False
        return bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fc"))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(equal(v, b[k]) for k, v in a.items())
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(equal, a, b))
    if isinstance(a, float) and isinstance(b, float) and math.isnan(a):
        return math.isnan(b)
    if _is_plain_dataclass(a):
        return type(a) is type(b) and all(equal(x, y) for x, y in zip(_members(a), _members(b), strict=True))
    return bool(a == b)


def _is_plain_dataclass(a: object) -> bool:
    """Whether a value is a dataclass that compares its fields by ==, which arrays do not answer."""
    return dataclasses.is_dataclass(a) and not isinstance(a, type) and type(a).__eq__ is not _eq


def _members(a: object) -> list[object]:
    return [getattr(a, f.name) for f in dataclasses.fields(a) if f.compare]  # type: ignore[arg-type]


def content_hash(a: object) -> int:
    """A hash that agrees with `equal`.  TypeError where a field holds what has no content of its own (an open file)."""
    if isinstance(a, np.ndarray):
        if a.dtype.kind == "f":
            a = np.where(np.isnan(a), np.nan, a.astype(np.float64) + 0.0)
        digest = hashlib.blake2b(np.ascontiguousarray(a).tobytes(), digest_size=8).digest()
        return hash((a.shape, digest))
    if isinstance(a, Mapping):
        return hash(frozenset((k, content_hash(v)) for k, v in a.items()))
    if isinstance(a, (list, tuple)):
        return hash(tuple(map(content_hash, a)))
    if isinstance(a, float) and math.isnan(a):
        return hash("nan")
    if _is_plain_dataclass(a):
        return hash((type(a).__name__, *map(content_hash, _members(a))))
    return hash(a)


def shown(a: object) -> str:
    """A field on one line."""
    if isinstance(a, np.ndarray) and a.size > 12:
        text = f"array {a.shape} {a.dtype}"
        if a.dtype.kind in "fiu" and np.isfinite(a).any():
            finite = a[np.isfinite(a)]
            text += f", {finite.min():.6g} to {finite.max():.6g}"
    elif isinstance(a, np.ndarray):
        text = " ".join(np.array2string(a, precision=6, separator=", ").split())
    elif isinstance(a, (list, tuple)) and len(a) > 6:
        text = f"{len(a)}: {a[0]!r}, {a[1]!r} ... {a[-1]!r}"
    elif isinstance(a, Mapping):
        text = "{" + ", ".join(f"{k!r}: {shown(v)}" for k, v in a.items()) + "}"
    else:
        text = " ".join(repr(a).split())
    text = " ".join(text.split())
    return text if len(text) <= SHOWN else text[: SHOWN - 1] + "\u2026"


def _fields(value: object) -> list[tuple[str, object]]:
    """Fields that are given (not None) and part of the repr."""
    named = [(f.name, getattr(value, f.name)) for f in dataclasses.fields(value) if f.repr]  # type: ignore[arg-type]
    return [(name, held) for name, held in named if held is not None]


def _repr(self: object) -> str:
    size = f" of {len(self)}" if isinstance(self, Rows) else ""
    lines = [f"  {name} = {shown(held)}"[:WIDEST] for name, held in _fields(self)]
    if len(lines) > MOST_LINES:
        more = len(lines) - MOST_LINES + 1
        lines[MOST_LINES - 1 :] = [f"  and {more} more fields"]
    return "\n".join([f"{type(self).__name__}{size}", *lines])


def _repr_html(self: object) -> str:
    size = f" of {len(self)}" if isinstance(self, Rows) else ""
    rows = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td style='text-align:left'>"
        f"{html.escape(shown(held))}</td></tr>"
        for name, held in _fields(self)
    )
    return f"<table><caption>{html.escape(type(self).__name__ + size)}</caption>{rows}</table>"


def _eq(self: object, other: object) -> object:
    if type(other) is not type(self):
        return NotImplemented
    return all(
        equal(getattr(self, f.name), getattr(other, f.name))
        for f in dataclasses.fields(self)  # type: ignore[arg-type]
        if f.compare
    )


def _hash(self: object) -> int:
    fields = [f for f in dataclasses.fields(self) if f.compare]  # type: ignore[arg-type]
    return hash((type(self).__name__, *(content_hash(getattr(self, f.name)) for f in fields)))


@overload
def value(cls: type[T]) -> type[T]: ...
@overload
def value(*, kw_only: bool) -> Callable[[type[T]], type[T]]: ...
@dataclass_transform(kw_only_default=True, frozen_default=True, eq_default=True, field_specifiers=(dataclasses.field,))
def value(cls: type[T] | None = None, *, kw_only: bool = True) -> type[T] | Callable[[type[T]], type[T]]:
    """Class decorator: a frozen, keyword-only dataclass that is compared, hashed and shown by content.

    kw_only=False lets the fields be given by place too, for values whose first fields need no name.
    """

    def decorate(kind: type[T]) -> type[T]:
        for name, method in {"__eq__": _eq, "__hash__": _hash, "__repr__": _repr, "_repr_html_": _repr_html}.items():
            if name not in vars(kind):
                setattr(kind, name, method)
        return dataclasses.dataclass(frozen=True, kw_only=kw_only, eq=False, repr=False)(kind)

    return decorate if cls is None else decorate(cls)


TONES = {"trustworthy": "#1a6b3d", "doubtful": "#8a5200", "rejected": "#b3261e"}
"""Colours of the verdicts, readable on white and, as borders, on dark grounds."""


def verdict_html(verdict: str, lines: Sequence[str], columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A verdict, what it rests on, and a table, as a notebook shows them; all texts are escaped."""
    said = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    head = "".join(f'<th scope="col">{html.escape(c)}</th>' for c in columns)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    colour = TONES.get(verdict, "#55606d")
    return (
        f'<div style="border-left: 5px solid {colour}; padding-left: 12px"><b>{html.escape(verdict.capitalize())}</b>'
        f"<ul>{said}</ul></div><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


class Tabular(ABC):
    """What has a column of numbers for each of its views or poses."""

    @abstractmethod
    def columns(self) -> dict[str, Column]:
        """Name (with its unit) -> one entry a row."""

    @abstractmethod
    def row_names(self) -> tuple[str, ...]:
        """The rows' pose ids."""

    def to_dataframe(self) -> pandas.DataFrame:
        """`columns` as a pandas table, indexed by pose id.  EngineMissingError where pandas is not installed."""
        return table(self.columns(), self.row_names(), "pose_id")


class Rows(Tabular):
    """n rows with the names `pose_id`: what sequences of poses, observations and matrices have in common.

    A number, a pose id, a slice, a mask or a list of either selects rows; the result is of the same kind, also for one
    row.  Iteration gives the rows one by one.
    """

    pose_id: tuple[str, ...]

    @abstractmethod
    def select(self: R, index: object) -> R:
        """The rows with those indices (or that mask or slice), in that order."""

    def row_names(self) -> tuple[str, ...]:
        """The rows' pose ids."""
        return self.pose_id

    def __len__(self) -> int:
        return len(self.pose_id)

    def __getitem__(self: R, index: object) -> R:
        if isinstance(index, str):
            index = [index]
        if isinstance(index, (int, np.integer)) and not isinstance(index, bool):
            if not -len(self) <= index < len(self):
                raise IndexError(f"row {index} of {len(self)}")
            index = [int(index)]
        if isinstance(index, (list, tuple)) and any(isinstance(i, str) for i in index):
            return self.select(self.index_of(index))
        return self.select(index)

    def __iter__(self: R) -> Iterator[R]:
        return (self[k] for k in range(len(self)))

    def index_of(self, pose_id: Sequence[str]) -> np.ndarray:
        """Row numbers of those ids; InputError names an id that is not here."""
        where = {p: k for k, p in enumerate(self.pose_id)}
        unknown = [p for p in pose_id if p not in where]
        if unknown:
            held = f"{len(self)} rows from {self.pose_id[0]!r} to {self.pose_id[-1]!r}" if len(self) else "no rows"
            raise InputError(
                f"{len(unknown)} pose ids are not in the pose table, the first is {unknown[0]!r}; "
                f"the table holds {held}"
            )
        return np.array([where[p] for p in pose_id], dtype=np.intp)


def table(columns: Mapping[str, Column], index: Sequence[str], name: str) -> pandas.DataFrame:
    """A pandas table.  EngineMissingError where pandas is not installed."""
    try:
        import pandas
    except ImportError as error:
        raise EngineMissingError("pandas is not installed", install_line="pip install pandas") from error
    return pandas.DataFrame(dict(columns), index=pandas.Index(index, name=name))
