"""Positive definite systems solved in one fixed order: the same bytes whatever the number of BLAS threads."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomopose.errors import BallNotFoundError
from tomopose.units import Array

RIDGE = 1e-12
"""Added to the scaled diagonal: keeps a direction without data from stopping the solution."""


def solve(N: Array, B: Array) -> Array:
    """X (n, m) of N X = B, N (n, n) positive definite, B (n, m).  BallNotFoundError where N is not."""
    good, X = _solve(N, B)
    if not good:
        raise BallNotFoundError("the rim does not determine a ball (singular normal equations)")
    return np.asarray(X)


@njit(cache=True, fastmath={"reassoc", "contract"})
def _solve(N, B):  # type: ignore[no-untyped-def]
    n, m = B.shape
    scale = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(N[n - 1 - i, n - 1 - i]) if N[n - 1 - i, n - 1 - i] > 0.0 else 0.0
    # The last unknown is eliminated first: angular nodes that know only their neighbours come before the shape that
    # all know, and a row of the factor is empty before the first entry of its row of N.
    L = np.zeros((n, n))
    first = np.empty(n, np.int64)
    for i in range(n):
        first[i] = i
        for j in range(i):
            if N[n - 1 - i, n - 1 - j] != 0.0:
                first[i] = j
                break
        for j in range(first[i], i + 1):
            total = N[n - 1 - i, n - 1 - j] * scale[i] * scale[j]
            if i == j:
                total = 1.0 + RIDGE if scale[i] > 0.0 else 1.0
            for k in range(max(first[i], first[j]), j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return False, B
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    X = np.empty((n, m))
    for i in range(n):
        for c in range(m):
            X[i, c] = B[n - 1 - i, c] * scale[i]
        for k in range(first[i], i):
            f = L[i, k]
            if f != 0.0:
                for c in range(m):
                    X[i, c] -= f * X[k, c]
        for c in range(m):
            X[i, c] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for c in range(m):
            X[i, c] /= L[i, i]
        for k in range(first[i], i):
            f = L[i, k]
            if f != 0.0:
                for c in range(m):
                    X[k, c] -= f * X[i, c]
    for i in range(n):
        for c in range(m):
            X[i, c] *= scale[i]
    return True, X[::-1].copy()
