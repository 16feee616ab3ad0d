"""Very long tables of equations: only inner products of their columns are wanted, from one part of the rows after the
other."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tomopose.units import Array

PART = 8192
"""Rows (of two numbers each) that are looked at together: some megabytes of candidate columns."""


def parts(n: int) -> list[slice]:
    """The rows 0 .. n-1 in parts of at most `PART`."""
    return [slice(first, min(first + PART, n)) for first in range(0, n, PART)]


def is_tall(rows: int) -> bool:
    """Whether a table of so many equations is looked at in parts."""
    return rows > 2 * PART


def triangle(blocks_of_rows: Iterable[Array]) -> Array:
    """(c, c), or fewer rows: vectors with the inner products of the columns of all rows (k, c) together."""
    found: Array = np.zeros((0, 0))
    for rows in blocks_of_rows:
        together = rows if not found.size else np.concatenate([found, rows])
        found = np.asarray(np.linalg.qr(together, mode="r")) if len(together) > together.shape[1] else together
    return found
