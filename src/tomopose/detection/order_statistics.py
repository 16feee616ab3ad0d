"""Order statistics of a scratch array, which they rearrange (selection after C. A. R. Hoare, Comm. ACM 4 (1961) 321).

The partition is N. Lomuto's: it has no branch that depends on the data, which a processor would guess wrong half of the
time.
"""

from __future__ import annotations

import math

from tomopose.kernel_cache import njit


@njit(cache=True)
def select(values, k):  # type: ignore[no-untyped-def]
    """The k-th smallest value, k from 0; afterwards values[:k] are no larger and values[k:] no smaller.

    NaN counts as large, or is returned.
    """
    low, high = 0, values.shape[0]
    while True:
        pivot = values[(low + high) // 2]
        if math.isnan(pivot):
            return pivot
        below = low
        for i in range(low, high):
            x = values[i]
            values[i] = values[below]
            values[below] = x
            below += x < pivot
        if k < below:
            high = below
            continue
        equal = below
        for i in range(below, high):
            x = values[i]
            values[i] = values[equal]
            values[equal] = x
            equal += x <= pivot
        if k < equal:
            return pivot
        low = equal


@njit(cache=True)
def median(values):  # type: ignore[no-untyped-def]
    """Median, the mean of the middle two where their number is even."""
    half = values.shape[0] // 2
    upper = select(values, half)
    if values.shape[0] % 2 == 1:
        return upper
    lower = values[0]
    for i in range(1, half):
        lower = max(lower, values[i])
    return 0.5 * (lower + upper)


@njit(cache=True)
def arrange(values):  # type: ignore[no-untyped-def]
    """Orders a few values upwards, in place, by insertion."""
    for i in range(1, values.shape[0]):
        x, j = values[i], i
        while j > 0 and values[j - 1] > x:
            values[j] = values[j - 1]
            j -= 1
        values[j] = x
