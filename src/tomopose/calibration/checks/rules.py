"""The rules by which a calibration is judged: one table for every model and every arrangement.

`findings(evidence)` goes through the table; `verdict.judge` takes the worst of what it finds.  The table in
docs/concepts/verdict.md is made from here (`rules_table`) and held equal by a test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from tomopose.calibration.checks.convention_tests import BETTER, MUCH_BETTER, Diagnosis, other_unit_words
from tomopose.calibration.checks.stability import SIGNIFICANT, Effect, Stability
from tomopose.calibration.checks.verdict import Finding, Verdict
from tomopose.calibration.model.covariance import WIDENING_PROBABILITY
from tomopose.calibration.rigid.outliers import LARGEST_SHARE

MODELS = ("rigid", "kinematic", "slack")
ARRANGEMENTS = ("moving-object", "moving-scanner", "twin")


@dataclass(frozen=True, kw_only=True)
class ScatterFound:
    """ratio: variance of the poses' scatter over that of the stated repeatability, t_mm and w_rad."""

    ratio: float
    t_mm: float
    w_rad: float


@dataclass(frozen=True, kw_only=True)
class AgainstRigid:
    """Held-out poses, px rms, under the model that was chosen and under that which trusts the poses; better: whether
    evidence and held-out poses both speak for the chosen one."""

    chosen_px: float
    rigid_px: float
    better: bool


@dataclass(frozen=True, kw_only=True)
class BallSize:
    """ratio: measured size of the ball's silhouettes over the calculated one;  diameter: mm, as it was given;
    unit: (name, symbol, millimetres) of the unit of the positions under which they agree, where that is another one."""

    ratio: float
    diameter: float
    unit: tuple[str, str, float] | None = None

    @property
    def words(self) -> str:
        return (
            f"the ball's silhouettes are {100 * abs(self.ratio - 1.0):.1f} % "
            f"{'larger' if self.ratio > 1 else 'smaller'} than a ball of {self.diameter:g} mm would throw from where "
            "the calibration places it; the diameter (--ball-diameter-mm), the scale of the poses' translations or a "
            "value in scanner.json is wrong"
        )


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the rules look at.  None: does not apply to this model or arrangement, or was not looked at.

    finite:       chi2, the residuals and the covariance are finite numbers.
    misfit:       more rows fail than may be outliers, and none was set aside.
    outliers:     pose ids set aside.
    chi2_dof:     by the sigmas that were stated; chi2, dof: as the covariance rests on.
    widened:      whether the covariance grows with chi2/dof.
    residual_px, expected_px: d_rms, and what the stated sigmas explain of it;  spread_px: rms spread of the centres.
    scan_px:      predicted standard uncertainty of a scan tilted by 5 degrees, px.
    diagnosis:    alternative conventions, fitted by the model that trusts the poses.
    size:         identified errors over what the machine's file states.
    run_effects:  drift and lag of the run are among the parameters.
    open_turns:   the sentence on turns of the plate that no data determine; "" where they are determined.
    """

    model: str
    arrangement: str
    converged: bool
    finite: bool
    dof: int
    n_used: int
    outliers: tuple[str, ...]
    misfit: bool
    chi2: float
    chi2_dof: float
    widened: bool
    residual_px: float
    expected_px: float
    spread_px: float
    scan_px: float | None = None
    diagnosis: Diagnosis | None = None
    stability: Stability | None = None
    scatter: ScatterFound | None = None
    against_rigid: AgainstRigid | None = None
    size: float | None = None
    run_effects: bool = False
    open_turns: str = ""
    ball_size: BallSize | None = None

    @property
    def n(self) -> int:
        return self.n_used + len(self.outliers)

    @property
    def coloured(self) -> bool:
        """Residuals that come from the poses are not white: there, chance alone explains what looks significant."""
        return self.chi2_dof > MISFIT_CHI2 or (self.scatter is not None and self.scatter.ratio > MISFIT_CHI2)


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a rule measured, in words, with a remedy where one is known."""

    value: float
    words: str
    remedy: str = ""


@dataclass(frozen=True, kw_only=True)
class Rule:
    """name; condition: in words, with {limit}; limit; verdict of a calibration that meets the condition; reason: where
    the limit comes from; measure(evidence, limit): what meets the condition; models, arrangements: where it applies."""

    name: str
    condition: str
    limit: float
    verdict: Verdict
    reason: str
    measure: Callable[[Evidence, float], Iterator[Found]]
    models: tuple[str, ...] = MODELS
    arrangements: tuple[str, ...] = ARRANGEMENTS

    def findings(self, evidence: Evidence) -> Iterator[Finding]:
        """What this rule finds in the evidence."""
        if evidence.model in self.models and evidence.arrangement in self.arrangements:
            for found in self.measure(evidence, self.limit):
                yield Finding(
                    rule=self.name,
                    value=float(found.value),
                    limit=self.limit,
                    words=found.words,
                    remedy=found.remedy,
                    verdict=self.verdict,
                )


MISFIT_CHI2, MISFIT_PX = 4.0, 0.005
NOTHING_FITS_PX = 3.0
REPEAT_PX, EFFECT_PX = 0.05, 0.02
EFFECT_SHARE = 0.25
HELD_OUT_CHI2 = 4.0
BALL_SIZE = 0.01


def _above(value: float, limit: float) -> bool:
    """NaN counts as above: what could not be calculated passes no guard."""
    return not value <= limit


def _excess_px(e: Evidence) -> float:
    return float(np.sqrt(max(e.residual_px**2 - e.expected_px**2, 0.0)))


def _no_optimum(e: Evidence, limit: float) -> Iterator[Found]:
    if not e.converged:
        yield Found(
            value=float("nan"),
            words="no optimum was reached: a convention or the scanner's values are wrong; tomopose diagnose tries "
            "others",
            remedy="tomopose diagnose",
        )


def _not_finite(e: Evidence, limit: float) -> Iterator[Found]:
    if not (e.finite and np.isfinite(e.chi2_dof)):
        yield Found(value=float("nan"), words="the residuals or the covariance are not finite numbers")


def _nothing_fits(e: Evidence, limit: float) -> Iterator[Found]:
    share = e.residual_px / e.spread_px if e.spread_px > 0 else float(np.inf if e.residual_px > 0 else 0.0)
    if _above(e.residual_px, NOTHING_FITS_PX) and _above(share, limit):
        yield Found(
            value=share,
            words=f"nothing fits: residuals of {e.residual_px:.3g} px, {share:.0%} of the spread of the centres "
            f"({e.spread_px:.3g} px)",
            remedy="check the pairing of images and poses, the convention and the units; tomopose diagnose tries "
            "alternatives",
        )


def _alternatives(e: Evidence, much: bool) -> Iterator[Found]:
    for h in e.diagnosis.leading if e.diagnosis else ():
        # identified errors may explain what another convention explained for poses that were trusted
        if (h.factor > MUCH_BETTER) == much and (e.model == "rigid" or h.d_rms < e.residual_px):
            yield Found(
                value=h.factor if much else h.delta,
                words=f"an alternative convention fits significantly better: {h.words} (delta chi2 {h.delta:.3g}, "
                f"limit {-BETTER:g}; d_rms {h.d_rms:.3g} px instead of {e.residual_px:.3g} px); to try: {h.remedy}",
                remedy=h.remedy,
            )


def _other_unit(e: Evidence, limit: float) -> Iterator[Found]:
    h = e.diagnosis.other_unit if e.diagnosis else None
    gauged = e.ball_size is not None and abs(e.ball_size.ratio - 1.0) < limit
    if h is not None and not gauged:
        yield Found(value=h.length_factor, words=other_unit_words(h, e.diagnosis.declared), remedy=h.remedy)


def _no_place(e: Evidence, limit: float) -> Iterator[Found]:
    if e.diagnosis and not e.diagnosis.declared.possible:
        yield Found(
            value=e.diagnosis.declared.ball_mm,
            words=f"the calibration places the ball {e.diagnosis.declared.ball_mm:.4g} mm from the focal spot, and in "
            "some pose not between focal spot and panel: the unit or the sense of the translations, or d_SD, is wrong",
            remedy="check the unit of x_mm, y_mm, z_mm and d_SD_mm",
        )


def _misfit(e: Evidence, limit: float) -> Iterator[Found]:
    if e.misfit:
        yield Found(
            value=float("nan"),
            words=f"more than {limit:.0%} of the centres do not fit; none was set aside: the poses themselves, a "
            "convention or the scanner's values may be wrong",
        )


def _outlier_share(e: Evidence, limit: float) -> Iterator[Found]:
    share = len(e.outliers) / max(e.n, 1)
    if _above(share, limit):
        yield Found(value=share, words=f"{len(e.outliers)} of {e.n} centres ({share:.0%}) were set aside")


def _outlier_block(e: Evidence, limit: float) -> Iterator[Found]:
    block = e.stability.block if e.stability else None
    if block is not None and block.p < limit:
        yield Found(
            value=block.p,
            words=f"{block.count} neighbouring poses, {block.first} to {block.last}, were set aside together "
            f"(p = {block.p:.1g} by chance): a step, as if the mount or the ball changed at pose {block.first}",
            remedy=f"calibrate with the poses before {block.first} alone, or with those after it",
        )


def _set_aside(e: Evidence, limit: float) -> Iterator[Found]:
    if e.outliers:
        named = ", ".join(e.outliers[:5]) + (", ..." if len(e.outliers) > 5 else "")
        yield Found(
            value=float(len(e.outliers)),
            words=f"{len(e.outliers)} of {e.n} centres set aside: {named}",
            remedy="look at these images",
        )


def _few_dof(e: Evidence, limit: float) -> Iterator[Found]:
    if e.dof < limit:
        yield Found(
            value=e.dof,
            words=f"only {e.dof} degrees of freedom: the residuals can hardly show a mistake",
            remedy="image more poses",
        )


def _unexplained(e: Evidence, limit: float) -> Iterator[Found]:
    if _above(e.chi2_dof, limit) and _above(_excess_px(e), MISFIT_PX):
        advice = "identify the manipulator's errors (--manipulator)" if e.model == "rigid" else "free what is uncertain"
        yield Found(
            value=e.chi2_dof,
            words=f"residuals of {e.residual_px:.3g} px where the stated sigmas explain {e.expected_px:.3g} px "
            f"(chi2/dof {e.chi2_dof:.3g}): the manipulator does not reach the poses it reports, or scanner values are "
            f"wrong; {advice}",
            remedy=advice,
        )


def _not_widened(e: Evidence, limit: float) -> Iterator[Found]:
    if not e.widened and e.dof > 0 and not _above(e.chi2_dof, MISFIT_CHI2):
        p = float(chdtrc(e.dof, e.chi2))
        if p < limit:
            yield Found(
                value=p,
                words=f"chi2/dof is {e.chi2 / e.dof:.2f}: the stated uncertainties do not explain the residuals",
            )


def _too_small(e: Evidence, limit: float) -> Iterator[Found]:
    if e.dof > 0 and e.chi2_dof < limit:
        yield Found(
            value=e.chi2_dof,
            words=f"chi2/dof is {e.chi2_dof:.2g}: the centres agree far better than their stated sigmas say, so that "
            "these are too large, and with them every uncertainty stated here",
            remedy="state the sigmas of the centres as they are",
        )


def _effects(e: Evidence, limit: float, steps: bool) -> Iterator[Found]:
    least = EFFECT_SHARE if e.coloured else 0.0
    moved: list[Effect] = [
        x
        for x in (e.stability.effects if e.stability else ())
        if bool(x.at) == steps and x.p < limit and x.size_px > EFFECT_PX and x.share > least
    ]
    # drifts resemble one another, and so do steps: the likeliest of each is named
    for x in sorted(moved, key=lambda x: (x.p, -x.share))[:1]:
        yield Found(value=x.p, words=f"{x.words} (p = {x.p:.1g})")


def _repeats(e: Evidence, limit: float, set_aside: bool) -> Iterator[Found]:
    for r in e.stability.repeats if e.stability else ():
        ignored = r.first in e.outliers or r.again in e.outliers
        if ignored == set_aside and _above(r.sigmas, limit) and _above(r.distance_px, REPEAT_PX):
            yield Found(
                value=r.sigmas,
                words=f"pose {r.first} taken again as {r.again} is off by {r.distance_px:.3g} px "
                f"({r.sigmas:.1f} sigma)" + ("; it was set aside" if ignored else ""),
            )


def _held_out(e: Evidence, limit: float) -> Iterator[Found]:
    s = e.stability
    if s and s.held_out_rms > limit * s.fit_rms and s.held_out_chi2 > HELD_OUT_CHI2 * max(1.0, e.chi2_dof):
        yield Found(
            value=s.held_out_rms / s.fit_rms,
            words=f"held-out poses are predicted to {s.held_out_rms:.3g} px, fitted ones to {s.fit_rms:.3g} px: the "
            "model does not carry over",
        )


def _scan(e: Evidence, limit: float) -> Iterator[Found]:
    if e.scan_px is not None and _above(e.scan_px, limit):
        yield Found(
            value=e.scan_px,
            words=f"a scan tilted by 5 degrees would carry {e.scan_px:.2g} px of standard uncertainty; use larger "
            "rotations, more poses or table angles",
            remedy="use larger rotations, more poses or table angles",
        )


def _scatter(e: Evidence, limit: float) -> Iterator[Found]:
    s = e.scatter
    if s is not None and _above(s.ratio, limit):
        factor = float(np.sqrt(s.ratio))
        yield Found(
            value=s.ratio,
            words=f"poses scatter {factor:.1f} times as much as the manipulator's repeatability says "
            f"({1e3 * s.t_mm * factor:.2g} um, {1e6 * s.w_rad * factor:.2g} urad): an error that this model does not "
            "hold (backlash, drift)",
        )


def _no_better_than_rigid(e: Evidence, limit: float) -> Iterator[Found]:
    a = e.against_rigid
    if a is not None and not a.better:
        yield Found(
            value=a.chosen_px,
            words=f"held-out poses are not predicted better than by trusting the poses ({a.chosen_px:.4f} px, rigid "
            f"{a.rigid_px:.4f} px); use model auto",
            remedy="--model auto",
        )


def _size(e: Evidence, limit: float) -> Iterator[Found]:
    if e.size is not None and _above(e.size, limit):
        yield Found(
            value=e.size,
            words=f"the identified errors are {e.size:.1f} times as large as the machine's file says; check its "
            "geometry and units",
        )


def _run_effects(e: Evidence, limit: float) -> Iterator[Found]:
    if e.run_effects:
        yield Found(
            value=float("nan"),
            words="during the run the manipulator drifted or its drives lagged (drift and lag are among the "
            "parameters): matrices apply the lag in the order of the scan's table, and count the drift, which a scan "
            "may show again, as scatter",
        )


def _open_turns(e: Evidence, limit: float) -> Iterator[Found]:
    if e.open_turns:
        yield Found(value=float("nan"), words=e.open_turns, remedy="give the manipulator's geometry, or more balls")


def _ball_size(e: Evidence, limit: float, most: float = np.inf) -> Iterator[Found]:
    b = e.ball_size
    if b is not None and np.isfinite(b.ratio) and limit < abs(b.ratio - 1.0) <= most:
        yield Found(
            value=b.ratio - 1.0,
            words=b.words,
            remedy="measure the ball's diameter; check d_SD, d_SR and the pixel pitch in scanner.json",
        )


NONE = float("nan")

RULES: tuple[Rule, ...] = (
    Rule(
        name="no optimum",
        condition="no optimum was reached",
        limit=NONE,
        verdict="rejected",
        reason="there is no result to judge",
        measure=_no_optimum,
    ),
    Rule(
        name="not finite",
        condition="chi2, a residual or a variance is not a finite number",
        limit=NONE,
        verdict="rejected",
        reason="NaN passes no guard",
        measure=_not_finite,
    ),
    Rule(
        name="alternative convention, much better",
        condition=f"an alternative convention fits better by {np.sqrt(BETTER):.0f} sigma and lowers chi2 (floored at "
        "dof) by more than the factor {limit:g}",
        limit=MUCH_BETTER,
        verdict="rejected",
        reason="a reading that halves chi2 is not explained by sigmas stated wrongly",
        measure=lambda e, limit: _alternatives(e, True),
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="nothing fits",
        condition=f"d_rms above {{limit:g}} of the rms spread of the centres and above {NOTHING_FITS_PX:g} px",
        limit=0.1,
        verdict="rejected",
        reason="less than 99 % of the centres' variance is explained; robots with their nominal geometry leave 0.004 "
        "to 0.009 (benchmarks/manipulator)",
        measure=_nothing_fits,
    ),
    Rule(
        name="place of the ball",
        condition="a ball is not between focal spot and panel in every pose",
        limit=NONE,
        verdict="rejected",
        reason="no radiograph shows a ball that is anywhere else",
        measure=_no_place,
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="unit of the positions",
        condition="another unit of the positions fits as well and places the ball nearer to the rotation axis, and no "
        "silhouette agrees with millimetres within {limit:.0%}",
        limit=0.02,
        verdict="doubtful",
        reason="with the table at one angle every scale fits; a ball is within a factor of 2.5 of d_SR from the focal "
        "spot",
        measure=_other_unit,
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="alternative convention, better",
        condition=f"an alternative convention fits better by {np.sqrt(BETTER):.0f} sigma (delta chi2 below {{limit:g}}"
        ")",
        limit=-BETTER,
        verdict="doubtful",
        reason="5 sigma: some 65 alternatives are tried",
        measure=lambda e, limit: _alternatives(e, False),
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="many centres do not fit",
        condition="more than {limit:.0%} of the centres do not fit, and none was set aside",
        limit=LARGEST_SHARE,
        verdict="doubtful",
        reason="more than these are no outliers: the model does not fit",
        measure=_misfit,
    ),
    Rule(
        name="outliers",
        condition="more than {limit:.0%} of the centres were set aside",
        limit=0.1,
        verdict="doubtful",
        reason="a clean run loses a single centre once in a hundred runs; one in ten is another cause",
        measure=_outlier_share,
    ),
    Rule(
        name="block of outliers",
        condition="neighbouring poses were set aside together, with less than {limit:g} of probability by chance",
        limit=1e-3,
        verdict="doubtful",
        reason="what is set aside by chance is spread over the run; one false alarm in 1000 runs with outliers",
        measure=_outlier_block,
    ),
    Rule(
        name="set aside",
        condition="centres were set aside",
        limit=0.0,
        verdict="trustworthy",
        reason="worth a look, and no ground for doubt",
        measure=_set_aside,
    ),
    Rule(
        name="degrees of freedom",
        condition="fewer than {limit:g} degrees of freedom",
        limit=10.0,
        verdict="doubtful",
        reason="sigma of chi2/dof is above 0.45 there",
        measure=_few_dof,
    ),
    Rule(
        name="unexplained residuals",
        condition=f"chi2/dof above {{limit:g}} and more than {MISFIT_PX:g} px of residual that the stated sigmas "
        "do not explain",
        limit=MISFIT_CHI2,
        verdict="doubtful",
        reason="residuals twice as large as stated; 0.005 px is half the noise of the best detections, below which "
        "only rounding is left",
        measure=_unexplained,
    ),
    Rule(
        name="residuals above the stated uncertainty",
        condition="chi2 exceeded with less than {limit:g} of probability, and the covariance does not grow with it",
        limit=WIDENING_PROBABILITY,
        verdict="doubtful",
        reason="one run in a hundred; elsewhere the covariance is widened from this value on",
        measure=_not_widened,
    ),
    Rule(
        name="residuals below the stated uncertainty",
        condition="chi2/dof below {limit:g}",
        limit=0.1,
        verdict="trustworthy",
        reason="sigmas stated more than three times too large; the uncertainty that follows is on the safe side",
        measure=_too_small,
    ),
    Rule(
        name="drift",
        condition=f"a drift of the ball or the images, with less than {{limit:g}} of probability by chance and above "
        f"{EFFECT_PX:g} px (a quarter of chi2 where the residuals are not white)",
        limit=SIGNIFICANT,
        verdict="doubtful",
        reason="one false alarm in 10 000 runs; 0.02 px is the detection noise of the paper",
        measure=lambda e, limit: _effects(e, limit, False),
    ),
    Rule(
        name="step",
        condition=f"ball, pivot or mount changed at a pose, with less than {{limit:g}} of probability by chance and "
        f"above {EFFECT_PX:g} px (a quarter of chi2 where the residuals are not white)",
        limit=SIGNIFICANT,
        verdict="doubtful",
        reason="as for drift, over all poses at which it may have happened",
        measure=lambda e, limit: _effects(e, limit, True),
    ),
    Rule(
        name="repeated pose",
        condition=f"a repeated pose off by more than {{limit:g}} sigma and {REPEAT_PX:g} px",
        limit=5.0,
        verdict="doubtful",
        reason="closure: no model and no mount explains it",
        measure=lambda e, limit: _repeats(e, limit, False),
    ),
    Rule(
        name="repeated pose, set aside",
        condition="the same, where one of the two centres was set aside",
        limit=5.0,
        verdict="trustworthy",
        reason="a single bad image, named; a run of them is a block of outliers",
        measure=lambda e, limit: _repeats(e, limit, True),
    ),
    Rule(
        name="held-out poses",
        condition="held-out poses predicted {limit:g} times worse than fitted ones, and worse than their own "
        "prediction by 2 sigma",
        limit=3.0,
        verdict="doubtful",
        reason="a fit with twice as many equations as unknowns predicts at most 2 times worse than it fits",
        measure=_held_out,
    ),
    Rule(
        name="uncertainty of a tilted scan",
        condition="a tilt of 5 degrees would carry more than {limit:g} px of standard uncertainty at the field's edge",
        limit=0.25,
        verdict="doubtful",
        reason="a quarter of a pixel blurs edges as much as interpolation between voxels does",
        measure=_scan,
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="scatter of the poses",
        condition="the poses scatter with {limit:g} times the variance of the stated repeatability",
        limit=9.0,
        verdict="doubtful",
        reason="three times the maker's figure: an error that no model here holds",
        measure=_scatter,
        models=("kinematic", "slack"),
    ),
    Rule(
        name="no better than trusted poses",
        condition="held-out poses are not predicted better than by trusting the poses",
        limit=NONE,
        verdict="doubtful",
        reason="evidence and held-out poses must both speak for a richer model",
        measure=_no_better_than_rigid,
        models=("kinematic", "slack"),
    ),
    Rule(
        name="size of the errors",
        condition="the identified errors are more than {limit:g} times as large as the machine's file states",
        limit=5.0,
        verdict="doubtful",
        reason="the geometry or its units are wrong rather than the parts",
        measure=_size,
        models=("kinematic", "slack"),
    ),
    Rule(
        name="drift or lag of the manipulator",
        condition="drift and lag of the run are among the parameters",
        limit=NONE,
        verdict="doubtful",
        reason="a scan may show another drift than the calibration did",
        measure=_run_effects,
        models=("kinematic",),
    ),
    Rule(
        name="undetermined turns",
        condition="the balls do not determine the errors of the plate's turns",
        limit=NONE,
        verdict="doubtful",
        reason="away from the ball a scan is as uncertain as the prior of these turns",
        measure=_open_turns,
        models=("slack",),
    ),
    Rule(
        name="size of the ball",
        condition="the ball's silhouettes differ by more than {limit:.1%} from the size that the calibration predicts",
        limit=BALL_SIZE,
        verdict="doubtful",
        reason="a pixel of edge position at a radius of 100 px, far above what the detection leaves",
        measure=_ball_size,
    ),
    Rule(
        name="size of the ball, noted",
        condition=f"the same, by more than {{limit:.1%}}, up to {BALL_SIZE:.0%}",
        limit=0.005,
        verdict="trustworthy",
        reason="half a pixel of edge position at a radius of 100 px, as blur may cause",
        measure=lambda e, limit: _ball_size(e, limit, BALL_SIZE),
    ),
)


def findings(evidence: Evidence, rules: tuple[Rule, ...] = RULES) -> tuple[Finding, ...]:
    """Everything that the rules find, in the order of the table."""
    return tuple(finding for rule in rules for finding in rule.findings(evidence))


def rules_table(rules: tuple[Rule, ...] = RULES) -> str:
    """The table of the documentation, in Markdown."""
    rows = ["| rule | condition | verdict | models | where the limit comes from |", "|---|---|---|---|---|"]
    for rule in rules:
        where = "all" if rule.models == MODELS else ", ".join(rule.models)
        where += "" if rule.arrangements == ARRANGEMENTS else f"; {', '.join(rule.arrangements)}"
        condition = rule.condition.format(limit=rule.limit)
        rows.append(f"| {rule.name} | {condition} | {rule.verdict} | {where} | {rule.reason} |")
    return "\n".join(rows) + "\n"
