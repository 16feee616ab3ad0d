"""The least-squares iteration of eq. (7), compiled: Levenberg-Marquardt on SO(3) x R^m, one solve or very many.

The unknowns are, in order, w_HT (3), t_HT (3), the ball centres (3 each) and the deviations `delta` of the freed
scanner parameters from their nominal values.  A freed parameter j changes column `cols[j]` of the scanner vector by
`factor[j] delta[j]`, in run `col_run[j]` or, where that is -1, in all.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numba.extending import register_jitable

from tomopose.calibration.model.ball_projection import YES, Projected, project_pose
from tomopose.least_squares import CODES
from tomopose.units import Array

CONVERGED, STALLED, OUT_OF_STEPS, SINGULAR, NO_START = range(len(CODES))
"""Places in least_squares.CODES: compiled code returns numbers."""
STEP_TOLERANCE = 1e-10
"""The iteration ends when a step is shorter than this, measured in standard deviations of the estimate."""


class Rows(NamedTuple):
    """n observed centres x (n, 2) px with whiteners W (n, 2, 2) and weights (n,) on their squares, the poses R
    (n, 3, 3), t (n, 3), alpha (n,) of the rows, and the index of each row's run and ball, (n,)."""

    x: Array
    W: Array
    weight: Array
    R: Array
    t: Array
    alpha: Array
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


class Point(NamedTuple):
    """The unknowns: R_HT (3, 3), t_HT (3,), balls t (balls, 3), deviations delta (f,) of the freed parameters."""

    R_HT: Array
    t_HT: Array
    t: Array
    delta: Array


@njit(cache=True, inline="always")
def _exp_times(w: Array, R: Array, out: Array) -> None:
    """out = exp([w]_x) R by Rodrigues' formula."""
    a2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if a2 < 1e-12:
        s, c = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        a = math.sqrt(a2)
        s, c = math.sin(a) / a, (1.0 - math.cos(a)) / a2
    for j in range(3):
        r0, r1, r2 = R[0, j], R[1, j], R[2, j]
        c0, c1, c2 = w[1] * r2 - w[2] * r1, w[2] * r0 - w[0] * r2, w[0] * r1 - w[1] * r0
        out[0, j] = r0 + s * c0 + c * (w[1] * c2 - w[2] * c1)
        out[1, j] = r1 + s * c1 + c * (w[2] * c0 - w[0] * c2)
        out[2, j] = r2 + s * c2 + c * (w[0] * c1 - w[1] * c0)


@njit(cache=True, error_model="numpy")
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
    """s (runs, 13): the scanner vectors with the freed parameters off their nominal values by delta (f,)."""
    for r in range(s.shape[0]):
        for i in range(s.shape[1]):
            s[r, i] = freed.s_0[r, i]
        for j in range(freed.cols.shape[0]):
            if freed.col_run[j] < 0 or freed.col_run[j] == r:
                s[r, freed.cols[j]] += freed.factor[j] * delta[j]


@njit(cache=True, inline="always")
def _work_space() -> Projected:
    return Projected(
        np.empty(2), np.empty(3), np.empty(3), np.empty((2, 3)), np.empty((2, 3)), np.zeros((2, 13)),
        np.empty((3, 3)), np.empty((3, 3)),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def normal_equations(rows: Rows, s: Array, freed: Freed, at: Point, N: Array, g: Array) -> float:
    """chi2 at a point, and N = J^T J and g = J^T r there (r = observed - calculated, whitened).

    s (runs, 13): scanner vectors at the point.  Infinite where a ball is behind the source.
    """
    # a tuple's array that is read in the loop costs two counts of references each time: name them before
    x_meas, W, weight, R_k, t_k, alpha, run, ball = rows
    _, cols, col_run, factor, information = freed
    R_HT, t_HT, t, delta = at
    work = _work_space()
    x, _, y_T, G_H, G_T, J_s, _, _ = work
    n, n_b, n_f = x_meas.shape[0], t.shape[0], cols.shape[0]
    w = 9 + n_f
    a, b, where = np.empty(w), np.empty(w), np.empty(w, dtype=np.int64)
    chi2 = 0.0
    N[:] = 0.0
    g[:] = 0.0
    for i in range(6):
        where[i] = i
    for j in range(n_f):
        where[9 + j] = 6 + 3 * n_b + j
    for k in range(n):
        if weight[k] == 0.0:
            continue
        if not project_pose(s[run[k]], R_HT, t_HT, R_k[k], t_k[k], t[ball[k]], alpha[k], YES, work):
            return np.inf
        du, dv = x_meas[k, 0] - x[0], x_meas[k, 1] - x[1]
        r0 = W[k, 0, 0] * du + W[k, 0, 1] * dv
        r1 = W[k, 1, 0] * du + W[k, 1, 1] * dv
        chi2 += weight[k] * (r0 * r0 + r1 * r1)
        for e in range(2):
            c = a if e == 0 else b
            c[0] = y_T[1] * G_T[e, 2] - y_T[2] * G_T[e, 1]
            c[1] = y_T[2] * G_T[e, 0] - y_T[0] * G_T[e, 2]
            c[2] = y_T[0] * G_T[e, 1] - y_T[1] * G_T[e, 0]
            for i in range(3):
                c[3 + i] = G_T[e, i]
                c[6 + i] = G_H[e, 0] * R_k[k, 0, i] + G_H[e, 1] * R_k[k, 1, i] + G_H[e, 2] * R_k[k, 2, i]
            for j in range(n_f):
                c[9 + j] = J_s[e, cols[j]] * factor[j] if col_run[j] < 0 or col_run[j] == run[k] else 0.0
        for i in range(3):
            where[6 + i] = 6 + 3 * ball[k] + i
        for i in range(w):
            u, v = a[i], b[i]
            a[i] = W[k, 0, 0] * u + W[k, 0, 1] * v
            b[i] = W[k, 1, 0] * u + W[k, 1, 1] * v
        for i in range(w):
            p, q, wi = weight[k] * a[i], weight[k] * b[i], where[i]
            g[wi] += p * r0 + q * r1
            if n_b == 1:  # every unknown is at its own place: the same sums, written without a detour
                for j in range(i + 1):
                    N[i, j] += p * a[j] + q * b[j]
            else:
                for j in range(i + 1):
                    N[wi, where[j]] += p * a[j] + q * b[j]
    for j in range(n_f):
        chi2 += information[j] * delta[j] * delta[j]
        g[6 + 3 * n_b + j] -= information[j] * delta[j]
        N[6 + 3 * n_b + j, 6 + 3 * n_b + j] += information[j]
    for i in range(g.shape[0]):
        for j in range(i):
            N[j, i] = N[i, j]
    return chi2


@njit(cache=True, error_model="numpy")
def _moved(freed: Freed, at: Point, step: Array, to: Point, s: Array) -> None:
    """The point after a step, written into `to`, and its scanner vectors s."""
    n_b = at.t.shape[0]
    _exp_times(step, at.R_HT, to.R_HT)
    for i in range(3):
        to.t_HT[i] = at.t_HT[i] + step[3 + i]
        for j in range(n_b):
            to.t[j, i] = at.t[j, i] + step[6 + 3 * j + i]
    for j in range(at.delta.shape[0]):
        to.delta[j] = at.delta[j] + step[6 + 3 * n_b + j]
    scanner_vectors(freed, to.delta, s)


@register_jitable
def levenberg_marquardt(rows: Rows, freed: Freed, at: Point, iterations: int) -> tuple[float, int, Point, Array]:
    """Minimise chi2 from the point `at`, which is overwritten.

    One solve runs it in Python, where only what loops over rows or unknowns is compiled; `solve_batch` compiles it.
    Returns (chi2, status, the optimum, N = J^T J there).
    """
    m = 6 + 3 * at.t.shape[0] + at.delta.shape[0]
    g, step, L = np.zeros(m), np.zeros(m), np.zeros((m, m))
    N, g_new, N_new = np.zeros((m, m)), np.zeros(m), np.zeros((m, m))
    trial = Point(at.R_HT.copy(), at.t_HT.copy(), at.t.copy(), at.delta.copy())
    s = freed.s_0.copy()
    scanner_vectors(freed, at.delta, s)
    chi2 = normal_equations(rows, s, freed, at, N, g)
    if not chi2 < np.inf:
        return np.inf, NO_START, at, N
    lam, grow = 1e-4, 2.0
    for _ in range(iterations):
        gain, length = _step(N, lam, g, L, step)
        if not gain > -np.inf:
            lam = max(lam, 1e-8) * 10.0
            if lam > 1e8:
                return chi2, SINGULAR, at, N
            continue
        _moved(freed, at, step, trial, s)
        chi2_new = normal_equations(rows, s, freed, trial, N_new, g_new)
        small = length < STEP_TOLERANCE * STEP_TOLERANCE
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
            # at the floor of rounding a step no longer lowers chi2: that is the optimum too
            if length < 1e-12 * max(chi2, 1e-6) or length < 1e-14:
                return chi2, CONVERGED, at, N
            lam *= grow
            grow *= 2.0
            if lam > 1e12:
                return chi2, STALLED, at, N
    return chi2, OUT_OF_STEPS, at, N


@njit(cache=True)
def _log_rotation(D: Array, out: Array) -> None:
    """Rotation vector of D, angles below pi."""
    c = min(max((D[0, 0] + D[1, 1] + D[2, 2] - 1.0) / 2.0, -1.0), 1.0)
    v0, v1, v2 = (D[2, 1] - D[1, 2]) / 2.0, (D[0, 2] - D[2, 0]) / 2.0, (D[1, 0] - D[0, 1]) / 2.0
    sine = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    f = 1.0 + sine * sine / 6.0 if sine < 1e-4 and c > 0 else math.atan2(sine, c) / sine
    out[0], out[1], out[2] = f * v0, f * v1, f * v2


@njit(cache=True)
def _solve_one(
    rows: Rows, freed: Freed, centre: Array, start: Point, iterations: int, theta: Array
) -> tuple[float, int]:
    """One solve from a start with the priors centred at `centre` (f,), its result written into theta (m,)."""
    n_b, n_f = start.t.shape[0], centre.shape[0]
    at = Point(start.R_HT.copy(), start.t_HT.copy(), start.t.copy(), start.delta - centre)
    s = freed.s_0.copy()
    scanner_vectors(freed, centre, s)
    shifted = Freed(s, freed.cols, freed.col_run, freed.factor, freed.information)
    chi2, status, at, _ = levenberg_marquardt(rows, shifted, at, iterations)
    _log_rotation(at.R_HT @ start.R_HT.T, theta)
    for i in range(3):
        theta[3 + i] = at.t_HT[i]
        for j in range(n_b):
            theta[6 + 3 * j + i] = at.t[j, i]
    for j in range(n_f):
        theta[6 + 3 * n_b + j] = centre[j] + at.delta[j]
    return chi2, status


@njit(cache=True, parallel=True)
def solve_batch(
    x_all: Array, R_all: Array, t_all: Array, rows: Rows, freed: Freed, prior: Array, start: Point, iterations: int
) -> Any:
    """Many solves of one plan, from one start: x_all (b, n, 2); R_all (b or 1, n, 3, 3), t_all (b or 1, n, 3) replace
    those of `rows`.

    prior (b or 1, f): centre of the prior of delta in each solve (a Monte Carlo draws it too).
    Returns theta (b, m): w (by which R = exp(w) R_HT of the start), t_HT, t ..., delta; chi2 (b,); status (b,).
    """
    n_s = x_all.shape[0]
    m = 6 + 3 * start.t.shape[0] + freed.cols.shape[0]
    theta, chi2, status = np.empty((n_s, m)), np.empty(n_s), np.empty(n_s, dtype=np.int64)
    for b in prange(n_s):
        i, j = b % prior.shape[0], b % R_all.shape[0]
        own = Rows(x_all[b], rows.W, rows.weight, R_all[j], t_all[j], rows.alpha, rows.run, rows.ball)
        chi2[b], status[b] = _solve_one(own, freed, prior[i], start, iterations, theta[b])
    return theta, chi2, status
