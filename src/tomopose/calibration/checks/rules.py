"""The rules by which a calibration is judged: one table for every model and every arrangement.

`findings(evidence)` goes through the table; `verdict.judge` takes the worst of what it finds.  The table in
docs/concepts/verdict.md is made from here (`rules_table`) and held equal by a test.
"""

from __future__ import annotations

import numpy as np

from tomopose.calibration.checks.conventions.hypothesis import BETTER, MUCH_BETTER
from tomopose.calibration.checks.evidence import culprits, measures
from tomopose.calibration.checks.evidence.evidence import MISFIT_CHI2, Evidence
from tomopose.calibration.checks.evidence.measures import (
    BALL_SIZE,
    EFFECT_PX,
    MISFIT_PX,
    NOTHING_FITS_PX,
    REPEAT_PX,
)
from tomopose.calibration.checks.rule import ARRANGEMENTS, MODELS, Rule
from tomopose.calibration.checks.score_tests.ranking import DECISIVE
from tomopose.calibration.checks.stability import SIGNIFICANT
from tomopose.calibration.checks.verdict import Finding
from tomopose.calibration.model.covariance import WIDENING_PROBABILITY
from tomopose.calibration.rigid.contradiction import CONTRADICTED
from tomopose.calibration.rigid.outliers import LARGEST_SHARE

NONE = float("nan")

RULES: tuple[Rule, ...] = (
    Rule(
        name="no optimum",
        condition="no optimum was reached",
        limit=NONE,
        verdict="rejected",
        reason="there is no result to judge",
        measure=measures.no_optimum,
    ),
    Rule(
        name="not finite",
        condition="chi2, a residual or a variance is not a finite number",
        limit=NONE,
        verdict="rejected",
        reason="NaN passes no guard",
        measure=measures.not_finite,
    ),
    Rule(
        name="alternative convention, much better",
        condition=f"an alternative convention fits better by {np.sqrt(BETTER):.0f} sigma and lowers chi2 (floored at "
        "dof) by more than the factor {limit:g}",
        limit=MUCH_BETTER,
        verdict="rejected",
        reason="a reading that halves chi2 is not explained by sigmas stated wrongly",
        measure=lambda e, limit: measures.alternatives(e, True),
        arrangements=("moving-object", "moving-scanner", "turntable"),
    ),
    Rule(
        name="nothing fits",
        condition=f"d_rms above {{limit:g}} of the rms spread of the centres and above {NOTHING_FITS_PX:g} px",
        limit=0.05,
        verdict="rejected",
        reason="5 % of the spread remain: robots with their nominal geometry leave 0.004 to 0.009 "
        "(benchmarks/manipulator), wrong readings of robots' tables 0.2 to 0.7",
        measure=measures.nothing_fits,
    ),
    Rule(
        name="place of the ball",
        condition="a ball is not between focal spot and panel in every pose",
        limit=NONE,
        verdict="rejected",
        reason="no radiograph shows a ball that is anywhere else",
        measure=measures.no_place,
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
        measure=measures.other_unit,
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="alternative convention, better",
        condition=f"an alternative convention fits better by {np.sqrt(BETTER):.0f} sigma (delta chi2 below {{limit:g}}"
        ")",
        limit=-BETTER,
        verdict="doubtful",
        reason="5 sigma: some 65 alternatives are tried",
        measure=lambda e, limit: measures.alternatives(e, False),
        arrangements=("moving-object", "moving-scanner", "turntable"),
    ),
    Rule(
        name="convention not distinguished",
        condition="the poses cannot distinguish another reading of the orientation columns, which would put a tilted "
        "scan off by more than {limit:g} px, and the user has not confirmed the convention",
        limit=0.25,
        verdict="doubtful",
        reason="a quarter of a pixel blurs edges as much as interpolation between voxels does",
        measure=measures.undistinguished,
        arrangements=("moving-object",),
    ),
    Rule(
        name="many centres do not fit",
        condition="more than {limit:.0%} of the centres do not fit, and none was set aside",
        limit=LARGEST_SHARE,
        verdict="doubtful",
        reason="more than these are no outliers: the model does not fit",
        measure=measures.misfit,
    ),
    Rule(
        name="outliers",
        condition="more than {limit:.0%} of the centres were set aside",
        limit=0.1,
        verdict="doubtful",
        reason="a clean run loses a single centre once in a hundred runs; one in ten is another cause",
        measure=measures.outlier_share,
    ),
    Rule(
        name="block of outliers",
        condition="neighbouring poses were set aside together, with less than {limit:g} of probability by chance",
        limit=1e-3,
        verdict="doubtful",
        reason="what is set aside by chance is spread over the run; one false alarm in 1000 runs with outliers",
        measure=measures.outlier_block,
    ),
    Rule(
        name="set aside",
        condition="centres were set aside",
        limit=0.0,
        verdict="trustworthy",
        reason="worth a look, and no ground for doubt",
        measure=measures.set_aside,
    ),
    Rule(
        name="degrees of freedom",
        condition="fewer than {limit:g} degrees of freedom",
        limit=10.0,
        verdict="doubtful",
        reason="sigma of chi2/dof is above 0.45 there",
        measure=measures.few_dof,
    ),
    Rule(
        name="unexplained residuals",
        condition=f"chi2/dof above {{limit:g}} and more than {MISFIT_PX:g} px of residual that the stated sigmas "
        "do not explain",
        limit=MISFIT_CHI2,
        verdict="doubtful",
        reason="residuals twice as large as stated; below 0.001 px, half the noise of the best detections, only "
        "rounding is left",
        measure=measures.unexplained,
    ),
    Rule(
        name="residuals above the stated uncertainty",
        condition="chi2 exceeded with less than {limit:g} of probability, and the covariance does not grow with it",
        limit=WIDENING_PROBABILITY,
        verdict="doubtful",
        reason="one run in a hundred; elsewhere the covariance is widened from this value on",
        measure=measures.not_widened,
    ),
    Rule(
        name="residuals below the stated uncertainty",
        condition="chi2/dof below {limit:g}",
        limit=0.1,
        verdict="trustworthy",
        reason="sigmas stated more than three times too large; the uncertainty that follows is on the safe side",
        measure=measures.too_small,
    ),
    Rule(
        name="contradicted prior",
        condition="a freed parameter is more than {limit:g} stated standard uncertainties from its stated value",
        limit=5.0,
        verdict="doubtful",
        reason="5 sigma: the stated value, its uncertainty or the model is wrong",
        measure=measures.prior_pulls,
    ),
    Rule(
        name="drift",
        condition=f"a drift of the ball or the images, with less than {{limit:g}} of probability by chance and above "
        f"{EFFECT_PX:g} px (a quarter of chi2 where the residuals are not white)",
        limit=SIGNIFICANT,
        verdict="doubtful",
        reason="one false alarm in 10 000 runs; 0.02 px is the detection noise of the paper",
        measure=lambda e, limit: measures.effects(e, limit, False),
    ),
    Rule(
        name="step",
        condition=f"ball, pivot or mount changed at a pose, with less than {{limit:g}} of probability by chance and "
        f"above {EFFECT_PX:g} px (a quarter of chi2 where the residuals are not white)",
        limit=SIGNIFICANT,
        verdict="doubtful",
        reason="as for drift, over all poses at which it may have happened",
        measure=lambda e, limit: measures.effects(e, limit, True),
    ),
    Rule(
        name="changed during the run",
        condition="a drift, or a step of ball, mount or images, with an evidence above {limit:g} beside everything "
        "assumed, and a quarter of chi2 where a manipulator's errors were identified and its poses scatter",
        limit=DECISIVE,
        verdict="doubtful",
        reason="odds of 3000 to 1 after all looks; benchmarks/reality",
        measure=lambda e, limit: culprits.culprits(e, limit, ("time", "step")),
    ),
    Rule(
        name="scanner or manipulator not as modelled",
        condition="distortion or tiles of the panel, scales or axes of the manipulator, errors of the table or a "
        "scanner value, with an evidence above {limit:g} beside everything assumed",
        limit=DECISIVE,
        verdict="doubtful",
        reason="odds of 3000 to 1 after all looks; benchmarks/reality",
        measure=lambda e, limit: culprits.culprits(e, limit, ("panel", "manipulator", "table", "scanner")),
    ),
    Rule(
        name="value freed",
        condition="a scanner value lies more than {limit:g} of its stated or assumed sigmas away, and was freed",
        limit=CONTRADICTED,
        verdict="trustworthy",
        reason="the images determine it: the result rests on them, not on the value that was stated",
        measure=culprits.contradicted,
    ),
    Rule(
        name="two explanations",
        condition="a cause other than a scanner value explains the images as well as the scanner values do, which "
        "would have to lie beyond 3 assumed sigmas",
        limit=NONE,
        verdict="doubtful",
        reason="the two make different scans of the same images",
        measure=culprits.either_or,
    ),
    Rule(
        name="origin of the pixels",
        condition="half a pixel or a whole one in both u and v explains the images as well as u_0 and v_0 do",
        limit=NONE,
        verdict="doubtful",
        reason="one of the two puts the images of a scan off by as much",
        measure=lambda e, limit: culprits.pixel_origin(e),
        models=("rigid",),
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="repeated pose",
        condition=f"a repeated pose off by more than {{limit:g}} sigma and {REPEAT_PX:g} px",
        limit=5.0,
        verdict="doubtful",
        reason="closure: no model and no mount explains it",
        measure=lambda e, limit: measures.repeats(e, limit, False),
    ),
    Rule(
        name="repeated pose, set aside",
        condition="the same, where one of the two centres was set aside",
        limit=5.0,
        verdict="trustworthy",
        reason="a single bad image, named; a run of them is a block of outliers",
        measure=lambda e, limit: measures.repeats(e, limit, True),
    ),
    Rule(
        name="held-out poses",
        condition="held-out poses predicted {limit:g} times worse than fitted ones, and worse than their own "
        "prediction by 2 sigma",
        limit=3.0,
        verdict="doubtful",
        reason="a fit with twice as many equations as unknowns predicts at most 2 times worse than it fits",
        measure=measures.held_out,
    ),
    Rule(
        name="halves of the poses",
        condition="the calibration from the half of the poses near the focal spot and that from the other half differ "
        "by more than is stated, with less than {limit:g} of probability by chance",
        limit=1e-4,
        verdict="doubtful",
        reason="a model error shows there when no residual does; one false alarm in 10 000 runs",
        measure=measures.halves,
        models=("rigid",),
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="uncertainty of a tilted scan",
        condition="a tilt of 5 degrees would carry more than {limit:g} px of standard uncertainty at the field's edge",
        limit=0.25,
        verdict="doubtful",
        reason="a quarter of a pixel blurs edges as much as interpolation between voxels does",
        measure=measures.scan,
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="uncertainty with all that is assumed",
        condition="a tilt of 5 degrees carries more than {limit:g} px of standard uncertainty, with what was assumed "
        "and not measured",
        limit=1.0,
        verdict="doubtful",
        reason="a pixel on the panel is a voxel of the volume: beyond it, edges end in another voxel",
        measure=measures.whole_scan,
        arrangements=("moving-object", "moving-scanner"),
    ),
    Rule(
        name="scatter of the poses",
        condition="the poses scatter with {limit:g} times the variance of the stated repeatability",
        limit=9.0,
        verdict="doubtful",
        reason="three times the maker's figure: an error that no model here holds",
        measure=measures.scatter,
    ),
    Rule(
        name="no better than trusted poses",
        condition="held-out poses are not predicted better than by trusting the poses",
        limit=NONE,
        verdict="doubtful",
        reason="evidence and held-out poses must both speak for a richer model",
        measure=measures.no_better_than_rigid,
        models=("kinematic", "slack"),
    ),
    Rule(
        name="size of the errors",
        condition="the identified errors are more than {limit:g} times as large as the machine's file states",
        limit=5.0,
        verdict="doubtful",
        reason="the geometry or its units are wrong rather than the parts",
        measure=measures.size,
        models=("kinematic", "slack"),
    ),
    Rule(
        name="drift or lag of the manipulator",
        condition="drift and lag of the run are among the parameters",
        limit=NONE,
        verdict="doubtful",
        reason="a scan may show another drift than the calibration did",
        measure=measures.run_effects,
        models=("kinematic",),
    ),
    Rule(
        name="undetermined turns",
        condition="the balls do not determine the errors of the plate's turns",
        limit=NONE,
        verdict="doubtful",
        reason="away from the ball a scan is as uncertain as the prior of these turns",
        measure=measures.open_turns,
        models=("slack",),
    ),
    Rule(
        name="size of the ball",
        condition="the ball's silhouettes differ by more than {limit:.1%} from the size that the calibration predicts",
        limit=BALL_SIZE,
        verdict="doubtful",
        reason="a pixel of edge position at a radius of 100 px, far above what the detection leaves",
        measure=measures.ball_size,
    ),
    Rule(
        name="size of the ball, noted",
        condition=f"the same, by more than {{limit:.1%}}, up to {BALL_SIZE:.0%}",
        limit=0.005,
        verdict="trustworthy",
        reason="half a pixel of edge position at a radius of 100 px, as blur may cause",
        measure=lambda e, limit: measures.ball_size(e, limit, BALL_SIZE),
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
