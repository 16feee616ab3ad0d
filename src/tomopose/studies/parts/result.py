"""What a study gives: printed numbers beside ours, what they show, and figures; one immutable value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from tomopose.errors import InputError
from tomopose.provenance import Provenance
from tomopose.report.page import Figure

Scale = Literal["small", "paper"]
SCALES: tuple[Scale, ...] = ("small", "paper")
Progress = Callable[[int, int], None]

DEFAULT_SEED = 2023


def require_scale(scale: str) -> None:
    if scale not in SCALES:
        raise InputError(f"unknown scale {scale!r}; known are {', '.join(SCALES)}")


@dataclass(frozen=True, kw_only=True)
class StudyRow:
    """One quantity, three ways.

    group, quantity, unit: what it is.  source: where the paper prints it ("table 1, row 4"), or empty.
    printed:      the paper's value, None where it prints none.
    paper_method: ours by the paper's method; u_paper_method: its standard uncertainty where one is stated.
    best:         ours by our best; u: its standard uncertainty where one is stated.
    """

    group: str
    quantity: str
    unit: str
    source: str = ""
    printed: float | None = None
    paper_method: float | None = None
    u_paper_method: float | None = None
    best: float | None = None
    u: float | None = None
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class StudyCheck:
    """A statement that the study was made to test, what was found, and whether it holds."""

    statement: str
    found: str
    holds: bool


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    """A study's outcome.

    paper:   which table or figure it repeats.  question: what it asks, in a sentence.
    rows, checks, figures: numbers, statements and pictures.  notes: what differs from the paper, and why.
    seconds: wall time of this run; what was taken from an earlier, interrupted run is not counted.  processor_seconds:
    of this process; compile_seconds: by the clock, while kernels were compiled, 0 where all were kept.
    """

    name: str
    title: str
    paper: str
    question: str
    scale: Scale
    seed: int
    rows: tuple[StudyRow, ...]
    checks: tuple[StudyCheck, ...]
    figures: tuple[Figure, ...]
    notes: tuple[str, ...]
    seconds: float
    processor_seconds: float
    compile_seconds: float
    provenance: Provenance

    @property
    def holds(self) -> bool:
        """Whether every statement holds."""
        return all(c.holds for c in self.checks)

    def row(self, group: str, quantity: str) -> StudyRow:
        """The row of that group and quantity; InputError where it is not found."""
        for row in self.rows:
            if (row.group, row.quantity) == (group, quantity):
                return row
        raise InputError(f"study {self.name} has no row {quantity!r} of {group!r}")

    def to_json(self) -> dict[str, Any]:
        """The content of study.json."""
        return {
            "name": self.name,
            "title": self.title,
            "paper": self.paper,
            "question": self.question,
            "scale": self.scale,
            "seed": self.seed,
            "holds": self.holds,
            "rows": [asdict(r) for r in self.rows],
            "checks": [asdict(c) for c in self.checks],
            "figures": [f.title for f in self.figures],
            "notes": list(self.notes),
            "seconds": self.seconds,
            "processor_seconds": self.processor_seconds,
            "compile_seconds": self.compile_seconds,
            "provenance": self.provenance.to_json(),
        }


def check_below(statement: str, value: float, limit: float, unit: str) -> StudyCheck:
    """Holds where value <= limit."""
    return StudyCheck(
        statement=statement, found=f"{value:.3g} {unit} (limit {limit:.3g})".strip(), holds=bool(value <= limit)
    )


def check_between(statement: str, value: float, low: float, high: float, unit: str) -> StudyCheck:
    """Holds where low <= value <= high."""
    return StudyCheck(
        statement=statement,
        found=f"{value:.3g} {unit} (from {low:g} to {high:g})".strip(),
        holds=bool(low <= value <= high),
    )
