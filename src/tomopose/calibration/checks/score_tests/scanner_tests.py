"""One effect after the other beside a rigid fit, with the values of the scanner as assumed and as declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tomopose.calibration.checks.score_tests.effects import effects_of, pixel_origin, steps_of
from tomopose.calibration.checks.score_tests.ranking import (
    DECISIVE,
    EQUAL,
    Explanation,
    Ranked,
    Single,
    ranked_explanations,
)
from tomopose.calibration.checks.score_tests.score import Whitened, whitened
from tomopose.calibration.model.ball_projection import ProjectionBlocks
from tomopose.calibration.model.parameters import FreeParameters, free_parameters
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.rigid.fit import Fit, blocks, minimise
from tomopose.units import Array

PLAUSIBLE = 3.0
"""Assumed standard deviations within which a scanner value is the likelier of two equal explanations."""


@dataclass(frozen=True, kw_only=True)
class ScannerTests:
    """beside: what the fit with all that was assumed still leaves, explained;  declared: what explains best why the
    values as declared do not fit;  gain: evidence for the assumed values together against the declared ones."""

    beside: Ranked
    declared: Ranked
    gain: float
    sigma: Mapping[str, float] = field(default_factory=dict)

    @property
    def rivals(self) -> tuple[Single, ...]:
        """Effects that are no scanner value and explain why the declared values do not fit as well as all scanner
        values do together; none where a scanner value that explains as much lies within what was assumed of it,
        or where something is left beside all of them, which is named itself."""
        best = self.declared.single[0].evidence if self.declared.single else 0.0
        if best < DECISIVE or self.left:
            return ()
        equal = [s for s in self.declared.single if s.evidence > best - EQUAL]
        likely = [s for s in equal if abs(s.size) <= PLAUSIBLE * self.sigma.get(s.name, 0.0)]
        others = [s for s in equal if s.kind not in ("scanner", "convention") and s.evidence > self.gain - EQUAL]
        return () if likely else tuple(others)

    @property
    def pixel_origin(self) -> Single | None:
        """Another origin of the pixels, where it explains why the declared values do not fit as well as they do."""
        best = self.declared.single[0].evidence if self.declared.single else 0.0
        found = [s for s in self.declared.single if s.kind == "convention"]
        least = max(DECISIVE, best - EQUAL, self.gain - EQUAL)
        return found[0] if found and found[0].evidence > least else None

    @property
    def left(self) -> tuple[Explanation, ...]:
        """What nothing that was assumed explains: grounds for doubt."""
        return self.beside.chosen

    @property
    def explanations(self) -> tuple[Explanation, ...]:
        """The culprit first: what explains best why the declared values do not fit, then what is left.

        Where all scanner values together explain more, several are off, and no single one is the culprit."""
        first = tuple(e for e in self.declared.chosen[:1] if e.evidence > self.gain - EQUAL)
        return (*first, *(e for e in self.beside.chosen if e.name not in {f.name for f in first}))


ISOLATED = 2
"""Centres set aside one or two at a time are chance; more neighbours are not, and the tests look at them."""


def rows_to_test(keep: npt.NDArray[np.bool_]) -> Any:
    """(n,) bool: the rows used, and those set aside three or more in a row, which no chance explains."""
    keep = np.asarray(keep, dtype=bool)
    rows = keep.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[True], keep, [True]]).astype(int)))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        rows[a:b] |= b - a > ISOLATED
    return rows


def scanner_tests(problem: Problem, free: FreeParameters, fit: Fit, b: ProjectionBlocks) -> ScannerTests:
    """All looks at the rows of `problem` (which may hold rows that the fit had set aside).

    free: with the priors of everything assumed;  b: projection of these rows at the fit.
    """
    white = whitened(problem, free, fit, b)
    columns, steps = effects_of(problem, b), steps_of(problem, b)
    freed = set(free.names)
    beside = ranked_explanations(problem, white, [c for c in columns if c.effect.name not in freed], steps)
    del white, columns  # of very many rows they are large
    kept = [name for name, s in zip(free.names, free.sigma, strict=True) if np.isinf(s)]
    held = free_parameters(
        problem.scanners,
        free=[n for n in kept if "[" not in n],
        fix=[n for n in problem.scanner.sigma if n not in kept],
    )
    plain = minimise(
        problem,
        held,
        fit
        if not len(free)
        else Fit(R_HT=fit.R_HT, t_HT=fit.t_HT, t=fit.t, delta=np.zeros(0), chi2=fit.chi2, status=fit.status, N=fit.N),
        iterations=30,
    )
    if not len(free) or not np.isfinite(plain.chi2):
        return ScannerTests(beside=beside, declared=beside, gain=0.0)
    b_held = blocks(problem, held, plain)
    before = whitened(problem, held, plain, b_held)
    effects = [*effects_of(problem, b_held), pixel_origin(problem)]
    declared = ranked_explanations(problem, before, effects, steps, most=1)
    del effects, steps, b_held
    known = np.isfinite(free.sigma)
    C = (problem.W @ (b.J_scanner[:, :, free.cols[known]] * (free.factor * free.sigma)[known])).reshape(
        2 * len(problem), -1
    )
    together = evidence_together(beside, declared, before, C)
    # as assumed, not as widened where the images contradict it
    return ScannerTests(beside=beside, declared=declared, gain=together, sigma=problem.scanner.sigma)


def evidence_together(beside: Ranked, declared: Ranked, before: Whitened, C: Array) -> float:
    """Evidence for all assumed values together against the declared ones.  C (2 n, a): whitened, a prior sigma each."""
    left = max(beside.chi2, 1e-300)
    fits = min((declared.chi2 - left) / 2, declared.dof / 2 * float(np.log(max(declared.chi2, 1e-300) / left)))
    # half the log determinant of 1 + prior x information: what the freedom of the assumed values costs
    C = before.beside_centres().without(C)
    return fits - 0.5 * float(np.linalg.slogdet(np.eye(C.shape[1]) + C.T @ C)[1])
