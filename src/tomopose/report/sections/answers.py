"""The first screen of a calibration: can I use it, how exact is it, what limits it, what would help most."""

from __future__ import annotations

import math

import numpy as np

from tomopose.calibration.model.budget import budget_words
from tomopose.calibration.result import Calibration
from tomopose.report.page import Answer
from tomopose.report.words import meaning, number, small_unit

USE = {"trustworthy": "Yes", "doubtful": "Not before the doubt is settled", "rejected": "No"}
SIGMAS = 2.8
"""A value of chi2 within so many of its standard deviations, sqrt(2 / dof), is called usual: 99.5 % of runs are."""


def answers(calibration: Calibration) -> tuple[Answer, ...]:
    """The four questions of the first screen, answered from the result alone."""
    return (
        Answer(question="Can I use it?", words=_use(calibration)),
        Answer(question="How exact is it?", words=_exact(calibration)),
        Answer(question="What limits it?", words=_limits(calibration)),
        Answer(question="What would help most?", words=_help(calibration)),
    )


def _sentence(text: str) -> str:
    text = text.strip()
    return text if not text or text.endswith((".", "?", "!")) else text + "."


def _use(calibration: Calibration) -> str:
    word, reasons = USE[calibration.verdict], calibration.reasons
    if not reasons:
        return f"{word}: none of the checks gave a reason for doubt."
    more = f" ({len(reasons) - 1} more below)" if len(reasons) > 1 else ""
    return _sentence(f"{word}: {reasons[0]}{more}")


def _exact(calibration: Calibration) -> str:
    if calibration.budget is not None and math.isfinite(calibration.budget.total):
        words = budget_words(calibration.budget, calibration.assumed).split(", of which")[0].split(". ")[0]
        return _sentence(words[:1].upper() + words[1:])
    mount = [p for p in calibration.parameters if p.name.startswith("t_HT") and math.isfinite(p.u)]
    if not mount:
        return "This cannot be determined: the calibration has no uncertainty."
    worst = max(mount, key=lambda p: p.u)
    return (
        f"The mount is known to {small_unit(worst.u, worst.unit)} ({meaning(worst.name)}, standard uncertainty); "
        "what that means for a scan is not determined here."
    )


def _limits(calibration: Calibration) -> str:
    if calibration.reasons:
        return _sentence(calibration.reasons[0])
    budget = calibration.budget
    if budget is None or not budget.shares or not budget.total > 0:
        return "Detection noise and the number of poses; nothing that was assumed adds to it here."
    if budget.measured**2 >= budget.total**2 / 2:
        return f"The measurement itself: {number(budget.measured)} px of {number(budget.total)} px."
    name, px = budget.shares[0]
    what = f" ({meaning(name)})" if meaning(name) else ""
    share, rest = 100 * (px / budget.total) ** 2, len(budget.shares) - 1
    more = f"; {rest} more assumed values add to it" if rest else ""
    return f"What was assumed and not measured, most of all {name}{what}: {share:.0f} % of the variance{more}."


def _help(calibration: Calibration) -> str:
    for finding in calibration.checks:
        if finding.remedy and finding.verdict != "trustworthy":
            return _sentence(finding.remedy[:1].upper() + finding.remedy[1:])
    budget = calibration.budget
    if budget is not None and budget.two_angles is not None and budget.two_angles < 0.5 * budget.total:
        return f"Poses at a second table angle: the scan would carry {number(budget.two_angles)} px."
    if calibration.observability.notes:
        note = calibration.observability.notes[0]
        return _sentence(note[:1].upper() + note[1:])
    return "No single change was found that would help much."


def fit_words(chi2_dof: float, dof: int) -> str:
    """What a value of chi2 per degree of freedom means, in a sentence."""
    if not np.isfinite(chi2_dof) or dof < 1:
        return "No degrees of freedom are left, so the fit cannot be judged."
    half = SIGMAS * math.sqrt(2.0 / dof)
    usual = f"chance alone gives {number(max(0.0, 1 - half))} to {number(1 + half)} with {dof} degrees of freedom"
    if abs(chi2_dof - 1.0) <= half:
        return f"Good: the stated noise explains the residuals ({usual})."
    if chi2_dof < 1.0:
        return f"Harmless: the stated noise is larger than what the residuals show ({usual})."
    return f"High: the residuals hold more than the stated noise ({usual}); see the findings."


def condition_words(condition: float, unobservable: int) -> str:
    """What a condition number means, in a sentence."""
    if unobservable:
        return f"{unobservable} directions of the parameters are not determined by these poses."
    if not np.isfinite(condition):
        return "The poses do not determine all parameters."
    if condition < 100:
        return "Good: below 100 the poses determine every parameter well."
    return "High: some combination of parameters is known much worse than the rest."
