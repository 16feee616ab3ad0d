"""Which n of many candidate poses to image: exchange of rows of the information matrix (Fedorov; Atkinson, Donev and
Tobias, Optimum Experimental Designs, ch. 12), for a linear criterion tr(M C) or for log det C.

A candidate has a whitened Jacobian L_i (2, m): N = N_0 + sum L_i^T L_i.  Adding or taking away one changes C = N^-1
by a matrix of rank 2, so that all candidates are weighed at once without an inversion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array

Criterion = Literal["A", "D"]
START_WEIGHT = 1e-3
"""Part of the candidates' mean information that keeps the first matrices invertible; it is taken out afterwards."""
PASSES = 12


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """index: of the candidates, in the order of choice;  covariance (m, m);  value: tr(M C), or log det C."""

    index: Any
    covariance: Array
    value: float


def criterion_gains(L: Array, C: Array, M: Array, criterion: Criterion, sign: int) -> Array:
    """(k,) change of the criterion by adding (sign +1) or taking away (-1) each candidate.  Lower is better."""
    LC = L @ C
    S = np.eye(2) + sign * (LC @ np.swapaxes(L, 1, 2))
    det = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
    if criterion == "D":
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(det > 1e-12, -np.log(np.where(det > 1e-12, det, 1.0)), np.inf)
    B = LC @ M @ np.swapaxes(LC, 1, 2)
    # tr(S^-1 B), S 2 x 2
    trace = S[:, 1, 1] * B[:, 0, 0] + S[:, 0, 0] * B[:, 1, 1] - S[:, 0, 1] * B[:, 1, 0] - S[:, 1, 0] * B[:, 0, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(det > 1e-12, -sign * trace / np.where(det > 1e-12, det, 1.0), np.inf)


def _value(C: Array, M: Array, criterion: Criterion) -> float:
    return float(np.trace(M @ C)) if criterion == "A" else float(np.linalg.slogdet(C)[1])


def exchange(
    L: Array,
    n: int,
    *,
    M: Array,
    N_0: Array | None = None,
    criterion: Criterion = "A",
    fixed: Sequence[int] = (),
    seed: int = 0,
    starts: int = 3,
) -> Chosen:
    """n of the candidates L (k, 2, m), repetition allowed, that make the criterion small.

    M (m, m): weights of the linear criterion.  N_0: information at hand (priors).  fixed: indices that must be taken.
    The best of `starts` seeded starts.
    """
    k, _, m = L.shape
    if 2 * n < m and N_0 is None:
        raise InputError(f"{n} images give {2 * n} equations for {m} unknowns")
    # balanced coordinates: the criterion does not depend on them, the inverses do
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("kia,kia->a", L, L), 1e-300))
    Ls, Ms = L * scale, M * scale[:, None] * scale
    base = np.zeros((m, m)) if N_0 is None else N_0 * scale[:, None] * scale
    ridge = START_WEIGHT * np.einsum("kia,kib->ab", Ls, Ls) / k + 1e-12 * np.eye(m)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    best: Chosen | None = None
    for _ in range(starts):
        index = list(fixed)
        N = base + ridge + sum((Ls[i].T @ Ls[i] for i in index), np.zeros((m, m)))
        # a few random rows first, so that starts differ
        for i in rng.choice(k, size=max(0, min(m, n - len(index))), replace=False):
            index.append(int(i))
            N = N + Ls[i].T @ Ls[i]
        while len(index) < n:
            i = int(criterion_gains(Ls, np.linalg.inv(N), Ms, criterion, 1).argmin())
            index.append(i)
            N = N + Ls[i].T @ Ls[i]
        index, N = _improve(Ls, index, base, N - ridge, Ms, criterion, len(fixed))
        C = np.asarray(np.linalg.inv(N + 1e-15 * np.eye(m)), dtype=np.float64)
        value = _value(C, Ms, criterion)
        if best is None or value < best.value:
            best = Chosen(index=np.array(index), covariance=C * scale[:, None] * scale, value=value)
    assert best is not None
    return best


def _improve(
    L: Array, index: list[int], base: Array, N: Array, M: Array, criterion: Criterion, n_fixed: int
) -> tuple[list[int], Array]:
    """Exchange the least useful row for the most useful candidate until nothing gets better."""
    m = N.shape[0]
    tiny = 1e-12 * np.eye(m)
    for _ in range(PASSES):
        changed = False
        for place in range(n_fixed, len(index)):
            i = index[place]
            without = N - L[i].T @ L[i]
            C = np.linalg.inv(without + tiny)
            gains = criterion_gains(L, C, M, criterion, 1)
            j = int(gains.argmin())
            if j != i and gains[j] < gains[i] - 1e-9 * abs(gains[i]):
                index[place] = j
                N = without + L[j].T @ L[j]
                changed = True
        # rounding of many updates is taken out once a pass
        rows = L[index]
        N = base + np.einsum("kia,kib->ab", rows, rows)
        if not changed:
            break
    return index, N
