"""Very long tables of equations: only inner products of their columns are wanted, from one part of the rows after the
other.

The centre of one of many balls answers to the coordinates of its own ball only: `ByBall` and `WhiteRows` hold what is
not zero, and write out the rows that are looked at.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tomopose.units import Array

PART = 8192
"""Rows (of two numbers each) that are looked at together: some megabytes of candidate columns."""

Some = slice | npt.NDArray[np.int64]
"""Some rows: a slice without a step, or their numbers."""


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


@dataclass(frozen=True, kw_only=True)
class ByBall:
    """Derivatives (n, 2, m) of the centres of several balls by w_HT, t_HT, the balls and what was freed; indexed by
    rows as an array is.

    w_HT, t_HT, own (n, 2, 3): by the mount and the row's own ball;  freed (n, 2, f);  ball (n,): index of `balls`.
    """

    w_HT: Array
    t_HT: Array
    own: Array
    freed: Array
    ball: npt.NDArray[np.int64]
    balls: int

    def __len__(self) -> int:
        return len(self.own)

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self), 2, 6 + 3 * self.balls + self.freed.shape[2]

    def __getitem__(self, rows: Some) -> Array:
        ball = self.ball[rows]
        J = np.zeros((len(ball), *self.shape[1:]))
        J[:, :, :3], J[:, :, 3:6] = self.w_HT[rows], self.t_HT[rows]
        for i in range(3):
            J[np.arange(len(ball)), :, 6 + 3 * ball + i] = self.own[rows][:, :, i]
        J[:, :, 6 + 3 * self.balls :] = self.freed[rows]
        return J


@dataclass(frozen=True, kw_only=True)
class WhiteRows:
    """A table (2 n + k, m + c): derivatives J (n, 2, m) in standard deviations, by the whiteners W (n, 2, 2), beside
    further columns more (2 n, c); then priors (k, m), of which the further columns know nothing."""

    W: Array
    J: ByBall
    priors: Array
    more: Array

    def __len__(self) -> int:
        return 2 * len(self.J) + len(self.priors)

    @property
    def shape(self) -> tuple[int, int]:
        return len(self), self.J.shape[2] + self.more.shape[1]

    def __getitem__(self, rows: Some) -> Array:
        if isinstance(rows, slice):
            rows = np.arange(*rows.indices(len(self)))
        centres = 2 * len(self.J)
        both, other = rows[rows < centres], rows[rows >= centres] - centres
        # rows come in pairs, one for each coordinate of a centre, but for a single one at either end
        pair, place = np.unique(both // 2, return_inverse=True)
        white = (self.W[pair] @ self.J[pair])[place, both % 2]
        top = np.concatenate([white, self.more[both]], axis=1)
        bottom = np.concatenate([self.priors[other], np.zeros((len(other), self.more.shape[1]))], axis=1)
        return np.concatenate([top, bottom])


Table = Array | WhiteRows


def times(A: Table, X: Array) -> Array:
    """A X."""
    if isinstance(A, np.ndarray):
        return A @ X
    found: Array = np.empty((len(A), *X.shape[1:]))
    for p in parts(len(A)):
        found[p] = A[p] @ X
    return found


def transposed_times(A: Table, X: Array) -> Array:
    """A^T X."""
    if isinstance(A, np.ndarray):
        return A.T @ X
    found: Array = sum((A[p].T @ X[p] for p in parts(len(A))), np.zeros((A.shape[1], *X.shape[1:])))
    return found


def lengths(A: Table) -> Array:
    """(c,): the lengths of the columns."""
    if isinstance(A, np.ndarray):
        return np.asarray(np.linalg.norm(A, axis=0))
    return np.sqrt(sum(((A[p] ** 2).sum(axis=0) for p in parts(len(A))), np.zeros(A.shape[1])))
