"""Order statistics of a scratch array, which they rearrange (C. A. R. Hoare's selection)."""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def select(values, n, k):  # type: ignore[no-untyped-def]
    """The k-th smallest of values[:n], k from 0; afterwards values[:k] are no larger and values[k:n] no smaller."""
    low, high = 0, n - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return values[k]


@njit(cache=True)
def median(values, n):  # type: ignore[no-untyped-def]
    """Median of values[:n], the mean of the middle two where n is even."""
    upper = select(values, n, n // 2)
    if n % 2 == 1:
        return upper
    lower = values[0]
    for i in range(1, n // 2):
        lower = max(lower, values[i])
    return 0.5 * (lower + upper)
