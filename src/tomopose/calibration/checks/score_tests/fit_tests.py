"""One effect after the other beside a fit of any model: identified errors, empirical maps, moving scanners, twins.

The fit is taken as linear about its optimum: the declared scanner values are its own with the deviations taken back.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from tomopose.calibration.checks.score_tests.effects import effects_of, steps_of
from tomopose.calibration.checks.score_tests.ranking import Ranked, ranked_explanations
from tomopose.calibration.checks.score_tests.scanner_tests import ScannerTests, evidence_together
from tomopose.calibration.checks.score_tests.score import Whitened
from tomopose.calibration.model.ball_projection import ProjectionBlocks
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.units import Array

FEWEST = 10
"""Equations beyond the unknowns that the tests need."""

SHORTEST = 20
"""A step has at least this part of the run on each side.  The first poses of a worn machine have no known direction of
approach, and a step after them would explain their play; fewer poses that were set aside are a block of outliers."""


def score_tests(
    linear: LinearFit,
    b: ProjectionBlocks,
    free: FreeParameters,
    delta: Array,
    *,
    without: Collection[str] = (),
    least_share: float = 0.0,
) -> ScannerTests | None:
    """All looks at the rows of `linear`, which may hold rows that the fit had set aside; None where too few are left.

    b: of the same rows;  free, delta: the scanner values with their priors, and their deviations;
    without: kinds of effects that the model holds itself;  least_share: of chi2, that an explanation must have.
    """
    n, m = len(linear.problem), linear.J.shape[2]
    if 2 * n + len(linear.prior_rows) < m + FEWEST:
        return None
    problem = linear.problem.with_covariance(linear.C)
    A = np.concatenate([linear.J_white().reshape(2 * n, m), linear.prior_rows])
    white = Whitened(r=linear.residuals, A=A, n=n)
    columns = [c for c in effects_of(problem, b) if c.effect.kind not in without]
    steps = [replace(s, least=max(s.least, n // SHORTEST)) for s in steps_of(problem, b)]
    others = [c for c in columns if c.effect.name not in free.names]
    beside = _large(ranked_explanations(problem, white, others, steps), least_share)
    known = np.flatnonzero(np.isfinite(free.sigma))
    if not len(known):
        return ScannerTests(beside=beside, declared=beside, gain=0.0)
    first = 6 + 3 * len(problem.ball_ids)
    before = _declared(white, A, first + known, delta[known])
    declared = _large(ranked_explanations(problem, before, columns, steps, most=1), least_share)
    gain = evidence_together(beside, declared, before, A[: 2 * n, first + known] * free.sigma[known])
    return ScannerTests(beside=beside, declared=declared, gain=gain, sigma=problem.scanner.sigma)


def _large(found: Ranked, least_share: float) -> Ranked:
    return replace(found, chosen=tuple(e for e in found.chosen if e.share > least_share))


def _declared(white: Whitened, A: Array, at: np.ndarray, delta: Array) -> Whitened:
    """The same rows, A (k, m), with the coordinates `at` held at their declared values, and without their priors."""
    others = np.setdiff1d(np.arange(A.shape[1]), at)
    rows = np.concatenate([np.ones(2 * white.n, dtype=bool), (A[2 * white.n :, others] != 0).any(axis=1)])
    r = white.r + A[:, at] @ delta
    return Whitened(r=r[rows], A=A[np.ix_(rows, others)], n=white.n)
