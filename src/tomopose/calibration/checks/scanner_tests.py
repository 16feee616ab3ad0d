r"""The culprit, not the symptom: one ranked list of single explanations of what a fit leaves.

Each effect is a set of columns C: what the centres would do if it were so.  With r the whitened residuals of a fit
whose Jacobian (priors as rows) has the orthonormal basis Q, the effect explains

    gain = g^T M^+ g,    g = C^T (1 - Q Q^T) r,    M = C^T (1 - Q Q^T) C,

of chi2: a score test, no refit is needed.  Effects with different numbers of columns are compared by their evidence,

    evidence = min((dof / 2) ln(chi2 / (chi2 - gain)), gain / 2) - (c / 2) ln(2 n) - ln(looks),

Schwarz's approximation (Ann. Statist. 6 (1978) 461), in natural log units; `looks` counts the effects and, for a step,
the poses at which it could have happened.  The first of the two lets no effect look significant where something else
leaves more than the stated sigmas explain; the second holds where the stated sigmas are too large.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from tomopose.calibration.checks.effects import Columns, Effect, Steps, effects_of, pixel_origin, steps_of
from tomopose.calibration.model.parameters import FreeParameters, free_parameters
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.rigid.fit import Fit, blocks, jacobian, minimise
from tomopose.units import Array

DECISIVE = 8.0
"""Evidence beyond which an effect is named: odds of 3000 to 1 after all looks.  A clean run reaches it once in some
thousand, and an effect of 5 sigma in one coordinate, with 189 poses and 40 looks, about does (25 / 2 - 3 - 3.7 = 6)."""

EQUAL = 3.0
"""Explanations within this evidence of the best are named beside it."""

PLAUSIBLE = 3.0
"""Assumed standard deviations within which a scanner value is the likelier of two equal explanations."""

MOST, LISTED = 4, 3
"""Explanations that are taken one after the other; single ones that are listed."""

SEEN = 1e-6
"""Share of a column that must be left beside the fit for it to count as visible."""


@dataclass(frozen=True, kw_only=True)
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


@dataclass(frozen=True, kw_only=True)
class Whitened:
    """A fit as the tests see it: r (k,) whitened residuals and A (k, m) whitened Jacobian, priors as further rows; the
    first 2 n rows belong to the n centres."""

    r: Array
    A: Array
    n: int


def whitened(problem: Problem, free: FreeParameters, fit: Fit) -> Whitened:
    """Residuals and Jacobian of a fit on all rows of `problem`, the priors as rows of their own."""
    b = blocks(problem, free, fit)
    J = (problem.W @ jacobian(problem, free, b)).reshape(2 * len(problem), -1)
    r = (problem.W @ (problem.x_D - b.x_D)[:, :, None]).reshape(-1)
    known = np.flatnonzero(free.information > 0)
    rows = np.zeros((len(known), J.shape[1]))
    rows[np.arange(len(known)), J.shape[1] - len(free) + known] = np.sqrt(free.information[known])
    pull = -np.sqrt(free.information[known]) * fit.delta[known]
    return Whitened(r=np.concatenate([r, pull]), A=np.concatenate([J, rows]), n=len(problem))


def _basis(A: Array) -> Array:
    norm = np.linalg.norm(A, axis=0)
    U, s, _ = np.linalg.svd(A / np.where(norm > 0, norm, 1.0), full_matrices=False)
    return np.asarray(U[:, s > 1e-9 * s[0]])


def _evidence(gain: Array, c: Array | int, chi2: float, dof: int, n: int, looks: float) -> Array:
    """See the module; chi2 and dof are what is left before the effect."""
    left = np.maximum(chi2 - gain, 1e-9 * max(chi2, 1e-300))
    # a chi2 below its expectation says that the stated sigmas are too large, and makes nothing significant
    f = max(dof - float(np.max(c)), 1.0)
    free_scale = 0.5 * f * np.log(chi2 / left)
    known = 0.5 * gain
    return np.asarray(np.minimum(free_scale, known) - 0.5 * np.asarray(c) * np.log(2.0 * n) - np.log(looks))


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    effect: Effect
    columns: Array
    gain: float
    evidence: float
    at: int = -1
    size: float = float("nan")
    sigma: float = float("nan")

    @property
    def may_be(self) -> bool:
        return self.effect.may_be(self.size, self.sigma)


def _plain(columns: Sequence[Columns], Q: Array, rest: Array, dof: int, looks: float, n: int) -> list[_Candidate]:
    """The effects without a place, scored all at once."""
    C = np.concatenate([c.C for c in columns], axis=1)
    full = np.zeros((len(rest), C.shape[1]))
    full[: 2 * n] = C
    before = np.linalg.norm(full, axis=0)
    full = full - Q @ (Q.T @ full)
    after = np.linalg.norm(full, axis=0)
    unit = np.where(after > SEEN * before, 1.0 / np.maximum(after, 1e-300), 0.0)
    E = full * unit
    g, M = E.T @ rest, E.T @ E
    chi2 = float(rest @ rest)
    found, first = [], 0
    for c in columns:
        part = slice(first, first + c.C.shape[1])
        first = part.stop
        gain, rank = _gain(M[part, part], g[part])
        if not rank:
            continue
        evidence = float(_evidence(np.array(gain), rank, chi2, dof, n, looks)) + c.effect.odds
        if c.constant:
            # a constant belongs to the scanner's values: what varies must show by itself
            least = slice(part.start, part.start + c.constant)
            without, r0 = _gain(M[least, least], g[least])
            varies = float(_evidence(np.array(gain - without), max(rank - r0, 1), chi2 - without, dof, n, looks))
            evidence = evidence if varies > DECISIVE else min(evidence, varies)
        one = c.C.shape[1] == 1
        size = float(g[part][0] / M[part, part][0, 0] * unit[part][0]) if one else float("nan")
        sigma = float(unit[part][0]) if one else float("nan")
        found.append(_Candidate(effect=c.effect, columns=c.C, gain=gain, evidence=evidence, size=size, sigma=sigma))
    return found


def _gain(M: Array, g: Array) -> tuple[float, int]:
    """(g^T M^+ g, rank)."""
    value, V = np.linalg.eigh(M)
    z = V.T @ g
    seen = value > 1e-6
    return float((z[seen] ** 2 / value[seen]).sum()), int(seen.sum())


def _step(steps: Steps, Q: Array, rest: Array, dof: int, looks: float, n: int) -> _Candidate | None:
    """The place at which a step explains most; all places are tried."""
    C = steps.C
    c = C.shape[2]
    if n < 2 * c + 2:
        return None
    q = Q[: 2 * n].reshape(n, 2, -1)

    def after(x: Array) -> Array:
        return np.cumsum(x[::-1], axis=0)[::-1]

    A = after(np.einsum("kia,kib->kab", C, C))
    B = after(np.einsum("kiq,kia->kqa", q, C))
    g = after(np.einsum("kia,ki->ka", C, rest[: 2 * n].reshape(n, 2)))
    # the residual is orthogonal to Q, so that Q Q^T r needs no part in g
    places = np.arange(steps.least, n - steps.least + 1)
    M = A[places] - np.swapaxes(B[places], 1, 2) @ B[places]
    d = np.sqrt(np.maximum(np.einsum("kaa->ka", A[places]), 1e-300))
    value, V = np.linalg.eigh(M / d[:, :, None] / d[:, None, :])
    z = np.einsum("kab,ka->kb", V, g[places] / d)
    seen = value > SEEN
    gain = np.where(seen, z**2 / np.where(seen, value, 1.0), 0.0).sum(axis=1)
    best = int(gain.argmax())
    k = int(places[best])
    evidence = float(
        _evidence(gain[best : best + 1], int(seen[best].sum()), float(rest @ rest), dof, n, looks * len(places))[0]
    )
    late = C * (np.arange(n) >= k)[:, None, None]
    return _Candidate(
        effect=steps.effect,
        columns=late.reshape(2 * n, c),
        gain=float(gain[best]),
        evidence=evidence + steps.effect.odds,
        at=k,
    )


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
    decisive ones only;  first: the likeliest single ones, explained;  chi2, left: before and after the chosen ones;
    dof."""

    chosen: tuple[Explanation, ...]
    first: tuple[Explanation, ...]
    single: tuple[Single, ...]
    chi2: float
    left: float
    dof: int
    columns: tuple[Array, ...] = field(repr=False, default=())


def ranked_explanations(
    problem: Problem,
    white: Whitened,
    columns: Sequence[Columns],
    steps: Sequence[Steps],
    *,
    most: int = MOST,
) -> Ranked:
    """Effects taken one after the other while one is decisive; the ranking before any was taken."""
    n, A = white.n, white.A
    looks = len(columns) + len(steps)
    chosen: list[Explanation] = []
    taken: list[Array] = []
    first: tuple[Explanation, ...] = ()
    single: tuple[Single, ...] = ()
    total = left = 0.0
    dof = 0
    for turn in range(most + 1):
        Q = _basis(A)
        rest = white.r - Q @ (Q.T @ white.r)
        left = float(rest @ rest)
        dof = len(rest) - Q.shape[1]
        if turn == 0:
            total = left
        if dof < 4 or turn == most or left <= 0:
            break
        candidates = _plain(columns, Q, rest, dof, looks, n)
        candidates += [s for s in (_step(one, Q, rest, dof, looks, n) for one in steps) if s is not None]
        candidates = sorted((c for c in candidates if c.may_be), key=lambda c: -c.evidence)
        if turn == 0:
            single = tuple(
                Single(name=c.effect.name, short=c.effect.short, kind=c.effect.kind, evidence=c.evidence, size=c.size)
                for c in candidates
            )
            first = tuple(_explain(c, candidates, problem, white, Q, rest, left) for c in candidates[:LISTED])
        if not candidates or candidates[0].evidence < DECISIVE:
            break
        best = candidates[0]
        found = first[0] if turn == 0 else _explain(best, candidates, problem, white, Q, rest, left)
        chosen.append(replace(found, predicts=_predicts(white, best.columns)))
        more = np.zeros((len(A), best.columns.shape[1]))
        more[: 2 * n] = best.columns
        taken.append(best.columns)
        A = np.concatenate([A, more], axis=1)
    return Ranked(
        chosen=tuple(chosen), first=first, single=single, chi2=total, left=left, dof=dof, columns=tuple(taken)
    )


def _explain(
    c: _Candidate,
    candidates: Sequence[_Candidate],
    problem: Problem,
    white: Whitened,
    Q: Array,
    rest: Array,
    chi2: float,
) -> Explanation:
    full = np.zeros((len(rest), c.columns.shape[1]))
    full[: 2 * white.n] = c.columns
    before = np.linalg.norm(full, axis=0)
    full = full - Q @ (Q.T @ full)
    norm = np.linalg.norm(full, axis=0)
    # a column that the fit takes up whole has no size of its own
    unit = np.where(norm > SEEN * before, 1.0 / np.maximum(norm, 1e-300), 0.0)
    size = np.asarray(np.linalg.lstsq(full * unit, rest, rcond=1e-3)[0] * unit, dtype=np.float64)
    moved = np.linalg.solve(problem.W, (full[: 2 * white.n] @ size).reshape(-1, 2, 1))[..., 0]
    px = float(np.sqrt((moved**2).sum(axis=1).mean()))
    at = "" if c.at < 0 else problem.pose_id[c.at]
    also = tuple(
        o.effect.words_of(np.zeros(o.columns.shape[1]), 0.0, "", short=True)
        for o in candidates
        if o is not c and c.evidence - EQUAL < o.evidence <= c.evidence
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
    n, m = white.n, white.A.shape[1]
    group = np.repeat(np.arange(n) // max(n // 10, 1) % 2, 2)
    better = 0.0
    for part in (0, 1):
        fit = np.concatenate([group == part, np.ones(len(white.r) - 2 * n, dtype=bool)])
        held = np.concatenate([group != part, np.zeros(len(white.r) - 2 * n, dtype=bool)])
        if fit.sum() < m + columns.shape[1] + 4:
            return True
        full = np.zeros((len(white.r), m + columns.shape[1]))
        full[:, :m], full[: 2 * n, m:] = white.A, columns
        norm = np.maximum(np.linalg.norm(full, axis=0), 1e-300)
        full = full / norm
        without = np.linalg.lstsq(full[fit, :m], white.r[fit], rcond=1e-8)[0]
        with_ = np.linalg.lstsq(full[fit], white.r[fit], rcond=1e-8)[0]
        better += float(((white.r[held] - full[held, :m] @ without) ** 2).sum())
        better -= float(((white.r[held] - full[held] @ with_) ** 2).sum())
    return better > 0


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


def scanner_tests(problem: Problem, free: FreeParameters, fit: Fit) -> ScannerTests:
    """All looks at the rows of `problem` (which may hold rows that the fit had set aside).

    free: with the priors of everything assumed.
    """
    b = blocks(problem, free, fit)
    white = whitened(problem, free, fit)
    columns, steps = effects_of(problem, b), steps_of(problem, b)
    freed = set(free.names)
    beside = ranked_explanations(problem, white, [c for c in columns if c.effect.name not in freed], steps)
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
    before = whitened(problem, held, plain)
    effects = [*effects_of(problem, blocks(problem, held, plain)), pixel_origin(problem)]
    declared = ranked_explanations(problem, before, effects, steps, most=1)
    known = np.isfinite(free.sigma)
    C = (problem.W @ (b.J_scanner[:, :, free.cols] * free.factor)).reshape(2 * len(problem), -1)[:, known]
    together = evidence_together(beside, declared, before, C * free.sigma[known])
    # as assumed, not as widened where the images contradict it
    return ScannerTests(beside=beside, declared=declared, gain=together, sigma=problem.scanner.sigma)


def evidence_together(beside: Ranked, declared: Ranked, before: Whitened, C: Array) -> float:
    """Evidence for all assumed values together against the declared ones.  C (2 n, a): whitened, a prior sigma each."""
    left = max(beside.chi2, 1e-300)
    fits = min((declared.chi2 - left) / 2, declared.dof / 2 * float(np.log(max(declared.chi2, 1e-300) / left)))
    # half the log determinant of 1 + prior x information: what the freedom of the assumed values costs
    Q = _basis(before.A[: 2 * before.n])
    C = C - Q @ (Q.T @ C)
    return fits - 0.5 * float(np.linalg.slogdet(np.eye(C.shape[1]) + C.T @ C)[1])
