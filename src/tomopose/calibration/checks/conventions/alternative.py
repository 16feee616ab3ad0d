"""An alternative convention: the same data under another reading, and the line of the input that would change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tomopose.calibration.model.problem import Problem

Change = Callable[[Problem], Problem | None]
"""The problem that would be right if the data had been written so; None where the reading does not apply to them."""


@dataclass(frozen=True, kw_only=True)
class Alternative:
    """One alternative reading of the data.

    name: short, fixed;  words: what would then be true;  remedy: what to change in the input;  change: see `Change`.
    quick: every calibration tries it;  symmetry: the images are the same by nature, under any pose plan.
    length_factor: millimetres in one unit of the positions, where the reading says that they are in another unit.
    """

    name: str
    words: str
    remedy: str
    change: Change
    quick: bool = False
    symmetry: bool = False
    length_factor: float = 1.0
