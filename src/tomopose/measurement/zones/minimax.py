"""The least greatest of many smooth functions: min over q of max over i of f_i(q), with a certificate.

Sequential quadratic programming: each step solves

    min  t + s' H s / 2      with  f_i + g_i' s <= t  for all i

exactly by an active-set method, with H the Hessian of the Lagrangian sum of lambda_i f_i made positive definite
(Nocedal and Wright, Numerical Optimization, 2nd ed., 2006, ch. 16.5 and 18).  At the end Newton's method on the
conditions of Karush, Kuhn and Tucker for the active functions removes what rounding left.  These conditions are the
certificate: with multipliers lambda_i >= 0 of sum 1, sum of lambda_i g_i = 0; where fewer functions are active than fix
the point alone, the Hessian must be positive in the directions that they leave free.  Both together prove a local
minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tomopose.units import Array

Functions = Callable[[Array], tuple[Array, Array]]
"""q (k,) -> values (m,) and derivatives (m, k)."""
STEPS, EXCHANGES, POLISH = 200, 300, 12
DIFFERENCE = 1e-5
"""Step of the central differences of the derivatives: their error of about 1e-10 slows Newton's method by nothing."""
ROUNDING = 2e-15
"""Change that rounding makes in functions and coordinates of size about 1."""
FEASIBLE = 1e-12
STATIONARY = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Minimax:
    """q (k,);  value: the greatest function there;  active: indices of functions with a positive multiplier;
    multipliers: theirs;  stationarity: |sum of lambda_i g_i|;  curvature: least eigenvalue of the Lagrangian's Hessian
    in the directions that the active functions leave free, inf where they leave none."""

    q: Array
    value: float
    active: tuple[int, ...]
    multipliers: Array
    stationarity: float
    curvature: float

    @property
    def optimal(self) -> bool:
        """Whether the certificate holds."""
        return bool(self.stationarity < STATIONARY and self.curvature > 0 and (self.multipliers >= 0).all())


def minimise_greatest(functions: Functions, start: Array) -> Minimax:
    """A local minimum of the greatest function, from `start` (k,)."""
    q = np.array(start, dtype=np.float64)
    f, G = functions(q)
    damping, hessian = 1.0, np.zeros((len(q), len(q)))
    active, multipliers = np.array([int(np.argmax(f))]), np.ones(1)
    for _ in range(STEPS):
        s, t, active, multipliers = _step(f, G, hessian + damping * np.eye(len(q)))
        promised = float(f.max()) - t
        if promised < ROUNDING or np.abs(s).max() < ROUNDING:
            break
        f_new, G_new = functions(q + s)
        gained = float(f.max() - f_new.max())
        if gained <= 0.05 * promised:
            if promised < 1e3 * ROUNDING or damping > 1e12:
                break
            damping = max(10 * damping, 1e-6)
            continue
        q, f, G = q + s, f_new, G_new
        damping = damping / 10 if gained > 0.5 * promised else damping * 2
        if damping < 1e-10:
            damping = 0.0 if len(active) == len(q) + 1 else 1e-10
        hessian = _positive(_hessian(functions, q, active, multipliers))
    return _certified(functions, q, active, multipliers)


def _step(f: Array, G: Array, H: Array) -> tuple[Array, float, np.ndarray, Array]:
    """Step s (k,), bound t, active functions and their multipliers of the quadratic program."""
    k = G.shape[1]
    H = H + 1e-14 * np.eye(k)
    s, t = np.zeros(k), float(f.max())
    work = [int(np.argmax(f))]
    multipliers = np.ones(1)
    for _ in range(EXCHANGES):
        goal, t_goal, multipliers = _equalities(f, G, H, work)
        ds, dt = goal - s, t_goal - t
        rate = G @ ds - dt
        rate[work] = 0.0
        blocking = np.flatnonzero(rate > 1e-14)
        room = np.maximum(t - f[blocking] - G[blocking] @ s, 0.0) / rate[blocking]
        first = int(np.argmin(room)) if blocking.size else -1
        if first >= 0 and room[first] < 1.0 and len(work) <= k:
            s, t = s + room[first] * ds, t + room[first] * dt
            work.append(int(blocking[first]))
            continue
        s, t = goal, t_goal
        if multipliers.min() >= -1e-12 or len(work) == 1:
            break
        work.pop(int(np.argmin(multipliers)))
    positive = multipliers > 0
    return s, t, np.array(work)[positive], multipliers[positive] / multipliers[positive].sum()


def _equalities(f: Array, G: Array, H: Array, work: list[int]) -> tuple[Array, float, Array]:
    """The quadratic program with the functions `work` equal to t."""
    k, m = G.shape[1], len(work)
    A = np.zeros((k + 1 + m, k + 1 + m))
    A[:k, :k] = H
    A[:k, k + 1 :] = G[work].T
    A[k, k + 1 :] = -1.0
    A[k + 1 :, :k] = G[work]
    A[k + 1 :, k] = -1.0
    b = np.concatenate([np.zeros(k), [-1.0], -f[work]])
    try:
        x = np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        x = np.linalg.lstsq(A, b, rcond=None)[0]
    return x[:k], float(x[k]), x[k + 1 :]


def _hessian(functions: Functions, q: Array, active: np.ndarray, multipliers: Array) -> Array:
    """(k, k) of the sum of multipliers times functions, by central differences of the derivatives."""
    k = len(q)
    H = np.zeros((k, k))
    for i in range(k):
        step = np.zeros(k)
        step[i] = DIFFERENCE
        above, below = functions(q + step)[1][active], functions(q - step)[1][active]
        H[i] = multipliers @ (above - below) / (2 * DIFFERENCE)
    return np.asarray(0.5 * (H + H.T))


def _positive(H: Array) -> Array:
    values, vectors = np.linalg.eigh(H)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _certified(functions: Functions, q: Array, active: np.ndarray, multipliers: Array) -> Minimax:
    """The conditions for a minimum after Newton's method on them, which is kept where it stays feasible."""
    best = _judged(functions, q, active, multipliers)
    k, x, weight = len(q), q.copy(), multipliers.copy()
    f, G = functions(x)
    t = float(f[active].max())
    for _ in range(POLISH):
        m = len(active)
        A = np.zeros((k + 1 + m, k + 1 + m))
        A[:k, :k] = _hessian(functions, x, active, weight)
        A[:k, k + 1 :], A[k, k + 1 :] = G[active].T, -1.0
        A[k + 1 :, :k], A[k + 1 :, k] = G[active], -1.0
        wrong = np.concatenate([G[active].T @ weight, [1.0 - weight.sum()], f[active] - t])
        step = np.linalg.lstsq(A, -wrong, rcond=1e-13)[0]
        x, t, weight = x + step[:k], t + float(step[k]), weight + step[k + 1 :]
        f, G = functions(x)
        if not np.isfinite(f).all() or float(f.max()) > best.value + 1e-6:
            return best
        if np.abs(step[:k]).max() < 1e-15:
            break
    polished = _judged(functions, x, active, weight)
    feasible = polished.value <= best.value + FEASIBLE and (weight > -1e-9).all()
    return polished if feasible and polished.stationarity <= best.stationarity else best


def _judged(functions: Functions, q: Array, active: np.ndarray, multipliers: Array) -> Minimax:
    f, G = functions(q)
    g = G[active]
    H = _hessian(functions, q, active, multipliers)
    # Directions along which no active function changes against the others.
    _, values, vectors = np.linalg.svd(g - multipliers @ g)
    free = vectors[np.count_nonzero(values > 1e-9) :]
    curvature = float(np.linalg.eigvalsh(free @ H @ free.T).min()) if len(free) else np.inf
    return Minimax(
        q=q,
        value=float(f.max()),
        active=tuple(int(i) for i in active),
        multipliers=np.maximum(multipliers, 0.0),
        stationarity=float(np.linalg.norm(multipliers @ g)),
        curvature=curvature,
    )
