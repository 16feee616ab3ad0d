"""Trustworthy, doubtful or rejected: the rules, with their thresholds.

| finding | verdict |
|---|---|
| no optimum reached | rejected |
| a rival convention fits better by 5 sigma and lowers chi2 (floored at dof) by the factor 2 | rejected |
| a rival convention fits better by 5 sigma | doubtful |
| more than 20 % of the centres do not fit | doubtful |
| more than 10 % of the centres set aside, or fewer than 10 degrees of freedom | doubtful |
| chi2/dof above 4 and more than 0.05 px of residual beyond what the stated sigmas explain | doubtful |
| drift or a change point, significant at 1e-4 and above 0.02 px | doubtful |
| a repeated pose off by 5 sigma and 0.05 px | doubtful |
| held-out poses predicted 3 times worse than fitted ones, and worse than their own prediction by 2 sigma | doubtful |
| a tilt of 5 degrees would carry more than 0.25 px of standard uncertainty at the field's edge | doubtful |

Where chi2/dof is above 4, a drift or change point must also explain a quarter of chi2: residuals that come from the
poses are not white, and their chance patterns look significant.

What the poses cannot tell about *assumed* scanner parameters or conventions is noted, and is no ground for doubt in the
fit: the verdict judges the data against what was declared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.checks.convention_tests import BETTER, MUCH_BETTER, Diagnosis
from tomopose.calibration.checks.stability import SIGNIFICANT, Integrity
from tomopose.calibration.rigid.outliers import LARGEST_SHARE

OUTLIER_SHARE, FEW_DOF = 0.1, 10
MISFIT_CHI2, MISFIT_PX = 4.0, 0.05
EFFECT_PX, REPEAT_SIGMAS, REPEAT_PX = 0.02, 5.0, 0.05
HELD_OUT_FACTOR, HELD_OUT_CHI2 = 3.0, 4.0
EFFECT_SHARE = 0.25
SCAN_PX = 0.25


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What the verdict looks at.  residual_px: d_rms;  expected_px: what the stated sigmas explain of it;
    chi2_dof: with the stated sigmas of the centres;  scan_px: predicted uncertainty under a tilt of 5 degrees."""

    converged: bool
    dof: int
    n_used: int
    n_outliers: int
    misfit: bool
    chi2_dof: float
    residual_px: float
    expected_px: float
    scan_px: float
    diagnosis: Diagnosis | None = None
    integrity: Integrity | None = None


def verdict(f: Findings) -> tuple[str, tuple[str, ...]]:
    """(verdict, reasons): the worst of all findings, and every reason for it."""
    rejected: list[str] = []
    doubtful: list[str] = []
    if not f.converged:
        rejected.append(
            "no optimum was reached: a convention or the scanner's values are wrong; tomopose diagnose tries others"
        )
    for h in f.diagnosis.leading if f.diagnosis else ():
        much = h.factor > MUCH_BETTER
        (rejected if much else doubtful).append(
            f"a rival convention fits significantly better: {h.words} (delta chi2 {h.delta:.3g}, limit {-BETTER:g}; "
            f"d_rms {h.d_rms:.3g} px instead of {f.residual_px:.3g} px); to try: {h.cure}"
        )
    excess = np.sqrt(max(f.residual_px**2 - f.expected_px**2, 0.0))
    if f.misfit:
        doubtful.append(
            f"more than {LARGEST_SHARE:.0%} of the centres do not fit; none was set aside: the poses themselves, a "
            "convention or the scanner's values may be wrong"
        )
    share = f.n_outliers / max(f.n_outliers + f.n_used, 1)
    if share > OUTLIER_SHARE:
        doubtful.append(f"{f.n_outliers} of {f.n_outliers + f.n_used} centres ({share:.0%}) were set aside")
    if f.dof < FEW_DOF:
        doubtful.append(f"only {f.dof} degrees of freedom: the residuals can hardly show a mistake")
    if f.chi2_dof > MISFIT_CHI2 and excess > MISFIT_PX:
        doubtful.append(
            f"residuals of {f.residual_px:.3g} px where the centres' sigmas explain {f.expected_px:.3g} px (chi2/dof "
            f"{f.chi2_dof:.3g}): the manipulator does not reach the poses it reports, or scanner values are wrong; "
            "identify the manipulator's errors (--manipulator)"
        )
    if f.integrity:
        # residuals that come from the poses are not white: there, chance alone explains what looks significant
        least = EFFECT_SHARE if f.chi2_dof > MISFIT_CHI2 else 0.0
        moved = [e for e in f.integrity.effects if e.p < SIGNIFICANT and e.size_px > EFFECT_PX and e.share > least]
        # drifts resemble one another, and so do steps: the likeliest of each is named
        for kind in ([e for e in moved if not e.at], [e for e in moved if e.at]):
            doubtful += [f"{e.words} (p = {e.p:.1g})" for e in sorted(kind, key=lambda e: (e.p, -e.share))[:1]]
        doubtful += [
            f"pose {r['first']} taken again as {r['again']} is off by {r['distance_px']:.3g} px "
            f"({r['sigmas']:.1f} sigma)"
            for r in f.integrity.repeats
            if r["sigmas"] > REPEAT_SIGMAS and r["distance_px"] > REPEAT_PX
        ]
        held = f.integrity
        if held.held_out_rms > HELD_OUT_FACTOR * held.fit_rms and held.held_out_chi2 > HELD_OUT_CHI2 * max(
            1.0, f.chi2_dof
        ):
            doubtful.append(
                f"held-out poses are predicted to {held.held_out_rms:.3g} px, fitted ones to {held.fit_rms:.3g} px: "
                "the model does not carry over"
            )
    if f.scan_px > SCAN_PX:
        doubtful.append(
            f"a scan tilted by 5 degrees would carry {f.scan_px:.2g} px of standard uncertainty; use larger rotations, "
            "more poses or table angles"
        )
    if rejected:
        return "rejected", tuple(rejected + doubtful)
    if doubtful:
        return "doubtful", tuple(doubtful)
    return "trustworthy", ()
