"""The least-squares iteration of eq. (7), compiled: Levenberg-Marquardt on SO(3) x R^m, one solve or very many.

The unknowns are, in order, w_HT (3), t_HT (3), the ball centres (3 each) and the deviations `delta` of the freed
scanner parameters from their nominal values.  A freed parameter j changes column `cols[j]` of the scanner vector by
`factor[j] delta[j]`, in run `col_run[j]` or, where that is -1, in all.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numba.extending import register_jitable

from tomopose.calibration.model.ball_projection import (
    EVERYTHING,
    G_H,
    G_T,
    J_S,
    J_W,
    MOVES,
    PROJECTED,
    VIEW,
    X,
    inner,
    project_pose,
    view_of,
)
from tomopose.kernel_cache import njit
from tomopose.least_squares import CODES
from tomopose.units import Array

CONVERGED, STALLED, OUT_OF_STEPS, SINGULAR, NO_START = range(len(CODES))
"""Places in least_squares.CODES: compiled code returns numbers."""
STEP_TOLERANCE = 1e-10
"""The iteration ends when a step is shorter than this, measured in standard deviations of the estimate."""


DAMPING, NEAR_DAMPING = 1e-4, 1e-9
"""Of the first step from anywhere, and from the optimum of a problem that is nearly the same: directions that the data
hardly show are followed from the second step on, not from the sixth."""


class Rows(NamedTuple):
    """n observed centres x (n, 2) px with whiteners W (n, 2, 2) and weights (n,) on their squares, the poses (n, 14) of
    the rows as of `poses_of`, and the index of each row's run and ball, (n,)."""

    x: Array
    W: Array
    weight: Array
    poses: Array
    run: Any
    ball: Any


class Freed(NamedTuple):
    """Scanner vectors s_0 (runs, 13) at nominal values, and where the f freed parameters act: cols, col_run, factor
    (f,); information (f,) is 1/sigma^2 of their priors."""

    s_0: Array
    cols: Any
    col_run: Any
    factor: Array
    information: Array


@inner
def _turned(w: Array, R: Array, out: Array) -> None:
    """The first nine numbers of `out`: exp([w]_x) R by Rodrigues' formula, w and R being the first of theirs."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if a2 < 1e-12:
        s, c = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        a = math.sqrt(a2)
        s, c = math.sin(a) / a, (1.0 - math.cos(a)) / a2
    for j in range(3):
        r0, r1, r2 = R[j], R[3 + j], R[6 + j]
        c0, c1, c2 = w[1] * r2 - w[2] * r1, w[2] * r0 - w[0] * r2, w[0] * r1 - w[1] * r0
        out[j] = r0 + s * c0 + c * (w[1] * c2 - w[2] * c1)
        out[3 + j] = r1 + s * c1 + c * (w[2] * c0 - w[0] * c2)
        out[6 + j] = r2 + s * c2 + c * (w[0] * c1 - w[1] * c0)


@inner
def _step(N: Array, lam: float, g: Array, L: Array, step: Array) -> tuple[float, float]:
    """step = (N + lam diag N)^-1 g by Cholesky.

    Returns (what chi2 falls by in the quadratic model, step^T g, which for lam -> 0 is step^T N step); -inf and 0 where
    the matrix is not positive definite.
    """
    m = g.shape[0]
    gain, length = 0.0, 0.0
    for i in range(m):
        for j in range(i + 1):
            v = N[i, j]
            if i == j:
                v += lam * N[i, i]
            for k in range(j):
                v -= L[i, k] * L[j, k]
            if i == j:
                if not v > 1e-13 * N[i, i]:
                    return -np.inf, 0.0
                L[i, i] = math.sqrt(v)
            else:
                L[i, j] = v / L[j, j]
    for i in range(m):
        v = g[i]
        for k in range(i):
            v -= L[i, k] * step[k]
        step[i] = v / L[i, i]
    for i in range(m - 1, -1, -1):
        v = step[i]
        for k in range(i + 1, m):
            v -= L[k, i] * step[k]
        step[i] = v / L[i, i]
        length += step[i] * g[i]
        gain += step[i] * (g[i] + lam * N[i, i] * step[i])
    return gain, length


@register_jitable
def scanner_vectors(freed: Freed, delta: Array, s: Array) -> None:
    """The first 13 columns of s (runs, 13 or more): scanner vectors, the freed parameters off their nominal values by
    the last f numbers of `delta`."""
    f = freed.cols.shape[0]
    for r in range(s.shape[0]):
        for i in range(freed.s_0.shape[1]):
            s[r, i] = freed.s_0[r, i]
        for j in range(f):
            if freed.col_run[j] < 0 or freed.col_run[j] == r:
                s[r, freed.cols[j]] += freed.factor[j] * delta[delta.shape[0] - f + j]


TOGETHER = 64
"""Rows whose products are summed together."""


@inner
def add_products(A: Array, B: Array, n: int, N: Array) -> None:
    """Add those of the first n rows to the lower triangle of N (m, m): A^T A + B^T B, A and B (k, m).

    The rows are written before their products are summed: then the sums over j are vector instructions.
    """
    for k in range(n):
        for i in range(N.shape[0]):
            a, b = A[k, i], B[k, i]
            for j in range(i + 1):
                N[i, j] += a * A[k, j] + b * B[k, j]


@inner
def take_row(A: Array, B: Array, row: int, where: Any, N: Array) -> int:
    """Take the products of a row of A and B (TOGETHER, w) into N (m, m), or let it wait; the place of the next row.

    where (w,): the unknowns that the row's columns belong to.  Where these are all unknowns in turn, rows wait until
    TOGETHER of them are there, and the last ones for `add_products`; else a row is added as it comes, from place 0.
    """
    if N.shape[0] == A.shape[1]:
        if row + 1 < TOGETHER:
            return row + 1
        add_products(A, B, TOGETHER, N)
        return 0
    for i in range(A.shape[1]):
        for j in range(i + 1):
            N[where[i], where[j]] += A[0, i] * A[0, j] + B[0, i] * B[0, j]
    return 0


@njit(cache=True)
def normal_equations(rows: Rows, freed: Freed, at: Array, N: Array, g: Array) -> float:
    """chi2 at a point, and N = J^T J and g = J^T r there (r = observed - calculated, whitened).

    Infinite where a ball is behind the source.
    """
    # a tuple's array that is read in the loop costs two counts of references each time: name them before
    x_meas, W, weight, poses, run, ball = rows
    s_0, cols, col_run, factor, information = freed
    n, m, n_f = x_meas.shape[0], g.shape[0], cols.shape[0]
    free_from = m - n_f
    w = 9 + n_f
    A, B, where = np.empty((TOGETHER, w)), np.empty((TOGETHER, w)), np.empty(w, dtype=np.int64)
    out = np.zeros(PROJECTED)
    wanted = EVERYTHING if n_f > 0 else MOVES
    views = np.empty((s_0.shape[0], VIEW))
    scanner_vectors(freed, at, views)
    for r in range(views.shape[0]):
        view_of(views, r)
    chi2, row = 0.0, 0
    N[:] = 0.0
    g[:] = 0.0
    for i in range(6):
        where[i] = i
    for j in range(n_f):
        where[9 + j] = free_from + j
    for k in range(n):
        if weight[k] == 0.0:
            continue
        if not project_pose(views, at, poses, (run[k], k, ball[k]), wanted, out):
            return np.inf
        du, dv = x_meas[k, 0] - out[X], x_meas[k, 1] - out[X + 1]
        root = math.sqrt(weight[k])
        w00, w01, w10, w11 = root * W[k, 0, 0], root * W[k, 0, 1], root * W[k, 1, 0], root * W[k, 1, 1]
        r0, r1 = w00 * du + w01 * dv, w10 * du + w11 * dv
        chi2 += r0 * r0 + r1 * r1
        for e in range(2):
            C = A if e == 0 else B
            H, J = G_H + 3 * e, J_S + 13 * e
            for i in range(3):
                C[row, i], C[row, 3 + i] = out[J_W + 3 * e + i], out[G_T + 3 * e + i]
                C[row, 6 + i] = out[H] * poses[k, i] + out[H + 1] * poses[k, 3 + i] + out[H + 2] * poses[k, 6 + i]
            for j in range(n_f):
                C[row, 9 + j] = out[J + cols[j]] * factor[j] if col_run[j] < 0 or col_run[j] == run[k] else 0.0
        for i in range(3):
            where[6 + i] = 6 + 3 * ball[k] + i
        for i in range(w):
            u, v = A[row, i], B[row, i]
            A[row, i], B[row, i] = w00 * u + w01 * v, w10 * u + w11 * v
            g[where[i]] += A[row, i] * r0 + B[row, i] * r1
        row = take_row(A, B, row, where, N)
    add_products(A, B, row, N)
    for j in range(n_f):
        delta, i = at[at.shape[0] - n_f + j], free_from + j
        chi2 += information[j] * delta * delta
        g[i] -= information[j] * delta
        N[i, i] += information[j]
    for i in range(m):
        for j in range(i):
            N[j, i] = N[i, j]
    return chi2


@njit(cache=True)
def _attempt(
    rows: Rows, freed: Freed, at: Array, N: Array, g: Array, lam: float, to: Array, N_to: Array, g_to: Array
) -> tuple[float, float, float]:
    """One step from a point `at` with N and g there, written into `to`, with N_to and g_to there.

    Returns what `_step` does, and chi2 after the step.
    """
    m = g.shape[0]
    step = np.empty(m)
    gain, length = _step(N, lam, g, np.empty((m, m)), step)
    if not gain > -np.inf:
        return gain, length, np.inf
    _turned(step, at, to)
    for i in range(3, m):  # w_HT (3) moves R_HT (9)
        to[6 + i] = at[6 + i] + step[i]
    return gain, length, normal_equations(rows, freed, to, N_to, g_to)


@register_jitable
def levenberg_marquardt(
    rows: Rows, freed: Freed, at: Array, iterations: int, damping: float, tolerance: float
) -> tuple[float, int, Array, Array]:
    """Minimise chi2 from the point `at` (R_HT by rows, t_HT, balls, delta), which is overwritten.

    damping: of the first step;  tolerance: the iteration ends with a step that is shorter, in standard deviations.

    One solve runs it in Python, where only what loops over rows or unknowns is compiled; `solve_batch` compiles it.
    Returns (chi2, status, the optimum, N = J^T J there).
    """
    m = at.shape[0] - 6
    N, g, N_new, g_new = np.empty((m, m)), np.empty(m), np.empty((m, m)), np.empty(m)
    trial = at.copy()
    chi2 = normal_equations(rows, freed, at, N, g)
    if not chi2 < np.inf:
        return np.inf, NO_START, at, N
    lam, grow = damping, 2.0
    for _ in range(iterations):
        gain, length, chi2_new = _attempt(rows, freed, at, N, g, lam, trial, N_new, g_new)
        if not gain > -np.inf:
            lam = max(lam, 1e-8) * 10.0
            if lam > 1e8:
                return chi2, SINGULAR, at, N
            continue
        small = length < tolerance * tolerance
        if chi2_new < chi2 or (small and chi2_new < np.inf) or chi2_new == chi2:
            ratio = (chi2 - chi2_new) / gain if gain > 0 else 1.0
            at, trial, N, N_new, g, g_new = trial, at, N_new, N, g_new, g
            chi2 = chi2_new
            if small and lam < 1e-3:
                return chi2, CONVERGED, at, N
            cut = 1.0 - (2.0 * ratio - 1.0) ** 3
            lam = max(lam * min(max(cut, 0.02), 1.0), 1e-15)
            grow = 2.0
        else:
            # at the floor of rounding a step no longer lowers chi2: the gradient, which is more exact, is followed
            if length < 1e-12 * max(chi2, 1e-6) or length < 1e-14:
                return (chi2, CONVERGED, trial, N_new) if chi2_new < np.inf else (chi2, CONVERGED, at, N)
            lam *= grow
            grow *= 2.0
            if lam > 1e12:
                return chi2, STALLED, at, N
    return chi2, OUT_OF_STEPS, at, N


@inner
def _log_rotation(D: Array, out: Array) -> None:
    """Rotation vector of D, angles below pi."""
    c = min(max((D[0, 0] + D[1, 1] + D[2, 2] - 1.0) / 2.0, -1.0), 1.0)
    v0, v1, v2 = (D[2, 1] - D[1, 2]) / 2.0, (D[0, 2] - D[2, 0]) / 2.0, (D[1, 0] - D[0, 1]) / 2.0
    sine = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    f = 1.0 + sine * sine / 6.0 if sine < 1e-4 and c > 0 else math.atan2(sine, c) / sine
    out[0], out[1], out[2] = f * v0, f * v1, f * v2


@inner
def _solve_one(
    rows: Rows, freed: Freed, centre: Array, start: Array, iterations: int, theta: Array
) -> tuple[float, int]:
    """One solve from a start with the priors centred at `centre` (f,), its result written into theta (m,)."""
    n_f, at = centre.shape[0], start.copy()
    held = theta.shape[0] - n_f
    s = freed.s_0.copy()
    scanner_vectors(freed, centre, s)
    shifted = Freed(s, freed.cols, freed.col_run, freed.factor, freed.information)
    for j in range(n_f):
        at[6 + held + j] -= centre[j]
    chi2, status, at, _ = levenberg_marquardt(rows, shifted, at, iterations, DAMPING, STEP_TOLERANCE)
    _log_rotation(at[:9].reshape(3, 3) @ start[:9].reshape(3, 3).T, theta)
    for i in range(3, held):
        theta[i] = at[6 + i]
    for j in range(n_f):
        theta[held + j] = centre[j] + at[6 + held + j]
    return chi2, status


@njit(cache=True, parallel=True)
def solve_batch(
    x_all: Array, poses: Array, rows: Rows, freed: Freed, prior: Array, start: Array, iterations: int
) -> Any:
    """Many solves of one plan, from one start: x_all (b, n, 2) and poses (b or 1, n, 14) replace those of `rows`.

    prior (b or 1, f): centre of the prior of delta in each solve (a Monte Carlo draws it too).
    Returns theta (b, m): w (by which R = exp(w) R_HT of the start), t_HT, t ..., delta; chi2 (b,); status (b,).
    """
    n_s = x_all.shape[0]
    theta, chi2, status = np.empty((n_s, start.shape[0] - 6)), np.empty(n_s), np.empty(n_s, dtype=np.int64)
    for b in prange(n_s):
        i, j = b % prior.shape[0], b % poses.shape[0]
        own = Rows(x_all[b], rows.W, rows.weight, poses[j], rows.run, rows.ball)
        chi2[b], status[b] = _solve_one(own, freed, prior[i], start, iterations, theta[b])
    return theta, chi2, status
