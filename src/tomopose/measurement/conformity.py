"""The decision rule of ISO 14253-1: whether a result conforms to its limit.

A result conforms where its whole interval lies within the limit, does not conform where its whole interval lies beyond
it, and is not decidable in between.  The guard band is the half width U of the stated 95 % interval, on both sides.  An
interval that is not known decides nothing.

A form deviation is never smaller for noise.  It conforms by the same rule; it does not conform where it exceeds its
limit by more than its U and what noise of that size makes of a perfect feature.
"""

from __future__ import annotations

import math
from enum import Enum


class Decision(Enum):
    """Outcome of ISO 14253-1; the value is the sentence."""

    CONFORMING = "conforming"
    NOT_CONFORMING = "not conforming"
    NOT_DECIDABLE = "not decidable"

    @property
    def within(self) -> bool | None:
        """True, False, or None where nothing is proved."""
        return {Decision.CONFORMING: True, Decision.NOT_CONFORMING: False}.get(self)


def decide(error: float, U: float, limit: float) -> Decision:
    """Whether the interval error +- U lies within +- limit; any one unit."""
    if not (math.isfinite(error) and math.isfinite(U) and math.isfinite(limit)):
        return Decision.NOT_DECIDABLE
    if abs(error) + U <= limit:
        return Decision.CONFORMING
    return Decision.NOT_CONFORMING if abs(error) - U > limit else Decision.NOT_DECIDABLE


def decide_form(value: float, U: float, noise: float, limit: float) -> Decision:
    """As `decide`, for a form deviation; noise: the largest that noise alone makes, in 95 % of cases."""
    if math.isfinite(U) and value + U <= limit:
        return Decision.CONFORMING
    beyond = value - noise - (U if math.isfinite(U) else 0.0) > limit
    return Decision.NOT_CONFORMING if beyond else Decision.NOT_DECIDABLE
