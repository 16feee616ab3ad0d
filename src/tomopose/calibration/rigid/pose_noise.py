r"""Pose noise apart from detection noise: the posterior of the manipulator's scatter, never tested to zero.

The covariance of a centre is V_k = C_k + s_t^2 G_k G_k^T + s_w^2 L_k L_k^T: detection, and scatter of the manipulator
in translation (G_k = dx/dx_H) and in rotation (L_k = -G_k [x_H - s t_MH]_x: the ball's lever about the moved plate's
origin).  Given s_t and s_w, the residuals r of a fit with Jacobian J, priors with information P^-1 and deviations d
have the restricted likelihood (Patterson and Thompson, Biometrika 58 (1971) 545)

    -2 log L = sum log det V_k + log det N + r^T V^-1 r + d^T P^-1 d - g^T N^-1 g,
    N = J^T V^-1 J + P^-1,    g = J^T V^-1 r - P^-1 d.

The prior of s_t and s_w is 1 / ((0.1 + s / s_maker) (1 + (s / s_maker)^2)^2): a machine may be better than its data
sheet, and the tail lets the data overrule it.  What is stated is the root of the posterior mean of s^2: scatter that
the residuals leave room for counts, whether it is significant or not.  Backlash and periodic errors of drives, which
one ball cannot distinguish from scatter, are within it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.calibration.model.ball_projection import ProjectionBlocks
from tomopose.calibration.model.tall import ByBall
from tomopose.calibration.rigid.kernel import TOGETHER, add_products, take_row
from tomopose.geometry.rotations import skew
from tomopose.kernel_cache import njit
from tomopose.manipulator.real_poses import Repeatability
from tomopose.units import Array

WORTH_IT = 9.2
"""-2 log L must fall by this much (1 % of chi2 with 2 degrees of freedom) before scatter is called found; below it the
numbers are upper limits."""

STEPS = 8
"""Values of each scatter that the posterior is summed over, from 0 on; flat from 7 to 16 within 3 % of the result
(benchmarks/reality)."""


BEST_MACHINE = 0.1
"""Part of the maker's repeatability down to which every size of the scatter is alike likely: makers state limits.  With
0.2 clean runs state a tenth more, with 0.05 a scatter of 12 urad is stated as 7 (benchmarks/reality)."""

WIDE = 8.0
"""Times the scatter that equals detection noise: beyond it the grid is laid about the likeliest value."""


@dataclass(frozen=True, kw_only=True)
class PoseNoise:
    """Standard deviations of a pose's scatter, a coordinate each: translation (mm) and rotation (rad).

    gain: how much -2 log L falls against detection noise alone; 0 where the values were given, not estimated.
    found: the residuals show it; else the numbers are what they leave room for.
    """

    translation: float
    rotation: float
    gain: float = 0.0
    found: bool = True


def pose_spread(b: ProjectionBlocks) -> tuple[Array, Array]:
    """(n, 2, 2) each: what 1 mm and 1 rad of pose noise add to the covariance of a centre, px^2."""
    lever = (b.R_MH @ b.t[:, :, None])[..., 0]
    L = b.G_H @ skew(lever)
    return b.G_H @ np.swapaxes(b.G_H, 1, 2), L @ np.swapaxes(L, 1, 2)


def total_covariance(covariance: Array, b: ProjectionBlocks, noise: PoseNoise) -> Array:
    """V (n, 2, 2) px^2 of detection and pose noise together."""
    A, B = pose_spread(b)
    return covariance + noise.translation**2 * A + noise.rotation**2 * B


@njit(cache=True)
def _minus_2_log_likelihood(
    C: Array,
    A: Array,
    B: Array,
    J: Array,
    ball: Any,
    r: Array,
    information: Array,
    pull: Array,
    s_t: float,
    s_w: float,
) -> float:
    """See the module; J (n, 2, w), information (m,) of the priors, pull (m,) = P^-1 d.

    Columns 6 to 8 of J belong to the row's own ball (n,) where w < m; the other w - 9 follow those of all balls.
    """
    n, w, m = J.shape[0], J.shape[2], information.shape[0]
    where = np.arange(w)
    for i in range(9, w):
        where[i] = m - w + i
    N, g = np.zeros((m, m)), np.zeros(m)
    total = 0.0
    a, b = s_t * s_t, s_w * s_w
    P, Q = np.empty((TOGETHER, w)), np.empty((TOGETHER, w))
    row = 0
    for k in range(n):
        v00 = C[k, 0, 0] + a * A[k, 0, 0] + b * B[k, 0, 0]
        v01 = C[k, 0, 1] + a * A[k, 0, 1] + b * B[k, 0, 1]
        v11 = C[k, 1, 1] + a * A[k, 1, 1] + b * B[k, 1, 1]
        i00 = 1.0 / math.sqrt(v00)
        l10 = v01 * i00
        i11 = 1.0 / math.sqrt(v11 - l10 * l10)
        total -= 2.0 * math.log(i00 * i11)
        x = r[k, 0] * i00
        y = (r[k, 1] - l10 * x) * i11
        total += x * x + y * y
        if w < m:
            for i in range(3):
                where[6 + i] = 6 + 3 * ball[k] + i
        for i in range(w):
            P[row, i] = J[k, 0, i] * i00
            Q[row, i] = (J[k, 1, i] - l10 * P[row, i]) * i11
            g[where[i]] += P[row, i] * x + Q[row, i] * y
        row = take_row(P, Q, row, where, N)
    add_products(P, Q, row, N)
    for i in range(m):
        N[i, i] += information[i]
        g[i] -= pull[i]
    # Cholesky of N, its log determinant and g^T N^-1 g in one pass
    for i in range(m):
        for j in range(i + 1):
            v = N[i, j]
            for k in range(j):
                v -= N[i, k] * N[j, k]
            if i == j:
                N[i, i] = math.sqrt(max(v, 1e-300))
            else:
                N[i, j] = v / N[j, j]
        v = g[i]
        for k in range(i):
            v -= N[i, k] * g[k]
        g[i] = v / N[i, i]
        total += 2.0 * math.log(N[i, i]) - g[i] * g[i]
    return total


def _grid(unit: float, most: float) -> Array:
    """Values of a scatter from 0 to `most` times its unit, closer where they are small."""
    return np.asarray(unit * np.concatenate([[0.0], np.geomspace(0.08, most, STEPS - 1)]))


def _own_columns(J: Array | ByBall) -> tuple[Array, Any, Array, Any]:
    """J (n, 2, w) of the columns that a row may answer to, ball (n,) of each row, the squares of all columns (m,), and
    where those w of a row are among them, (w,) or (n, 1, w)."""
    if not isinstance(J, ByBall):
        return J, np.zeros(len(J), dtype=np.int64), np.einsum("nim,nim->m", J, J), np.arange(J.shape[2])
    n, m = len(J), J.shape[2]
    own = np.concatenate([J.w_HT, J.t_HT, J.own, J.freed], axis=2)
    where = np.broadcast_to(np.r_[:9, 6 + 3 * J.balls : m], (n, own.shape[2])).copy()
    where[:, 6:9] += 3 * J.ball[:, None]
    squares: Array = np.bincount(where.ravel(), weights=(own**2).sum(axis=1).ravel(), minlength=m).astype(np.float64)
    return own, J.ball, squares, where[:, None, :]


def estimate_pose_noise(
    covariance: Array,
    b: ProjectionBlocks,
    J: Array | ByBall,
    r: Array,
    *,
    information: Array | None = None,
    deviation: Array | None = None,
    maker: Repeatability | None = None,
) -> PoseNoise:
    """The posterior of the scatter from residuals r (n, 2) px of a fit with Jacobian J (n, 2, m).

    information, deviation (m,): of the priors, and how far the fit lies from their centres; maker: the repeatability
    that the prior is made of (default: that of the paper's hexapod).
    """
    maker = Repeatability() if maker is None else maker
    m = J.shape[2]
    known = np.zeros(m) if information is None else np.asarray(information, dtype=np.float64)
    pull = np.zeros(m) if deviation is None else known * deviation
    A, B = pose_spread(b)
    J, ball, squares, where = _own_columns(J)
    scale = 1.0 / np.sqrt(np.maximum(squares + known, 1e-300))
    given = (covariance, A, B, J * scale[where], ball, r, known * scale**2, pull * scale)
    arrays = tuple(np.ascontiguousarray(v) for v in given)

    def objective(s_t: float, s_w: float) -> float:
        C, a, c, J_s, own, r_k, known_s, pull_s = arrays
        return float(_minus_2_log_likelihood(C, a, c, J_s, own, r_k, known_s, pull_s, s_t, s_w))

    noise = float(np.mean(np.trace(covariance, axis1=1, axis2=2)))
    # the largest scatter that is tried: the whole of the residuals, four times over
    most = max(2.0, 4.0 * math.sqrt(float(np.mean((r**2).sum(axis=1))) / noise))
    units = [math.sqrt(noise / max(float(np.mean(np.trace(X, axis1=1, axis2=2))), 1e-300)) for X in (A, B)]
    s = [_grid(min(u, 1e3), most) for u in units]
    if most > WIDE:
        s = [_around(objective, s, k, most) for k in (0, 1)]
    L = np.array([[objective(p, w) for w in s[1]] for p in s[0]])
    prior = np.multiply.outer(
        *(scatter_prior(x / max(r0, 1e-12)) for x, r0 in zip(s, (maker.t_mm, maker.w_rad), strict=True))
    )
    weight = np.multiply.outer(*(_widths(x) for x in s)) * prior * np.exp(-0.5 * (L - L.min()))
    weight /= weight.sum()
    gain = float(L[0, 0] - L.min()) if s[0][0] == s[1][0] == 0.0 else objective(0.0, 0.0) - float(L.min())
    return PoseNoise(
        translation=math.sqrt(float((weight.sum(axis=1) * s[0] ** 2).sum())),
        rotation=math.sqrt(float((weight.sum(axis=0) * s[1] ** 2).sum())),
        gain=max(gain, 0.0),
        found=gain >= WORTH_IT,
    )


def scatter_prior(q: Array) -> Array:
    """Prior density of a scatter, in units of the maker's; see the module."""
    return np.asarray(1.0 / ((BEST_MACHINE + q) * (1.0 + q**2) ** 2))


def expected_scatter(maker: Repeatability | None = None) -> PoseNoise:
    """Root mean of the prior: the scatter that is assumed before an image is taken; maker: default as above."""
    maker = Repeatability() if maker is None else maker
    q = np.concatenate([[0.0], np.geomspace(1e-4, 100.0, 600)])
    weight = scatter_prior(q) * _widths(q)
    times = math.sqrt(float((weight * q**2).sum() / weight.sum()))
    return PoseNoise(translation=times * maker.t_mm, rotation=times * maker.w_rad, found=False)


def _widths(s: Array) -> Array:
    """Weights of the trapezoidal rule."""
    return np.gradient(s) if len(s) > 1 else np.ones(1)


def _around(objective: Callable[[float, float], float], s: list[Array], k: int, most: float) -> Array:
    """Values about the likeliest of scatter k, for the other anywhere: a grid from 0 to `most` would step over it."""
    other = s[1 - k]
    coarse = s[k][0] + np.concatenate([[0.0], np.geomspace(s[k][-1] / 400.0, s[k][-1], 12)])
    value = np.array([min(objective(*((x, o) if k == 0 else (o, x))) for o in other[::2]) for x in coarse])
    near = int(value.argmin())
    low, high = coarse[max(near - 1, 0)], coarse[min(near + 1, len(coarse) - 1)]
    return np.asarray(np.unique(np.concatenate([[0.0], np.linspace(low, high, STEPS - 1)])))
