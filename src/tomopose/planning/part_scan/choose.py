"""N of the candidates: lazy greedy, then single exchanges while they gain, and a bound on what any N could reach.

J(S) = sum_e w_e max_{j in S} a_je + sum_{j in S} m_j is monotone and submodular: greedy reaches at least 1 - 1/e of the
best (Nemhauser, Wolsey, Fisher 1978), and a gain never grows while S does, so that most need not be computed again
(Minoux 1978).

Bound.  For any prices lambda_e >= 0,
    max_S J(S) <= sum_e w_e lambda_e + the N largest of ( sum_e w_e max(0, a_je - lambda_e) + m_j ),
the Lagrangian dual of the linear program of facility location.  lambda_e = max_{j in S} a_je gives the usual bound
J(S) + the N largest gains; a subgradient method lowers it from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from tomopose.units import Array

SWEEPS = 4
MOST_EXCHANGES = 1500
"""Views that exchanges look at, all sweeps together: time, not quality, sets it; the first sweep gains most."""
DUAL_STEPS = 400
PATIENCE = 12
"""Steps without a lower bound after which the step of the subgradient method is halved (Held, Wolfe, Crowder 1974)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """rows: of the candidates, in the order chosen;  J: their value;  bound: no N candidates are worth more."""

    rows: np.ndarray
    J: float
    bound: float


@njit(cache=True, nogil=True)
def _gain(a: np.ndarray, best: np.ndarray, w: np.ndarray) -> float:
    total = 0.0
    for e in range(len(w)):
        more = a[e] - best[e]
        if more > 0.0:
            total += w[e] * more
    return total


@njit(cache=True, nogil=True)
def _best_addition(
    A: np.ndarray, m: np.ndarray, best: np.ndarray, w: np.ndarray, upper: np.ndarray, taken: np.ndarray
) -> tuple[int, float]:
    """(candidate, gain): the largest gain, lowest number among equals; `upper` are bounds of the gains, updated."""
    winner, most = -1, -1.0
    for j in np.argsort(-upper, kind="mergesort"):
        if upper[j] < most:
            break
        if taken[j]:
            continue
        upper[j] = _gain(A[j], best, w) + m[j]
        if upper[j] > most or (upper[j] == most and j < winner):
            winner, most = j, upper[j]
    return winner, most


@njit(cache=True, nogil=True)
def _greedy(A: np.ndarray, m: np.ndarray, w: np.ndarray, N: int) -> np.ndarray:
    best, taken = np.zeros(len(w), dtype=np.float32), np.zeros(len(A), dtype=np.bool_)
    upper = np.full(len(A), np.inf)
    rows = np.empty(N, dtype=np.int64)
    for k in range(N):
        j, _ = _best_addition(A, m, best, w, upper, taken)
        rows[k] = j
        taken[j] = True
        best = np.maximum(best, A[j])
    return rows


@njit(cache=True, nogil=True)
def without_each(A: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(best, second, who) (E,): the largest two values of the chosen rows at each element, and whose the largest is."""
    E = A.shape[1]
    best, second = np.zeros(E, dtype=np.float32), np.zeros(E, dtype=np.float32)
    who = np.full(E, -1, dtype=np.int64)
    for i in range(len(rows)):
        a = A[rows[i]]
        for e in range(E):
            if a[e] > best[e]:
                second[e], best[e], who[e] = best[e], a[e], i
            elif a[e] > second[e]:
                second[e] = a[e]
    return best, second, who


@njit(cache=True, nogil=True)
def _exchange(A: np.ndarray, m: np.ndarray, w: np.ndarray, rows: np.ndarray) -> int:
    """Replace each chosen row once by the candidate that gains most without it; how many changed."""
    taken = np.zeros(len(A), dtype=np.bool_)
    taken[rows] = True
    changed = 0
    best, second, who = without_each(A, rows)
    for i in range(len(rows)):
        base = np.where(who == i, second, best)
        own = _gain(A[rows[i]], base, w) + m[rows[i]]
        j, gain = _best_addition(A, m, base, w, np.full(len(A), np.inf), taken)
        if gain > own * (1 + 1e-9) + 1e-12:
            taken[rows[i]], taken[j] = False, True
            rows[i] = j
            changed += 1
            best, second, who = without_each(A, rows)
    return changed


@njit(cache=True, nogil=True)
def _reduced(A: np.ndarray, m: np.ndarray, w: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """(n,) sum_e w_e max(0, a_je - lambda_e) + m_j."""
    out = np.empty(len(A))
    for j in range(len(A)):
        out[j] = _gain(A[j], prices, w) + m[j]
    return out


def dual_bound(A: np.ndarray, m: Array, w: Array, N: int, *, prices: np.ndarray, reached: float) -> float:
    """The lowest bound found from the prices given; never below `reached`, which N candidates attain."""
    lowest, scale, waited = np.inf, 1.0, 0
    prices = prices.astype(np.float32)
    best_prices = prices
    for _ in range(DUAL_STEPS):
        value = _reduced(A, m, w, prices)
        top = np.argpartition(-value, N - 1)[:N]
        bound = float(w @ prices.astype(np.float64) + value[top].sum())
        if bound < lowest - 1e-9:
            lowest, best_prices, waited = bound, prices, 0
        else:
            waited += 1
        if waited >= PATIENCE:
            scale, waited, prices = scale / 2, 0, best_prices
            if scale < 1e-3:
                break
            continue
        slope = 1.0 - (A[top] > prices).sum(axis=0)
        slope[(prices <= 0) & (slope > 0)] = 0.0
        size = float((w * slope) @ slope)
        if size == 0.0 or lowest - reached <= 1e-9:
            break
        # the metric of the weights: a step of lambda_e moves the bound by w_e
        prices = np.clip(prices - scale * (bound - reached) / size * slope, 0.0, 1.0).astype(np.float32)
    return max(lowest, reached)


def value(A: np.ndarray, m: Array, w: Array, rows: np.ndarray) -> float:
    """J of the rows."""
    return float(w @ A[rows].max(axis=0).astype(np.float64) + m[rows].sum())


def choose(A: np.ndarray, m: Array, w: Array, N: int) -> np.ndarray:
    """Rows (N,) of the candidates in greedy order after exchanges.  Deterministic: ties go to the lowest row.

    A: (n, E) float32, 0 to 1;  m: (n,), what each view adds by itself;  w: (E,) weights.
    """
    rows = _greedy(A, m, w, N)
    for _ in range(min(SWEEPS, max(MOST_EXCHANGES // N, 1))):
        if not _exchange(A, m, w, rows):
            break
    return rows
