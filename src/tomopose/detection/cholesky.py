"""Positive definite systems solved in one fixed order: the same bytes whatever the number of BLAS threads."""

from __future__ import annotations

import math

import numpy as np

from tomopose.errors import BallNotFoundError
from tomopose.kernel_cache import njit
from tomopose.units import Array

RIDGE = 1e-12
"""Added to the scaled diagonal: keeps a direction without data from stopping the solution."""


def solve(N: Array, B: Array) -> Array:
    """X (n, m) of N X = B, N (n, n) positive definite, of which the upper triangle is read, B (n, m).

    BallNotFoundError where N is not positive definite.
    """
    good, X = _solve(N, np.ascontiguousarray(B))
    if not good:
        raise BallNotFoundError("the rim does not determine a ball (singular normal equations)")
    return np.asarray(X)


@njit(cache=True, fastmath={"reassoc", "contract"})
def _solve(N, B):  # type: ignore[no-untyped-def]
    """(whether N is positive definite, X).

    The last unknown is eliminated first: angular nodes that know only their neighbours come before the shape that all
    know, and a row of the factor is empty before the first entry of its row of N.
    """
    n, m = B.shape
    scale, per_diagonal = np.zeros(n), np.empty(n)
    for i in range(n):
        if N[n - 1 - i, n - 1 - i] > 0.0:
            scale[i] = 1.0 / math.sqrt(N[n - 1 - i, n - 1 - i])
    L, first = np.empty((n, n)), np.empty(n, np.int64)
    for i in range(n):
        row = N[n - 1 - i]
        start = 0
        while start < i and row[n - 1 - start] == 0.0:
            start += 1
        first[i] = start
        for j in range(start, i):
            total = row[n - 1 - j] * scale[i] * scale[j]
            for k in range(max(start, first[j]), j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total * per_diagonal[j]
        total = 1.0 + RIDGE if scale[i] > 0.0 else 1.0
        for k in range(start, i):
            total -= L[i, k] * L[i, k]
        if not total > 0.0:
            return False, B
        per_diagonal[i] = 1.0 / math.sqrt(total)
    X = np.empty((n, m))
    for i in range(n):
        for c in range(m):
            X[i, c] = B[n - 1 - i, c] * scale[i]
        for k in range(first[i], i):
            for c in range(m):
                X[i, c] -= L[i, k] * X[k, c]
        for c in range(m):
            X[i, c] *= per_diagonal[i]
    for i in range(n - 1, -1, -1):
        for c in range(m):
            X[i, c] *= per_diagonal[i]
        for k in range(first[i], i):
            for c in range(m):
                X[k, c] -= L[i, k] * X[i, c]
    for i in range(n):
        for c in range(m):
            X[i, c] *= scale[i]
    return True, X[::-1].copy()
