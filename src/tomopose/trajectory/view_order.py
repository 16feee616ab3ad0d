"""In which order the views are used.

Order matters more than anything else in one iteration of SART: neighbouring views in sequence leave 0.2 voxel of centre
error where a spread order leaves 0.002 (docs/validation/reconstruction.md).
"""

from __future__ import annotations

import math

import numpy as np

from tomopose.errors import InputError

GOLDEN = (math.sqrt(5) - 1) / 2


def view_order(n: int, order: object = "golden", *, seed: int = 0) -> np.ndarray:
    """A permutation of n views: "golden", "random" (from `seed`), "sequential", or the n indices themselves.

    "golden": step k takes the view whose rank among n is that of k GOLDEN mod 1, so that any run of consecutive steps
    is spread over the scan (Kohler, IEEE NSS-MIC 2004, for equidistant views).
    """
    if isinstance(order, str):
        if order == "golden":
            return np.argsort(np.argsort((np.arange(n) * GOLDEN) % 1.0, kind="stable"), kind="stable")
        if order == "random":
            return np.random.default_rng(np.random.SeedSequence(seed)).permutation(n)
        if order == "sequential":
            return np.arange(n)
        raise InputError(f"order is {order!r}; 'golden', 'random', 'sequential' or a list of views is needed")
    found = np.asarray(order)
    if found.shape != (n,) or not np.array_equal(np.sort(found), np.arange(n)):
        raise InputError(f"the order given is no permutation of the {n} views")
    return found.astype(np.intp)


def subsets(order: np.ndarray, size: int) -> tuple[tuple[int, ...], ...]:
    """Consecutive runs of `size` views of an order; the last may be shorter."""
    if int(size) != size or size < 1:
        raise InputError(f"subset_size is {size!r}; a positive whole number of views is needed")
    return tuple(tuple(int(j) for j in order[i : i + size]) for i in range(0, len(order), int(size)))
