"""A reading of the data, fitted by the estimator of the manipulator's errors, as the diagnosis ranks it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.calibration.checks.conventions.hypothesis import Hypothesis
from tomopose.calibration.identified.map_estimate import MapEstimate, linear_at


def hypothesis_of(e: MapEstimate, *, name: str, words: str, remedy: str, outcome: str) -> Hypothesis:
    """chi2 by the sigmas as they were stated: scatter that was raised until it explains everything explains nothing."""
    at = linear_at(replace(e.problem, scatter=1.0), e.state)
    x = e.problem.data.x_D
    chi2 = float((at.r_white**2).sum() + (at.prior_residuals**2).sum())
    d_rms = float(np.sqrt((at.r**2).sum(axis=1).mean()))
    return Hypothesis(
        name=name,
        words=words,
        remedy=remedy,
        d_rms=d_rms,
        chi2=chi2,
        dof=e.dof,
        sigmas=float(np.sqrt(chi2 / max(e.dof, 1))),
        delta=0.0,
        factor=1.0,
        outcome=outcome,
        share=d_rms / float(np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=1).mean())),
    )
