"""Trustworthy, doubtful or rejected: decided here, from the findings of a calibration and from nothing else."""

from __future__ import annotations

from abc import ABC
from collections.abc import Iterable
from typing import Literal, TypeAlias, get_args

from tomopose.errors import ShapeError
from tomopose.values import value

Verdict: TypeAlias = Literal["trustworthy", "doubtful", "rejected"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
"""From the best to the worst."""


@value
class Finding:
    """What one rule found.

    rule:    name of the rule, as in `rules.RULES`.
    value, limit: what was measured, and what it was compared with; NaN where the rule compares no numbers.
    words:   a sentence.   remedy: what to do about it, "" where nothing is known to help.
    verdict: what this finding alone makes of the calibration; "trustworthy": worth knowing, no ground for doubt.
    """

    rule: str
    value: float
    limit: float
    words: str
    remedy: str = ""
    verdict: Verdict

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ShapeError(f"verdict {self.verdict!r} is not one of {', '.join(VERDICTS)}")


class Judged(ABC):
    """What has findings has a verdict: it follows from them and from nothing else."""

    checks: tuple[Finding, ...]

    @property
    def verdict(self) -> Verdict:
        """trustworthy | doubtful | rejected: the worst of the findings."""
        return judge(self.checks)[0]

    @property
    def reasons(self) -> tuple[str, ...]:
        """The words of the findings that give doubt, worst first."""
        return judge(self.checks)[1]


def judge(checks: Iterable[Finding]) -> tuple[Verdict, tuple[str, ...]]:
    """(verdict, reasons): the worst of all findings, and the words of every finding that gives doubt, worst first."""
    ranked = sorted(checks, key=lambda f: -VERDICTS.index(f.verdict))
    worst = ranked[0].verdict if ranked else VERDICTS[0]
    return worst, tuple(f.words for f in ranked if f.verdict != VERDICTS[0])
