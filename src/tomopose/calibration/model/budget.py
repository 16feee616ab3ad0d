"""What the uncertainty of a scan is made of, in numbers and in the sentence of the first screen."""

from __future__ import annotations

from dataclasses import dataclass

from tomopose.calibration.model.assumed import Assumed
from tomopose.units import Array
from tomopose.values import value

NAMED, MOST_NAMED = 0.05, 3
"""Share of the variance from which an assumed value is named, and how many are."""

WORTH_NAMING = 0.5
"""A remedy is named where it halves the uncertainty."""


@dataclass(frozen=True, kw_only=True)
class ScanBudget:
    """px, root mean square over views, points and coordinates.

    total: with everything;  measured: if all that was assumed were exact;  shares: assumed name -> its part, largest
    first;  two_angles: the same poses, half of them at a second table angle; None where that is no remedy;
    tilted: the scan tilts the plate by 5 degrees, else the table turns alone.
    """

    total: float
    measured: float
    shares: tuple[tuple[str, float], ...] = ()
    two_angles: float | None = None
    tilted: bool = True


@value
class Halves:
    """How the calibrations from two disjoint halves of the poses differ over the field of view of a scan.

    x_D (k, 2) px: where points are imaged;  difference (k, 2) px, the object's rigid pose removed;  sigma (k, 2) px:
    its standard uncertainty;  rms_px, stated_px: of both;  p: probability of so much by chance.
    """

    x_D: Array
    difference: Array
    sigma: Array
    rms_px: float
    stated_px: float
    p: float


def budget_words(budget: ScanBudget, assumed: tuple[Assumed, ...]) -> str:
    """The sentence of the first screen, such as "0.12 px, of which 0.116 px from d_SR (no sigma given; 0.05 mm
    assumed). Two table angles would make it 0.001 px."."""
    scan = "tilted" if budget.tilted else "circular"
    words = f"a {scan} scan carries {budget.total:.2g} px of standard uncertainty, as a volume sees it"
    known = {a.name: a for a in assumed}
    parts: list[str] = []
    for name, px in budget.shares:
        if px**2 < NAMED * budget.total**2 or len(parts) == MOST_NAMED:
            break
        a = known.get(name)
        if a is None:
            parts.append(f"{px:.2g} px from {name} (no sigma given), which no ball shows")
            continue
        said = "no sigma given; " if a.source == "default" else ""
        value = f"{1000 * a.sigma:.3g} mrad" if a.unit == "rad" else f"{a.sigma:.3g} {a.unit}"
        parts.append(f"{px:.2g} px from {name} ({said}{value} assumed)")
    words += f", of which {', '.join(parts)}." if parts else "."
    if budget.two_angles is not None and budget.two_angles < WORTH_NAMING * budget.total:
        words += f" Two table angles would make it {budget.two_angles:.1g} px."
    return words
