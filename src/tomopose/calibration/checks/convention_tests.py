"""Could the data have been written in another convention?  Every alternative is fitted and ranked, none is applied.

The measure is delta = (chi2_alternative - chi2_declared) / max(1, min of both / dof), both for the same number of
equations.  An alternative that fits better and still leaves a drift or a step in time is compared again with both free
to follow it.

A comparison alone advises nothing: of forty wrong readings one always fits best.  An alternative is advised only where
its own residual is at most `FITS_SIGMAS` stated standard uncertainties and it places every ball between focal spot and
panel.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.calibration.checks.alternative import Alternative
from tomopose.calibration.checks.conventions import ALTERNATIVES, ALTERNATIVES_OF_MOVING_SCANNER
from tomopose.calibration.checks.placement import Placement, beams, better_placed, placement
from tomopose.calibration.checks.stability import SIGNIFICANT, Effect, chi2_with_movements, movements
from tomopose.calibration.model.parameters import (
    UNITS,
    FreeParameters,
    ImpossibleScannerError,
    adjusted_scanners,
    free_parameters,
)
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.model.silhouettes import chain_matrices, size_ratio_of
from tomopose.calibration.rigid.estimate import best_fit
from tomopose.calibration.rigid.fit import Fit, minimise, residuals, whitened2
from tomopose.calibration.rigid.start import Rays, closed_form, other_starts, ray_equations, turned_about_beam
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array
from tomopose.values import require_types, value

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

ITERATIONS = 20
"""An alternative that is right needs fewer; one that is wrong is not worth more."""

FIRST_ROWS, HOPELESS = 48, 100.0
"""Where there are more than twice as many rows, an alternative is fitted to so many of them first; one that then leaves
so many times the declared reading's chi2 (or dof) in all rows is wrong, and is not fitted to all of them."""

SCANNER_GAIN = 1e3
"""Values of the scanner that were off by 30 times what is assumed of them would lower chi2 so much."""

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


def _size_ratio(problem: Problem, free: FreeParameters, fit: Fit) -> float:
    """Measured size of the silhouettes over the calculated one; NaN where it is not known or cannot be calculated."""
    if problem.outline is None or problem.ball_diameter is None or not np.isfinite(fit.chi2):
        return float("nan")
    try:
        scanners = adjusted_scanners(problem.scanners, free, fit.delta)
    except ImpossibleScannerError:  # a wrong reading may end anywhere
        return float("nan")
    found = size_ratio_of(problem, chain_matrices(problem, scanners, fit.T_HT), fit.t[problem.ball])
    return float("nan") if found is None else found


@dataclass(frozen=True, kw_only=True)
class _Left:
    """What a fit leaves.  d_rms: px;  sigmas: rms residual of a coordinate in stated standard uncertainties, of the
    80 % of the centres that fit best;  share: d_rms over the rms spread of the centres."""

    d_rms: float
    sigmas: float
    share: float

    @classmethod
    def of(cls, problem: Problem, free: FreeParameters, fit: Fit) -> _Left:
        r = residuals(problem, free, fit)
        d2 = np.sort(whitened2(problem, r))
        kept = d2[: max(1, int(np.ceil(BELONGING * len(d2))))]
        d_rms = float(np.sqrt((r**2).sum() / len(r)))
        spread = float(np.sqrt(((problem.x_D - problem.x_D.mean(axis=0)) ** 2).sum() / len(r)))
        return cls(
            d_rms=d_rms,
            sigmas=float(np.sqrt(kept.mean() / BELONGING_MEAN)),
            share=d_rms / spread if spread > 0 else 0.0,
        )


def residual_sigmas(problem: Problem, free: FreeParameters, fit: Fit) -> float:
    """rms residual of a coordinate in stated standard uncertainties, of the 80 % of the centres that fit best."""
    return _Left.of(problem, free, fit).sigmas


def _fit_alternative(
    problem: Problem, rays: Rays, free: FreeParameters, held: FreeParameters, starts: int, hopeless: float
) -> Fit:
    """The optimum under an alternative, or where part of the rows lead if that leaves a hopeless chi2 in all rows."""
    if starts or len(problem) <= 2 * FIRST_ROWS or len(problem.ball_ids) > 1:
        return _optimum(problem, rays, free, held, starts, np.inf)
    rows = np.unique(np.linspace(0, len(problem) - 1, FIRST_ROWS).round().astype(int))
    few = Rays(n=rays.n[rows], d=rays.d[rows], source=rays.source)
    part = _optimum(problem.select(rows), few, free, held, 0, SCANNER_GAIN * hopeless * len(rows) / len(problem))
    whole = minimise(problem, free, part, iterations=0)
    return minimise(problem, free, whole, iterations=ITERATIONS) if whole.chi2 < hopeless else whole


def optimum_under(problem: Problem, free: FreeParameters) -> Fit:
    """The optimum of a problem that an alternative made."""
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    return _optimum(problem, ray_equations(problem), free, held, 0, np.inf)


def _optimum(
    problem: Problem, rays: Rays, free: FreeParameters, held: FreeParameters, starts: int, enough: float
) -> Fit:
    """The optimum under an alternative; one that leaves more than `enough` with the scanner held ends there."""
    start = closed_form(problem, rays)
    fit = minimise(problem, held, start, iterations=ITERATIONS)
    if not np.isfinite(fit.chi2):
        fit = minimise(problem, held, turned_about_beam(problem, start[0], rays), iterations=ITERATIONS)
    if not np.isfinite(fit.chi2):
        # mirrored data have no closed form in front of the source; the residual they leave is still worth knowing
        others = (
            minimise(problem, held, start, iterations=ITERATIONS)
            for start in itertools.islice(other_starts(problem, rays), starts)
        )
        fit = minimise(problem, held, min((fit, *others), key=lambda one: one.chi2))
    return minimise(problem, free, fit, iterations=ITERATIONS) if len(free) and fit.chi2 < enough else fit


@dataclass(frozen=True, kw_only=True)
class _Declared:
    """The declared reading that alternatives are judged against."""

    problem: Problem
    free: FreeParameters
    fit: Fit
    placed: Placement
    beam: Array

    @property
    def n_prior(self) -> int:
        return int((self.free.information > 0).sum())

    def hypothesis(self, chi2: float) -> Hypothesis:
        """The declared reading with another chi2: where movements are followed."""
        return replace(self.own, chi2=chi2)

    def dof(self, problem: Problem) -> int:
        result: int = 2 * len(problem) + self.n_prior - self.fit.N.shape[0]
        return result

    def sigmas(self) -> float:
        """What the declared reading leaves, beside what moved where that is much."""
        found = residual_sigmas(self.problem, self.free, self.fit)
        moved = _moved(self.problem, self.free, self.fit) if found > FITS_SIGMAS else []
        if not moved:
            return found
        chi2 = chi2_with_movements(self.problem, self.free, self.fit, moved)
        return min(found, float(np.sqrt(chi2 / self.dof(self.problem))))

    @functools.cached_property
    def own(self) -> Hypothesis:
        left = _Left.of(self.problem, self.free, self.fit)
        return Hypothesis(
            name="declared",
            words="the data as declared",
            remedy="",
            d_rms=left.d_rms,
            chi2=self.fit.chi2,
            dof=self.dof(self.problem),
            sigmas=self.sigmas(),
            delta=0.0,
            factor=1.0,
            outcome="declared",
            ball_mm=self.placed.median,
            d_SR=self.placed.d_SR,
            possible=self.placed.possible,
            share=left.share,
            size_ratio=_size_ratio(self.problem, self.free, self.fit),
        )


def ranked(
    problem: Problem,
    free: FreeParameters,
    fit: Fit,
    alternatives: Iterable[Alternative] = ALTERNATIVES,
    *,
    starts: int = 24,
) -> Diagnosis:
    """The declared reading, fitted by `fit`, against alternatives.

    starts: how many rotations are tried for an alternative whose closed form leads nowhere.  Such a one is not the
    truth (of that the closed form finds the optimum); with 0 it is left out.
    """
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    rays = ray_equations(problem)
    beam = beams(problem)
    declared = _Declared(problem=problem, free=free, fit=fit, placed=placement(problem, fit, beam), beam=beam)
    found = [declared.own]
    hopeless = HOPELESS * max(fit.chi2, float(declared.own.dof))
    for alternative in alternatives:
        changed = alternative.change(problem)
        if changed is None or declared.dof(changed) <= 0:
            continue
        same_rays = changed.x_D is problem.x_D and changed.alpha is problem.alpha
        changed_rays = rays if same_rays else ray_equations(changed)
        other = _fit_alternative(changed, changed_rays, free, held, starts, hopeless)
        if not np.isfinite(other.chi2):
            continue
        judged = _judged_beside_movements(declared, alternative, changed, other)
        if judged is not None:
            found.append(judged)
    return Diagnosis(hypotheses=rank(found))


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
    return {"better": 0, "declared": 1}.get(h.outcome, 2), h.delta


def _judged_beside_movements(
    declared: _Declared, alternative: Alternative, changed: Problem, other: Fit
) -> Hypothesis | None:
    """The judgement; where the alternative fits better and something still moved under it, with both free to move."""
    free = declared.free
    judged = _judged(declared, alternative, changed, other, declared.fit.chi2)
    if judged is None or judged.delta > -BETTER:
        return judged
    moved = _moved(changed, free, other)
    if not moved:
        return judged
    following = replace(other, chi2=chi2_with_movements(changed, free, other, moved))
    chi2 = chi2_with_movements(declared.problem, free, declared.fit, moved)
    still = _judged(declared, alternative, changed, following, chi2)
    if still is not None and still.outcome == "better":
        return replace(judged, outcome="better", sigmas=still.sigmas)
    return judged if still is None or judged.outcome != "better" else replace(still, chi2=other.chi2)


def _moved(problem: Problem, free: FreeParameters, fit: Fit) -> list[Effect]:
    return [e for e in movements(problem, free, fit) if e.p < SIGNIFICANT]


def _judged(
    declared: _Declared, alternative: Alternative, changed: Problem, other: Fit, chi2: float
) -> Hypothesis | None:
    """The comparison of one alternative; None where it puts a ball where none can be, or only renames the unit."""
    free = declared.free
    same = changed.alpha is declared.problem.alpha and len(changed) == len(declared.problem)
    placed = placement(changed, other, declared.beam if same else None)
    left = _Left.of(changed, free, other)
    dof = declared.dof(changed)
    judged = compared(
        declared.hypothesis(chi2),
        Hypothesis(
            name=alternative.name,
            words=alternative.words,
            remedy=alternative.remedy,
            d_rms=left.d_rms,
            chi2=other.chi2,
            dof=dof,
            # a chi2 that follows a movement says what the reading leaves beside it
            sigmas=min(left.sigmas, float(np.sqrt(other.chi2 / dof))),
            delta=0.0,
            factor=1.0,
            outcome="worse",
            symmetry=alternative.symmetry,
            length_factor=alternative.length_factor,
            ball_mm=placed.median,
            d_SR=placed.d_SR,
            possible=placed.possible,
            share=left.share,
            size_ratio=_size_ratio(changed, free, other),
        ),
    )
    likelier = better_placed(placed, declared.placed) and not changed.units_confirmed
    better = judged.outcome == "better" or (judged.outcome == "unfit" and judged.delta < -BETTER)
    if alternative.length_factor != 1.0 and not likelier and not (better and placed.possible):
        # centres alone cannot show the unit while the table keeps one angle; the ball's place on the beam can
        return None
    return judged


def set_pose_alternative(problem: Problem, poses: PoseSequence | Iterable[PoseSequence]) -> Alternative | None:
    """The alternative "the other of set and encoder poses", where the table holds both."""
    runs = [poses] if isinstance(poses, PoseSequence) else list(poses)
    commanded: list[RigidTransform] = [p.T_MH_set for p in runs if p.T_MH_set is not None]
    if len(commanded) < len(runs):
        return None

    def change(p: Problem) -> Problem:
        R: Array = np.array([commanded[r].R[i] for r, i in zip(p.run, p.index, strict=True)])
        t: Array = np.array([commanded[r].t[i] for r, i in zip(p.run, p.index, strict=True)])
        return replace(p, R_MH=R, t_MH=t)

    return Alternative(
        name="set poses",
        words="the images were taken at the set poses, not at the encoder's",
        remedy="poses.csv: # source: set",
        change=change,
        quick=True,
    )


@require_types
def diagnose(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    moving_scanner: bool = False,
) -> Diagnosis:
    """Rank some 65 alternative conventions against the declared one.  It never changes an input.

    scanner, poses, observations, free, fix, priors: as in `calibrate`, several runs included.
    moving_scanner: source and detector move and the ball does not move, as in `calibrate_inverse`.

    Raises InputError where observations and poses do not pair.
    """
    runs = [poses] if isinstance(poses, PoseSequence) else list(poses)
    if moving_scanner:
        runs = [inverse_poses(p) for p in runs]
    problem = pair(scanner, runs, observations if not isinstance(observations, BallObservations) else [observations])
    freed = free_parameters(problem.scanners, free=free, fix=fix, priors=priors)
    fit = best_fit(problem, freed)
    other = set_pose_alternative(problem, runs)
    known = ALTERNATIVES_OF_MOVING_SCANNER if moving_scanner else ALTERNATIVES
    return ranked(problem, freed, fit, [*known, *([other] if other else [])])
