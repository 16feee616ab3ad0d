r"""One effect beside a fit: what it explains of the residuals, without a refit.

With r the whitened residuals of a fit whose Jacobian (priors as rows) has the orthonormal basis Q, an effect with the
columns C (what the centres would do if it were so) explains

    gain = g^T M^+ g,    g = C^T (1 - Q Q^T) r,    M = C^T (1 - Q Q^T) C,

of chi2.  Only inner products enter, so that very long tables are replaced by the triangle R of a QR decomposition of
[A | C | r], calculated from one part of the rows after the other: its columns have the same inner products.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tomopose.calibration.model.ball_projection import ProjectionBlocks, inner
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.tall import Table, WhiteRows, is_tall, lengths, parts, times, transposed_times, triangle
from tomopose.calibration.rigid.fit import Fit, derivatives, linearised
from tomopose.kernel_cache import njit
from tomopose.units import Array

SEEN = 1e-6
"""Share of a column, and scaled eigenvalue of M, that must be left beside the fit for it to count as visible."""

RANK = 1e-9
"""Singular values of the normalised Jacobian, relative to the largest, that count as directions of the fit."""


@dataclass(frozen=True, kw_only=True)
class Whitened:
    """A fit as the tests see it: r (k,) whitened residuals and A (k, m) whitened Jacobian, priors as further rows; the
    first 2 n rows belong to the n centres."""

    r: Array
    A: Table
    n: int

    @cached_property
    def beside(self) -> Beside:
        """What the fit can follow, and what it leaves."""
        return Beside.of(self.A, self.r)

    def beside_centres(self) -> Beside:
        """The same without the priors."""
        if len(self.r) == 2 * self.n:
            return self.beside
        A = self.A[: 2 * self.n] if isinstance(self.A, np.ndarray) else replace(self.A, priors=self.A.priors[:0])
        return Beside.of(A, self.r[: 2 * self.n])

    def with_columns(self, C: Array) -> Whitened:
        """The fit that can follow the columns C (2 n, c) too."""
        if isinstance(self.A, WhiteRows):
            wider = replace(self.A, more=np.concatenate([self.A.more, C], axis=1))
            return Whitened(r=self.r, A=wider, n=self.n)
        more = np.zeros((len(self.A), C.shape[1]))
        more[: 2 * self.n] = C
        return Whitened(r=self.r, A=np.concatenate([self.A, more], axis=1), n=self.n)

    def rows(self, part: slice, C: Array) -> Array:
        """(2 k, m + c + 1): Jacobian, columns C (2 k, c) and residuals of some of the n centres."""
        two = slice(2 * part.start, 2 * part.stop)
        return np.concatenate([self.A[two], C, self.r[two, None]], axis=1)

    def priors(self, c: int) -> Array:
        """The same of the priors, which c columns leave as they are."""
        A, r = self.A[2 * self.n : len(self.A)], self.r[2 * self.n :]
        return np.concatenate([A, np.zeros((len(A), c)), r[:, None]], axis=1)


def whitened(problem: Problem, free: FreeParameters, fit: Fit, b: ProjectionBlocks) -> Whitened:
    """Residuals and Jacobian of a fit on all rows of `problem`, projected by b, the priors as rows of their own."""
    linear = linearised(problem, free, fit, b, derivatives(problem, free, b))
    return Whitened(r=linear.residuals, A=linear.rows, n=len(problem))


@dataclass(frozen=True, kw_only=True)
class Beside:
    """What a fit can follow: an orthonormal basis Q (k, q), as it is or, of very many rows, as A T with A (k, m) and
    T (m, q);  rest (k,): what the fit leaves."""

    A: Table
    T: Array | None
    rest: Array

    @classmethod
    def of(cls, A: Table, r: Array) -> Beside:
        """Of whitened rows A (k, m) and residuals r (k,)."""
        norm, k = lengths(A), len(A)
        unit = 1.0 / np.where(norm > 0, norm, 1.0)
        if isinstance(A, np.ndarray) and not is_tall(k):
            Q, R = np.linalg.qr(A * unit)
            U, s, _ = np.linalg.svd(R)
            seen = s > RANK * s[0]
            made = cls(A=Q if seen.all() else Q @ U[:, seen], T=None, rest=r)
        else:
            _, s, Vt = np.linalg.svd(triangle(A[p] * unit for p in parts(k)), full_matrices=False)
            seen = s > RANK * s[0]
            made = cls(A=A, T=unit[:, None] * (Vt[seen].T / s[seen]), rest=r)
        return cls(A=made.A, T=made.T, rest=r - made.along(r))

    @property
    def directions(self) -> int:
        return int((self.A if self.T is None else self.T).shape[1])

    @property
    def chi2(self) -> float:
        return float(self.rest @ self.rest)

    @property
    def dof(self) -> int:
        return len(self.rest) - self.directions

    def Q(self, rows: slice) -> Array:
        """(k, q): those rows of the basis."""
        return np.asarray(self.A[rows] if self.T is None else self.A[rows] @ self.T)

    def along(self, X: Array) -> Array:
        """The part of X (k,) or (k, c) that the fit can follow."""
        z = transposed_times(self.A, X)
        return times(self.A, z if self.T is None else self.T @ (self.T.T @ z))

    def without(self, C: Array) -> Array:
        """What of the columns C (j, c) of the first j rows, zero in the others, the fit cannot follow: (k, c)."""
        full: Array = np.zeros((len(self.rest), C.shape[1]))
        full[: len(C)] = C
        full -= self.along(full)
        return full


def gain_of(M: Array, g: Array) -> tuple[float, int]:
    """(g^T M^+ g, rank)."""
    if len(g) == 1:
        return (float(g[0] ** 2 / M[0, 0]), 1) if M[0, 0] > SEEN else (0.0, 0)
    value, V = np.linalg.eigh(M)
    z = V.T @ g
    seen = value > SEEN
    return float((z[seen] ** 2 / value[seen]).sum()), int(seen.sum())


def in_pixels(W: Array, v: Array) -> Array:
    """(n, 2) px: of whitened vectors v (n, 2), W (n, 2, 2) being lower triangular."""
    du = v[:, 0] / W[:, 0, 0]
    return np.column_stack([du, (v[:, 1] - W[:, 1, 0] * du) / W[:, 1, 1]])


@inner
def _one_place(M: Array, z: Array, S: Array, x: Array) -> float:
    """z^T M^-1 z by Cholesky; NaN where an eigenvalue of M (c, c), its diagonal at most 1, may be as small as SEEN: the
    trace of the inverse bounds it.  S (c, c) and x (c,) are work space."""
    c = M.shape[0]
    for i in range(c):
        for j in range(i + 1):
            v = M[i, j]
            for k in range(j):
                v -= S[i, k] * S[j, k]
            if i == j:
                if not v > SEEN:
                    return np.nan
                S[i, i] = np.sqrt(v)
            else:
                S[i, j] = v / S[j, j]
    trace, gain = 0.0, 0.0
    for column in range(c + 1):  # S^-1 of the unit vectors, then of z
        for i in range(c):
            v = z[i] if column == c else 1.0 if i == column else 0.0
            for k in range(i):
                v -= S[i, k] * x[k]
            x[i] = v / S[i, i]
            if column < c:
                trace += x[i] * x[i]
            else:
                gain += x[i] * x[i]
    return gain if trace < 1.0 / SEEN else np.nan


@njit(cache=True)
def _places(C: Array, Q: Array, r: Array, sums: tuple[Array, Array, Array], M: Array, z: Array, gain: Array) -> None:
    """gain (n,) of a step at each of n rows, from the last one back: C (n, 2, c), Q (n, 2, q), r (n, 2).

    sums: C^T C (c, c), C^T Q (c, q) and C^T r (c,) over later rows, carried on.  M (n, c, c) and z (n, c) become C^T (1
    - Q Q^T) C and C^T r, columns scaled.
    """
    A, B, g = sums
    c, q = C.shape[2], Q.shape[2]
    S, x, d = np.zeros((c, c)), np.empty(c), np.empty(c)
    for k in range(C.shape[0] - 1, -1, -1):
        for e in range(2):
            for i in range(c):
                v = C[k, e, i]
                g[i] += v * r[k, e]
                for j in range(i + 1):
                    A[i, j] += v * C[k, e, j]
                for j in range(q):
                    B[i, j] += v * Q[k, e, j]
        for i in range(c):
            d[i] = np.sqrt(max(A[i, i], 1e-300))
            z[k, i] = g[i] / d[i]
        for i in range(c):
            for j in range(i + 1):
                v = A[i, j]
                for p in range(q):
                    v -= B[i, p] * B[j, p]
                M[k, i, j] = M[k, j, i] = v / d[i] / d[j]
        gain[k] = _one_place(M[k], z[k], S, x)


def best_step(C: Array, beside: Beside, places: npt.NDArray[np.int64]) -> tuple[int, float, int]:
    """(row, gain, rank) of the place, among `places`, at which a step of the columns C (n, 2, c) explains most."""
    n, c = len(C), C.shape[2]
    gain, rank = np.empty(n), np.full(n, c)
    sums = (np.zeros((c, c)), np.zeros((c, beside.directions)), np.zeros(c))
    wanted = np.zeros(n, dtype=bool)
    wanted[places] = True
    for part in reversed(parts(n)):
        size, rows = part.stop - part.start, slice(2 * part.start, 2 * part.stop)
        Q = np.ascontiguousarray(beside.Q(rows)).reshape(size, 2, -1)
        r = np.ascontiguousarray(beside.rest[rows]).reshape(size, 2)
        M, z = np.empty((size, c, c)), np.empty((size, c))
        _places(np.ascontiguousarray(C[part]), Q, r, sums, M, z, gain[part])
        nearly = np.flatnonzero(np.isnan(gain[part]) & wanted[part])
        if len(nearly):
            value, V = np.linalg.eigh(M[nearly])
            along = np.einsum("kab,ka->kb", V, z[nearly])
            seen = value > SEEN
            gain[part.start + nearly] = np.where(seen, along**2 / np.where(seen, value, 1.0), 0.0).sum(axis=1)
            rank[part.start + nearly] = seen.sum(axis=1)
    best = int(places[gain[places].argmax()])
    return best, float(gain[best]), int(rank[best])


def step_at(C: Array, beside: Beside, k: int) -> Array:
    """(c,): the size of a step of the columns C (n, 2, c) at row k; directions that are not seen are left at zero."""
    c = C.shape[2]
    M, g, B = np.zeros((c, c)), np.zeros(c), np.zeros((beside.directions, c))
    for part in parts(len(C)):
        late = slice(max(part.start, k), part.stop)
        if late.start < late.stop:
            some, rows = C[late].reshape(-1, c), slice(2 * late.start, 2 * late.stop)
            M += some.T @ some
            g += some.T @ beside.rest[rows]
            B += beside.Q(rows).T @ some
    return np.asarray(np.linalg.lstsq(M - B.T @ B, g, rcond=1e-8)[0])
