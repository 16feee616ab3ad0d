"""Polychromatic Beer-Lambert inside kernels: T = sum_e w_e exp(-sum_m mu_em L_m).

Most rays meet one material.  Its T(L) is tabulated once, with slopes, on steps so short that cubic interpolation errs
by less than `TABLE_ERROR`; only rays through several materials pay for the sum.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.kernel_cache import njit
from tomopose.units import Array

OPAQUE = 30.0
"""exp(-30) = 1e-13: nothing gets through."""
TABLE_ERROR = 1e-9
STEPS = 128
DECAY = np.exp(-np.arange(OPAQUE * STEPS + 1) / STEPS)


def tabulated(w: Array, mu: Array) -> tuple[Array, Any, Array]:
    """(steps per mm (m,), first row of each material (m + 1,), rows (n, 2): T and its slope per step).

    Cubic Hermite interpolation errs by h^4 / 384 times the fourth derivative, at most sum w mu^4.
    """
    scale = (np.maximum(w @ mu**4, 1e-300) / (384 * TABLE_ERROR)) ** 0.25
    rows = []
    for m in range(mu.shape[1]):
        count = int(np.ceil(OPAQUE / mu[:, m].min() * scale[m])) + 2
        decay = np.exp(-np.outer(np.arange(count) / scale[m], mu[:, m]))
        rows.append(np.stack([decay @ w, -decay @ (w * mu[:, m]) / scale[m]], axis=1))
    first = np.cumsum([0, *(len(r) for r in rows)])
    return scale, first, np.concatenate(rows)


@njit(cache=True, nogil=True)
def attenuated(beam: tuple[Array, Array, Array, Array, Array], L: np.ndarray) -> float:
    """Transmission of one ray with path lengths L (m,), mm; beam: (w, mu, *tabulated(w, mu))."""
    w, mu, scale, first, table = beam
    only, several = -1, False
    for m in range(len(L)):
        if L[m] > 0.0:
            several = only >= 0
            only = m
            if several:
                break
    if only < 0:
        return 1.0
    if not several:
        x = L[only] * scale[only]
        if x >= first[only + 1] - first[only] - 1:
            return 0.0
        k = int(x)
        r = x - k
        k += first[only]
        a, b = table[k, 0], table[k + 1, 0]
        p, q = table[k, 1] - (b - a), (b - a) - table[k + 1, 1]
        return float(a + r * (b - a + (1 - r) * (p * (1 - r) + q * r)))
    total = 0.0
    for e in range(len(w)):
        x = 0.0
        for m in range(len(L)):
            x += mu[e, m] * L[m]
        if x < OPAQUE:
            # exp(-x) from a table and three terms of the series, to 2e-10.
            k = int(x * STEPS)
            r = x - k / STEPS
            total += w[e] * DECAY[k] * (1 - r * (1 - r * (0.5 - r / 6)))
    return float(total)
