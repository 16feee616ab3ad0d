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

from tomopose.kernel_cache import njit
from tomopose.units import Array

SWEEPS = 4
MOST_EXCHANGES = 1500
"""Views that exchanges look at, all sweeps together: time, not quality, sets it; the first sweep gains most."""
DUAL_STEPS, PATIENCE, DEFLECTION = 800, 20, 0.85
"""Of the subgradient method; after PATIENCE steps without a lower bound its step is halved (Held, Wolfe, Crowder 1974),
and a step goes on along DEFLECTION of the one before (Camerini, Fratta, Maffioli 1975).  Tuned on the plate and the
specimen of benchmarks/planning at 40 views: value over bound 0.977 and 0.984; 0.969 and 0.970 with 400 steps, 12 and no
deflection."""
ENOUGH = 1e-4
"""By which share of it a bound has to fall to count as lower."""


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


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _reduced(A: np.ndarray, m: np.ndarray, w: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """(n,) sum_e w_e max(0, a_je - lambda_e) + m_j; in single precision and any order, four times as fast."""
    out = np.empty(len(A))
    for j in range(len(A)):
        a, total = A[j], np.float32(0.0)
        for e in range(len(w)):
            total += w[e] * max(a[e] - prices[e], np.float32(0.0))
        out[j] = total + m[j]
    return out


@njit(cache=True, nogil=True)
def _gains(A: np.ndarray, m: np.ndarray, w: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """What `_reduced` gives, in double precision."""
    out = np.empty(len(A))
    for j in range(len(A)):
        out[j] = _gain(A[j], prices, w) + m[j]
    return out


def dual_bound(A: np.ndarray, m: Array, w: Array, N: int, *, prices: np.ndarray, reached: float) -> float:
    """The lowest bound found from the prices given; never below `reached`, which N candidates attain."""
    single, best = w.astype(np.float32), prices.astype(np.float32)
    lowest, scale, waited = np.inf, 1.0, 0
    prices, direction = best, np.zeros(len(w))
    for _ in range(DUAL_STEPS):
        reduced = _reduced(A, m, single, prices)
        top = np.argpartition(-reduced, N - 1)[:N]
        bound = float(w @ prices.astype(np.float64) + reduced[top].sum())
        waited = 0 if bound < lowest * (1 - ENOUGH) else waited + 1
        if bound < lowest:
            lowest, best = bound, prices
        if waited >= PATIENCE:
            scale, waited, prices, direction = scale / 2, 0, best, np.zeros(len(w))
            if scale < 1e-3:
                break
            continue
        direction = 1.0 - (A[top] > prices).sum(axis=0) + DEFLECTION * direction
        slope = np.where((prices <= 0) & (direction > 0), 0.0, direction)
        size = float((w * slope) @ slope)
        if size == 0.0 or lowest - reached <= 1e-9:
            break
        # the metric of the weights: a step of lambda_e moves the bound by w_e
        prices = np.clip(prices - scale * (bound - reached) / size * slope, 0.0, 1.0).astype(np.float32)
    top_gains = np.partition(_gains(A, m, w, best), len(A) - N)[len(A) - N :]
    return max(float(w @ best.astype(np.float64) + top_gains.sum()), reached)


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
