r"""The culprit, not the symptom: one ranked list of single explanations of what a fit leaves.

Each effect explains some of chi2 (`score`): a score test, no refit is needed.  Effects with different numbers of
columns are compared by their evidence,

    evidence = min((dof / 2) ln(chi2 / (chi2 - gain)), gain / 2) - (c / 2) ln(2 n) - ln(looks),

Schwarz's approximation (Ann. Statist. 6 (1978) 461), in natural log units; `looks` counts the effects and, for a step,
the poses at which it could have happened.  The first of the two lets no effect look significant where something else
leaves more than the stated sigmas explain; the second holds where the stated sigmas are too large.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.checks.score_tests.effects import Columns, Effect, Steps, white_columns
from tomopose.calibration.checks.score_tests.score import (
    SEEN,
    Beside,
    Whitened,
    best_step,
    gain_of,
    in_pixels,
)
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.tall import is_tall, lengths, parts, triangle
from tomopose.units import Array
from tomopose.values import value

DECISIVE = 8.0
"""Evidence beyond which an effect is named: odds of 3000 to 1 after all looks.  A clean run reaches it once in some
thousand, and an effect of 5 sigma in one coordinate, with 189 poses and 40 looks, about does (25 / 2 - 3 - 3.7 = 6)."""

EQUAL = 3.0
"""Explanations within this evidence of the best are named beside it."""

MOST = 4
"""Explanations that are taken one after the other."""

TIE = 1e-6
"""Evidences that differ by less are equal: rounding alone would decide which is named first."""


@value
class Explanation:
    """An effect that explains what a fit leaves.

    name: fixed;  words: with its size;  evidence: see above;  share: of the chi2 that is explained;  size: of the
    effect's coordinates;  at: pose id of a step;  kind: scanner | panel | manipulator | table | time | step;
    also: other effects that explain as much;  predicts: it predicts poses that it was not estimated from.
    """

    name: str
    words: str
    evidence: float
    share: float
    size: Array
    kind: str
    at: str = ""
    also: tuple[str, ...] = ()
    predicts: bool = True

    def to_json(self) -> dict[str, object]:
        return {
            "name": self.name,
            "words": self.words,
            "evidence": self.evidence,
            "share": self.share,
            "size": np.asarray(self.size).tolist(),
            "kind": self.kind,
            "at": self.at,
            "also": list(self.also),
            "predicts": self.predicts,
        }


def _evidence(gain: float, c: int, chi2: float, dof: int, n: int, looks: float) -> float:
    """See the module; chi2 and dof are what is left before the effect."""
    left = max(chi2 - gain, 1e-9 * max(chi2, 1e-300))
    # a chi2 below its expectation says that the stated sigmas are too large, and makes nothing significant
    free_scale = 0.5 * max(dof - c, 1) * math.log(max(chi2, 1e-300) / left)
    return min(free_scale, 0.5 * gain) - 0.5 * c * math.log(2.0 * n) - math.log(looks)


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    """columns: calculates (2 n, c) whitened;  at: row of a step;  size, sigma: of an effect with one coordinate."""

    effect: Effect
    columns: Callable[[], Array]
    gain: float
    evidence: float
    at: int = -1
    size: float = float("nan")
    sigma: float = float("nan")

    @property
    def may_be(self) -> bool:
        return self.effect.may_be(self.size, self.sigma)

    def order(self, assumed: Mapping[str, float]) -> tuple[float, float]:
        """Likeliest first; of equal ones the one that is nearest to what was assumed of it."""
        known = assumed.get(self.effect.name, 0.0)
        return -round(self.evidence / TIE), abs(self.size) / known if known > 0 else float("inf")


@dataclass(frozen=True, kw_only=True)
class _Products:
    """Of effects beside a fit, their columns E scaled to length 1: g = E^T r (c,), M = E^T E (c, c), unit (c,) the
    scales, 0 for a column that the fit takes up whole."""

    g: Array
    M: Array
    unit: Array
    parts: tuple[slice, ...]

    @classmethod
    def of(cls, problem: Problem, columns: Sequence[Columns], white: Whitened) -> _Products:
        if not is_tall(len(white.r)):
            each = white_columns(problem, columns)
            beside, C = white.beside, np.concatenate(each, axis=1)
        else:
            each, m = [], white.A.shape[1]
            R = np.zeros((0, 0))
            for p in parts(white.n):
                each = white_columns(problem, columns, p)
                R = triangle([R, white.rows(p, np.concatenate(each, axis=1))])
            R = triangle([R, white.priors(R.shape[1] - m - 1)])
            beside, C = Beside.of(R[:, :m], R[:, -1]), R[:, m:-1]
        E = beside.without(C)
        before, after = np.linalg.norm(C, axis=0), np.linalg.norm(E, axis=0)
        unit = np.where(after > SEEN * before, 1.0 / np.maximum(after, 1e-300), 0.0)
        E = E * unit
        ends = np.cumsum([c.shape[1] for c in each])
        where = tuple(slice(end - c.shape[1], end) for c, end in zip(each, ends, strict=True))
        return cls(g=E.T @ beside.rest, M=E.T @ E, unit=unit, parts=where)


def _plain(problem: Problem, columns: Sequence[Columns], white: Whitened, looks: float) -> list[_Candidate]:
    """The effects without a place, scored all at once."""
    p = _Products.of(problem, columns, white)
    chi2, dof, n = white.beside.chi2, white.beside.dof, white.n
    found = []
    for c, part in zip(columns, p.parts, strict=True):
        gain, rank = gain_of(p.M[part, part], p.g[part])
        if not rank:
            continue
        evidence = _evidence(gain, rank, chi2, dof, n, looks) + c.effect.odds
        if c.constant:
            # a constant belongs to the scanner's values: what varies must show by itself
            least = slice(part.start, part.start + c.constant)
            without, r0 = gain_of(p.M[least, least], p.g[least])
            varies = _evidence(gain - without, max(rank - r0, 1), chi2 - without, dof, n, looks)
            evidence = evidence if varies > DECISIVE else min(evidence, varies)
        one = part.stop - part.start == 1
        k = part.start
        size = float(p.g[k] / p.M[k, k] * p.unit[k]) if one else float("nan")
        sigma = float(p.unit[k]) if one else float("nan")
        found.append(
            _Candidate(
                effect=c.effect,
                columns=_whole(problem, c),
                gain=gain,
                evidence=evidence,
                size=size,
                sigma=sigma,
            )
        )
    return found


def _whole(problem: Problem, one: Columns) -> Callable[[], Array]:
    return lambda: white_columns(problem, [one])[0]


def _step(steps: Steps, white: Whitened, looks: float) -> _Candidate | None:
    """The place at which a step explains most; all places are tried."""
    C, n = steps.C, white.n
    c = C.shape[2]
    if n < 2 * c + 2:
        return None
    places = np.arange(steps.least, n - steps.least + 1)
    k, gain, rank = best_step(C, white.beside, places)
    chi2, dof = white.beside.chi2, white.beside.dof
    evidence = _evidence(gain, rank, chi2, dof, n, looks * len(places))

    def late() -> Array:
        return np.asarray((C * (np.arange(n) >= k)[:, None, None]).reshape(2 * n, c))

    return _Candidate(effect=steps.effect, columns=late, gain=gain, evidence=evidence + steps.effect.odds, at=k)


@dataclass(frozen=True, kw_only=True)
class Single:
    """An effect on its own, before any was taken: its evidence, and its size where it has one coordinate."""

    name: str
    short: str
    kind: str
    evidence: float
    size: float


@dataclass(frozen=True, kw_only=True)
class Ranked:
    """single: every effect on its own, likeliest first;  chosen: explanations in the order in which they were taken,
    decisive ones only;  chi2, left: before and after the chosen ones;  dof."""

    chosen: tuple[Explanation, ...]
    single: tuple[Single, ...]
    chi2: float
    left: float
    dof: int


def ranked_explanations(
    problem: Problem,
    white: Whitened,
    columns: Sequence[Columns],
    steps: Sequence[Steps],
    *,
    most: int = MOST,
) -> Ranked:
    """Effects taken one after the other while one is decisive; the ranking before any was taken."""
    fit = white
    looks = len(columns) + len(steps)
    chosen: list[Explanation] = []
    single: tuple[Single, ...] = ()
    total = left = 0.0
    dof = 0
    for turn in range(most + 1):
        left, dof = white.beside.chi2, white.beside.dof
        if turn == 0:
            total = left
        if dof < 4 or turn == most or left <= 0:
            break
        candidates = _plain(problem, columns, white, looks)
        candidates += [s for s in (_step(one, white, looks) for one in steps) if s is not None]
        candidates = sorted((c for c in candidates if c.may_be), key=lambda c: c.order(problem.scanner.sigma))
        if turn == 0:
            single = tuple(
                Single(name=c.effect.name, short=c.effect.short, kind=c.effect.kind, evidence=c.evidence, size=c.size)
                for c in candidates
            )
        if not candidates or candidates[0].evidence < DECISIVE:
            break
        best = candidates[0]
        found = _explain(best, candidates, problem, white, left)
        C = best.columns()
        chosen.append(replace(found, predicts=_predicts(fit, C)))
        white = white.with_columns(C)
    return Ranked(chosen=tuple(chosen), single=single, chi2=total, left=left, dof=dof)


def _explain(
    c: _Candidate, candidates: Sequence[_Candidate], problem: Problem, white: Whitened, chi2: float
) -> Explanation:
    C = c.columns()
    full = white.beside.without(C)
    before, norm = np.linalg.norm(C, axis=0), np.linalg.norm(full, axis=0)
    # a column that the fit takes up whole has no size of its own
    unit = np.where(norm > SEEN * before, 1.0 / np.maximum(norm, 1e-300), 0.0)
    size = np.asarray(np.linalg.lstsq(full * unit, white.beside.rest, rcond=1e-3)[0] * unit, dtype=np.float64)
    moved = in_pixels(problem.W, (full[: 2 * white.n] @ size).reshape(-1, 2))
    px = float(np.sqrt((moved**2).sum(axis=1).mean()))
    at = "" if c.at < 0 else problem.pose_id[c.at]
    also = tuple(
        o.effect.words_of(np.zeros(0), 0.0, "", short=True)
        for o in candidates
        if o is not c and c.evidence - EQUAL < o.evidence <= c.evidence + TIE
    )
    words = c.effect.words_of(size, px, at)
    return Explanation(
        name=c.effect.name,
        words=words + (f"; equally likely: {', '.join(also[:3])}" if also else ""),
        evidence=c.evidence,
        share=c.gain / max(chi2, 1e-300),
        size=size,
        kind=c.effect.kind,
        at=at,
        also=tuple(o.effect.name for o in candidates if o is not c and o.evidence > c.evidence - EQUAL),
    )


def _predicts(white: Whitened, columns: Array) -> bool:
    """Does the effect, estimated from every other group of poses, lower the error of the poses between?"""
    n, m, c = white.n, white.A.shape[1], columns.shape[1]
    group = np.repeat(np.arange(n) // max(n // 10, 1) % 2, 2)
    priors = white.priors(c)
    size = np.concatenate([lengths(white.A), np.linalg.norm(columns, axis=0)])
    norm = np.concatenate([np.maximum(size, 1e-300), [1.0]])
    halves = []
    for part in (0, 1):
        rows = np.flatnonzero(group == part)
        if len(rows) + len(priors) < m + c + 4:
            return True
        some = (rows[p] for p in parts(len(rows)))
        halves.append(triangle(np.concatenate([white.A[k], columns[k], white.r[k, None]], axis=1) / norm for k in some))
    better = 0.0
    for fit, held in ((0, 1), (1, 0)):
        full, other = np.concatenate([halves[fit], priors / norm]), halves[held]
        without = np.linalg.lstsq(full[:, :m], full[:, -1], rcond=1e-8)[0]
        with_ = np.linalg.lstsq(full[:, :-1], full[:, -1], rcond=1e-8)[0]
        better += float(((other[:, -1] - other[:, :m] @ without) ** 2).sum())
        better -= float(((other[:, -1] - other[:, :-1] @ with_) ** 2).sum())
    return better > 0
