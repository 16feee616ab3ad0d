"""One function a rule: what of the evidence meets its condition, measured and in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from tomopose.calibration.checks.conventions.hypothesis import BETTER, MUCH_BETTER, other_unit_words
from tomopose.calibration.checks.evidence.evidence import MISFIT_CHI2, Evidence
from tomopose.calibration.checks.stability import Effect

MISFIT_PX = 0.001
NOTHING_FITS_PX = 3.0
REPEAT_PX, EFFECT_PX = 0.05, 0.02
EFFECT_SHARE = 0.25
HELD_OUT_CHI2 = 4.0
BALL_SIZE = 0.01


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a rule measured, in words, with a remedy where one is known."""

    value: float
    words: str
    remedy: str = ""


def part_of_run(pose: str) -> str:
    """What to do where something changed at a pose."""
    return (
        f"calibrate with the poses before {pose} alone (--until-pose {pose}), or with those from it on "
        f"(--from-pose {pose})"
    )


def _above(value: float, limit: float) -> bool:
    """NaN counts as above: what could not be calculated passes no guard."""
    return not value <= limit


def _excess_px(e: Evidence) -> float:
    return float(np.sqrt(max(e.residual_px**2 - e.expected_px**2, 0.0)))


def no_optimum(e: Evidence, limit: float) -> Iterator[Found]:
    if not e.converged:
        yield Found(
            value=float("nan"),
            words="no optimum was reached: a convention or the scanner's values are wrong; tomopose diagnose tries "
            "others",
            remedy="tomopose diagnose",
        )


def not_finite(e: Evidence, limit: float) -> Iterator[Found]:
    if not (e.finite and np.isfinite(e.chi2_dof)):
        yield Found(value=float("nan"), words="the residuals or the covariance are not finite numbers")


def nothing_fits(e: Evidence, limit: float) -> Iterator[Found]:
    share = e.residual_px / e.spread_px if e.spread_px > 0 else float(np.inf if e.residual_px > 0 else 0.0)
    if _above(e.residual_px, NOTHING_FITS_PX) and _above(share, limit):
        yield Found(
            value=share,
            words=f"nothing fits: residuals of {e.residual_px:.3g} px, {share:.0%} of the spread of the centres "
            f"({e.spread_px:.3g} px)",
            remedy="check the pairing of images and poses, the convention and the units; tomopose diagnose tries "
            "alternatives",
        )


def alternatives(e: Evidence, much: bool) -> Iterator[Found]:
    for h in e.diagnosis.leading if e.diagnosis else ():
        # identified errors may explain what another convention explained for poses that were trusted
        if (h.factor > MUCH_BETTER) == much and (e.model == "rigid" or h.d_rms < e.residual_px):
            yield Found(
                value=h.factor if much else h.delta,
                words=f"an alternative convention fits significantly better: {h.words} (delta chi2 {h.delta:.3g}, "
                f"limit {-BETTER:g}; d_rms {h.d_rms:.3g} px instead of {e.residual_px:.3g} px); to try: {h.remedy}",
                remedy=h.remedy,
            )


def undistinguished(e: Evidence, limit: float) -> Iterator[Found]:
    """Readings that would ruin a scan: by more than the limit, px."""
    ruinous = [u for u in e.undistinguished if _above(u.px, limit)]
    if ruinous:
        worst = ruinous[0]
        more = f" (and {len(ruinous) - 1} more)" if len(ruinous) > 1 else ""
        yield Found(
            value=worst.px,
            words=f"these poses cannot distinguish the convention of the orientation columns: if {worst.words}{more}, "
            f"a scan that turns about two axes is off by {worst.px:.2g} px",
            remedy="add poses that turn about several axes at once, or confirm the convention (--confirm-convention, "
            "or '# convention: NAME, confirmed' in poses.csv)",
        )


def other_unit(e: Evidence, limit: float) -> Iterator[Found]:
    diagnosis = e.diagnosis
    h = diagnosis.other_unit if diagnosis else None
    gauged = e.ball_size is not None and abs(e.ball_size.ratio - 1.0) < limit
    if diagnosis and h is not None and not gauged:
        yield Found(value=h.length_factor, words=other_unit_words(h, diagnosis.declared), remedy=h.remedy)


def no_place(e: Evidence, limit: float) -> Iterator[Found]:
    if e.diagnosis and not e.diagnosis.declared.possible:
        yield Found(
            value=e.diagnosis.declared.ball_mm,
            words=f"the calibration places the ball {e.diagnosis.declared.ball_mm:.4g} mm from the focal spot, and in "
            "some pose not between focal spot and panel: the unit or the sense of the translations, or d_SD, is wrong",
            remedy="check the unit of x_mm, y_mm, z_mm and d_SD_mm",
        )


def misfit(e: Evidence, limit: float) -> Iterator[Found]:
    if e.misfit:
        yield Found(
            value=float("nan"),
            words=f"more than {limit:.0%} of the centres do not fit; none was set aside: the poses themselves, a "
            "convention or the scanner's values may be wrong",
        )


def outlier_share(e: Evidence, limit: float) -> Iterator[Found]:
    share = len(e.outliers) / max(e.n, 1)
    if _above(share, limit):
        yield Found(value=share, words=f"{len(e.outliers)} of {e.n} centres ({share:.0%}) were set aside")


def outlier_block(e: Evidence, limit: float) -> Iterator[Found]:
    block = e.stability.block if e.stability else None
    if block is not None and block.p < limit:
        yield Found(
            value=block.p,
            words=f"{block.count} neighbouring poses, {block.first} to {block.last}, were set aside together "
            f"(p = {block.p:.1g} by chance): a step, as if the mount or the ball changed at pose {block.first}",
            remedy=part_of_run(block.first),
        )


def set_aside(e: Evidence, limit: float) -> Iterator[Found]:
    if e.outliers:
        named = ", ".join(e.outliers[:5]) + (", ..." if len(e.outliers) > 5 else "")
        yield Found(
            value=float(len(e.outliers)),
            words=f"{len(e.outliers)} of {e.n} centres set aside: {named}",
            remedy="look at these images",
        )


def few_dof(e: Evidence, limit: float) -> Iterator[Found]:
    if e.dof < limit:
        yield Found(
            value=e.dof,
            words=f"only {e.dof} degrees of freedom: the residuals can hardly show a mistake",
            remedy="image more poses",
        )


def unexplained(e: Evidence, limit: float) -> Iterator[Found]:
    if _above(e.chi2_dof, limit) and _above(_excess_px(e), MISFIT_PX):
        advice = "identify the manipulator's errors (--manipulator)" if e.model == "rigid" else "free what is uncertain"
        yield Found(
            value=e.chi2_dof,
            words=f"residuals of {e.residual_px:.3g} px where the stated sigmas explain {e.expected_px:.3g} px "
            f"(chi2/dof {e.chi2_dof:.3g}): the manipulator does not reach the poses it reports, or scanner values are "
            f"wrong; {advice}",
            remedy=advice,
        )


def not_widened(e: Evidence, limit: float) -> Iterator[Found]:
    if not e.widened and e.dof > 0 and not _above(e.chi2_dof, MISFIT_CHI2):
        p = float(chdtrc(e.dof, e.chi2))
        if p < limit:
            yield Found(
                value=p,
                words=f"chi2/dof is {e.chi2 / e.dof:.2f}: the stated uncertainties do not explain the residuals",
            )


def too_small(e: Evidence, limit: float) -> Iterator[Found]:
    if e.dof > 0 and e.chi2_dof < limit:
        yield Found(
            value=e.chi2_dof,
            words=f"chi2/dof is {e.chi2_dof:.2g}: the centres agree far better than their stated sigmas say, so that "
            "these are too large, and with them every uncertainty stated here",
            remedy="state the sigmas of the centres as they are",
        )


def prior_pulls(e: Evidence, limit: float) -> Iterator[Found]:
    for name, pull in e.prior_pulls:
        if _above(abs(pull), limit):
            yield Found(
                value=abs(pull),
                words=f"{name} comes out {abs(pull):.1f} stated standard uncertainties from the value in scanner.json",
                remedy=f"check {name} in scanner.json, or what else these poses may take for it",
            )


def effects(e: Evidence, limit: float, steps: bool) -> Iterator[Found]:
    # where the declared reading does not fit even beside what moved, a movement is a symptom of what is wrong
    if e.tests is not None or (e.diagnosis is not None and not e.diagnosis.declared.fits):
        return
    least = EFFECT_SHARE if e.coloured else 0.0
    moved: list[Effect] = [
        x
        for x in (e.stability.effects if e.stability else ())
        if bool(x.at) == steps and x.p < limit and x.size_px > EFFECT_PX and x.share > least
    ]
    # drifts resemble one another, and so do steps: the likeliest of each is named
    for x in sorted(moved, key=lambda x: (x.p, -x.share))[:1]:
        yield Found(value=x.p, words=f"{x.words} (p = {x.p:.1g})", remedy=part_of_run(x.at) if x.at else "")


def repeats(e: Evidence, limit: float, set_aside: bool) -> Iterator[Found]:
    for r in e.stability.repeats if e.stability else ():
        ignored = r.first in e.outliers or r.again in e.outliers
        if ignored == set_aside and _above(r.sigmas, limit) and _above(r.distance_px, REPEAT_PX):
            yield Found(
                value=r.sigmas,
                words=f"pose {r.first} taken again as {r.again} is off by {r.distance_px:.3g} px "
                f"({r.sigmas:.1f} sigma)" + ("; it was set aside" if ignored else ""),
            )


def held_out(e: Evidence, limit: float) -> Iterator[Found]:
    s = e.stability
    if s and s.held_out_rms > limit * s.fit_rms and s.held_out_chi2 > HELD_OUT_CHI2 * max(1.0, e.chi2_dof):
        yield Found(
            value=s.held_out_rms / s.fit_rms,
            words=f"held-out poses are predicted to {s.held_out_rms:.3g} px, fitted ones to {s.fit_rms:.3g} px: the "
            "model does not carry over",
        )


def halves(e: Evidence, limit: float) -> Iterator[Found]:
    h = e.halves
    if h is not None and h.p < limit:
        yield Found(
            value=h.p,
            words=f"calibrations from two halves of the poses differ by {h.rms_px:.2g} px over the field of view, "
            f"where {h.stated_px:.2g} px is stated (p = {h.p:.1g}): the model does not hold everywhere",
            remedy="look at the map of the difference in the report; free or state what is uncertain of the scanner",
        )


def scan(e: Evidence, limit: float) -> Iterator[Found]:
    if e.scan_px is not None and _above(e.scan_px, limit):
        yield Found(
            value=e.scan_px,
            words=f"a scan tilted by 5 degrees would carry {e.scan_px:.2g} px of standard uncertainty; use larger "
            "rotations, more poses or table angles",
            remedy="use larger rotations, more poses or table angles",
        )


def whole_scan(e: Evidence, limit: float) -> Iterator[Found]:
    """The uncertainty with everything that was assumed, whose parts the sentence names."""
    if e.stated_px is not None and _above(e.stated_px, limit):
        yield Found(
            value=e.stated_px,
            words=e.stated_words,
            remedy="turn the table to a second angle, or state what you know better (sigma in scanner.json; --fix)",
        )


def scatter(e: Evidence, limit: float) -> Iterator[Found]:
    s = e.scatter
    if s is not None and _above(s.ratio, limit):
        factor = float(np.sqrt(s.ratio))
        yield Found(
            value=s.ratio,
            words=f"poses scatter {factor:.1f} times as much as the manipulator's repeatability says "
            f"({1e3 * s.t_mm * factor:.2g} um, {1e6 * s.w_rad * factor:.2g} urad): an error that this model does not "
            "hold (backlash, drift)",
        )


def no_better_than_rigid(e: Evidence, limit: float) -> Iterator[Found]:
    a = e.against_rigid
    if a is not None and not a.better:
        yield Found(
            value=a.chosen_px,
            words=f"held-out poses are not predicted better than by trusting the poses ({a.chosen_px:.4f} px, rigid "
            f"{a.rigid_px:.4f} px); use model auto",
            remedy="--model auto",
        )


def size(e: Evidence, limit: float) -> Iterator[Found]:
    if e.size is not None and _above(e.size, limit):
        yield Found(
            value=e.size,
            words=f"the identified errors are {e.size:.1f} times as large as the machine's file says; check its "
            "geometry and units",
        )


def run_effects(e: Evidence, limit: float) -> Iterator[Found]:
    if e.run_effects:
        yield Found(
            value=float("nan"),
            words="during the run the manipulator drifted or its drives lagged (drift and lag are among the "
            "parameters): matrices apply the lag in the order of the scan's table, and count the drift, which a scan "
            "may show again, as scatter",
        )


def open_turns(e: Evidence, limit: float) -> Iterator[Found]:
    if e.open_turns:
        yield Found(value=float("nan"), words=e.open_turns, remedy="give the manipulator's geometry, or more balls")


def ball_size(e: Evidence, limit: float, most: float = np.inf) -> Iterator[Found]:
    b = e.ball_size
    if b is not None and np.isfinite(b.ratio) and limit < abs(b.ratio - 1.0) <= most:
        yield Found(
            value=b.ratio - 1.0,
            words=b.words,
            remedy="measure the ball's diameter; check d_SD, d_SR and the pixel pitch in scanner.json",
        )
