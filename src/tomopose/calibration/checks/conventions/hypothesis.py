"""An alternative convention that was fitted: what it leaves, how it compares with the declared one, what is advised.

The measure is delta = (chi2_alternative - chi2_declared) / max(1, min of both / dof), both for the same number of
equations.  A comparison alone advises nothing: of forty wrong readings one always fits best.  An alternative is advised
only where its own residual is at most `FITS_SIGMAS` stated standard uncertainties and it places every ball between
focal spot and panel.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from tomopose.values import value

SAME, BETTER = 9.0, 25.0
"""delta below SAME (3 sigma): cannot be distinguished.  delta below -BETTER (5 sigma): the alternative fits better."""

GOOD_CHI2, CLEARLY = 4.0, 1.5
"""Where the alternative, too, leaves chi2/dof above GOOD_CHI2, poses or sigmas are wrong in ways of their own, and
delta has no such meaning: the alternative must lower chi2 by the factor CLEARLY to count as better."""

FITS_SIGMAS = 10.0
"""A reading whose centres lie more than this many stated standard uncertainties away explains nothing.  Wrong readings
of robot poses leave thousands; a manipulator in need of identification leaves up to a hundred, and then no convention
can be advised before its errors are known."""

BELONGING = 0.8
"""Share of the centres by which a reading is judged: up to 20 % may be outliers (`rigid.outliers.LARGEST_SHARE`)."""

BELONGING_MEAN = 2.0 * (1.0 - (1.0 - BELONGING) * np.log(1.0 / (1.0 - BELONGING)) / BELONGING)
"""Mean of the smallest BELONGING of chi2 values with 2 degrees of freedom (exponential, mean 2): 1.195."""

SMALL_SHARE, DECISIVE = 0.02, 100.0
"""Beyond FITS_SIGMAS an alternative is advised only where the machine's own errors can be what it leaves: at most
SMALL_SHARE of the centres' spread (robots and hexapods with nominal geometry leave 0.004 to 0.009, wrong readings of
robots' tables 0.2 to 0.7), and chi2 lowered by the factor DECISIVE, that is, residuals ten times smaller."""

WRONG_SIZE = 0.02
"""Difference of the silhouettes' size from which a reading is contradicted: two pixels at a radius of 100 px."""

MUCH_BETTER = 2.0
"""An alternative that fits better and lowers chi2 (floored at dof) by this factor makes a calibration untrustworthy."""

WORDS = {
    "declared": "as declared",
    "better": "fits significantly better than what was declared",
    "same": "cannot be distinguished with these poses",
    "worse": "excluded",
    "unfit": "does not fit either",
}


@value
class Hypothesis:
    """An alternative reading of the data, fitted.

    d_rms: px, eq. (8);  chi2, dof: of its fit;  sigmas: rms residual in stated standard uncertainties, of the 80 % that
    fit best;  delta: see above, 0 for the declared reading;  factor: chi2 of the declared reading over the
    alternative's, both floored at dof;  outcome: declared | better | same | worse | unfit;  symmetry: no plan could
    distinguish it;  length_factor: of `Alternative`;  ball_mm: distance of the ball from the focal spot, median;
    d_SR: of the scanner, mm;  possible: every ball is between focal spot and panel;
    share: d_rms over the spread of the centres;  size_ratio: measured size of the balls' silhouettes over that which
    this reading calculates; NaN where no outline or no diameter is known.
    """

    name: str
    words: str
    remedy: str
    d_rms: float
    chi2: float
    dof: int
    delta: float
    factor: float
    outcome: str
    sigmas: float = 0.0
    symmetry: bool = False
    length_factor: float = 1.0
    ball_mm: float = 0.0
    d_SR: float = 0.0
    possible: bool = True
    share: float = 0.0
    size_ratio: float = float("nan")

    @property
    def sized(self) -> bool | None:
        """Whether the silhouettes have the size that this reading calculates; None where that is not known."""
        return None if np.isnan(self.size_ratio) else abs(self.size_ratio - 1.0) <= WRONG_SIZE

    @property
    def off_axis(self) -> float:
        """|ln| of ball_mm over d_SR; inf where a ball cannot be there."""
        return float(abs(np.log(self.ball_mm / self.d_SR))) if self.ball_mm > 0 < self.d_SR else float("inf")

    @property
    def fits(self) -> bool:
        """Whether the residual is at most `FITS_SIGMAS`, or small enough for a machine's own errors."""
        return self.sigmas <= FITS_SIGMAS or 0.0 < self.share <= SMALL_SHARE

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "words": self.words,
            "cure": self.remedy,
            "d_rms_px": self.d_rms,
            "chi2": self.chi2,
            "dof": self.dof,
            "sigmas": self.sigmas,
            "delta_chi2": self.delta,
            "factor": self.factor,
            "outcome": self.outcome,
            "verdict": WORDS[self.outcome],
            "symmetry": self.symmetry,
            "length_factor": self.length_factor,
            "ball_mm": self.ball_mm,
            "d_SR_mm": self.d_SR,
            "possible": self.possible,
            "share": self.share,
            "size_ratio": None if np.isnan(self.size_ratio) else self.size_ratio,
        }


@value
class Diagnosis:
    """Hypotheses ranked by fit, best first; the declared reading is among them.

    better: alternatives that fit significantly better;  same: those that these poses cannot distinguish from the
    declared reading.
    """

    hypotheses: tuple[Hypothesis, ...]

    def named(self, outcome: str) -> tuple[Hypothesis, ...]:
        return tuple(h for h in self.hypotheses if h.outcome == outcome)

    @property
    def declared(self) -> Hypothesis:
        return self.named("declared")[0]

    @property
    def better(self) -> tuple[Hypothesis, ...]:
        return self.named("better")

    @property
    def same(self) -> tuple[Hypothesis, ...]:
        return self.named("same")

    @property
    def other_unit(self) -> Hypothesis | None:
        """The unit of the positions that fits as well as millimetres and places the ball where a scanner has it; with
        silhouettes, the one whose balls have their size."""
        units = [h for h in self.same if h.length_factor != 1.0 and h.sized is not False]
        if self.declared.sized:
            return None
        return min(units, key=lambda h: h.off_axis, default=None)

    @property
    def nothing_fits(self) -> bool:
        """Whether every reading, the declared one included, leaves more than `Hypothesis.fits` allows."""
        return not any(h.fits for h in self.hypotheses)

    @property
    def as_declared(self) -> bool:
        """Whether the declared reading fits and no alternative fits better or is likelier."""
        sized = self.declared.sized is not False
        return not self.better and self.declared.fits and self.other_unit is None and sized

    @property
    def leading(self) -> tuple[Hypothesis, ...]:
        """The alternative that fits best of those that fit better, and those that cannot be distinguished from it."""
        if not self.better:
            return ()
        unit = {h.name: h.chi2 * self.better[0].dof / max(h.dof, 1) for h in self.better}
        least = min(unit.values())
        noise = max(1.0, least / max(self.better[0].dof, 1))
        return tuple(h for h in self.better if unit[h.name] - least < SAME * noise)

    @property
    def nothing_fits_words(self) -> str:
        """Says how far the best reading is from fitting."""
        best = min(self.hypotheses, key=lambda h: h.sigmas)
        return (
            f"nothing fits: the best of {len(self.hypotheses)} readings ({best.words}) still leaves "
            f"{best.d_rms:.3g} px, {best.sigmas:.3g} stated standard uncertainties, where {FITS_SIGMAS:g} are the "
            "limit; no convention is advised. Check that images and poses belong together, the values in "
            "scanner.json, the centres' sigmas and whether the manipulator reaches the poses it reports"
        )

    @property
    def advice(self) -> tuple[str, ...]:
        """Sentences: what to change, what cannot be distinguished.  Nothing is changed by itself."""
        lines = [f"{h.words}: fits better (delta chi2 {h.delta:.3g}); to try: {h.remedy}" for h in self.leading]
        if len(lines) > 1:
            lines.append("these readings fit equally well; these poses cannot distinguish them from one another")
        if self.nothing_fits:
            lines.append(self.nothing_fits_words)
        if not lines:
            if self.other_unit is not None:
                lines.append(other_unit_words(self.other_unit, self.declared))
            elif self.declared.sized is False:
                lines.append(wrong_size_words(self.declared.size_ratio))
            alike = [h.name for h in self.same if not h.symmetry and h.length_factor == 1.0]
            if alike:
                lines.append(f"cannot be distinguished with these poses: {', '.join(alike)}")
        kept = [h.name for h in self.same if h.symmetry]
        if kept:
            lines.append(f"true symmetries, which no poses can distinguish: {', '.join(kept)}")
        return tuple(lines)


def other_unit_words(h: Hypothesis, declared: Hypothesis) -> str:
    """Why another unit of the positions is the likelier one, and what would settle it."""
    if h.sized:
        return (
            f"{h.words}: fits as well, and the balls' silhouettes then have the size of their diameter (ratio "
            f"{h.size_ratio:.3f}), where with millimetres it is {declared.size_ratio:.3g}; to try: {h.remedy}"
        )
    return (
        f"{h.words}: fits as well, and places the ball {h.ball_mm:.4g} mm from the focal spot, nearer to the rotation "
        f"axis, where millimetres place it at {declared.ball_mm:.4g} mm; to try: {h.remedy}. The ball's diameter with "
        "the outlines' semi axes, or another table angle, settles it; '# units: confirmed' in poses.csv says that they "
        "are millimetres"
    )


def wrong_size_words(ratio: float) -> str:
    """The silhouettes contradict the declared reading, and no other unit agrees with them."""
    return (
        f"the centres fit as declared, but the balls' silhouettes have {ratio:.3g} times the size that a ball of the "
        "stated diameter would throw from where this places it; the diameter (--ball-diameter-mm), the scale of the "
        "poses' translations or d_SD, d_SR and the pitches in scanner.json are wrong"
    )


def rank(found: Iterable[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Best first; see `_order`."""
    return tuple(sorted(found, key=_order))


def compared(declared: Hypothesis, other: Hypothesis) -> Hypothesis:
    """`other` with delta, factor and outcome against `declared`; `possible` and `sigmas` of both are known."""
    dof = declared.dof
    chi2 = other.chi2 * dof / other.dof
    delta = (chi2 - declared.chi2) / max(1.0, min(declared.chi2, chi2) / dof)
    factor = max(declared.chi2, dof) / max(chi2, dof)
    believable = chi2 < GOOD_CHI2 * dof or factor > CLEARLY
    outcome = "better" if delta < -BETTER and believable else "same" if delta < SAME else "worse"
    fits = other.sigmas <= FITS_SIGMAS or (0.0 < other.share <= SMALL_SHARE and factor > DECISIVE)
    if outcome != "worse" and not (fits and other.possible):
        outcome = "unfit"
    return replace(other, delta=float(delta), factor=float(factor), outcome=outcome)


def _order(h: Hypothesis) -> tuple[int, float]:
    """Better ones first, then the declared reading, then the others by their fit."""
    # readings that are the same for these poses keep their place in the list: rounding does not rank them
    return {"better": 0, "declared": 1}.get(h.outcome, 2), round(float(f"{h.delta:.6g}"), 6)
