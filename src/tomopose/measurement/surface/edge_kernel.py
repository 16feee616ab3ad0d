"""One edge along one line: sampled from the splines, found by the local 50 %, then fitted as a blurred step.

    g(s) = b + (a - b) Phi(-(s - s_0) / sigma)        a: grey inside the material, b: outside, s: along the normal

The normal points from material to background, so a > b; sigma is one number for the whole surface.  s_0, a, b follow by
Gauss-Newton from the 50 % crossing between the two plateaus.  Lengths here are in units of the sampling voxel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from tomopose.kernel_cache import njit
from tomopose.measurement.surface.splines import spline_value
from tomopose.units import Array

STEP = 0.25
GAUSS_NEWTON = 12
RECENTRINGS = 3
AGAIN = 0.3
"""Share of the contrast by which grey must come back for a second edge."""
COARSE = 0.5
"""Distance of samples beyond the window, voxels."""
(
    S,
    A,
    B,
    RMS,
    S_VARIANCE,
    INNER_SLOPE,
    OUTER_SLOPE,
    D_SIGMA,
    D_SIGMA_2,
    S_BY_A,
    S_BY_B,
    S_VARIANCE_HELD,
    AA,
    AB,
    BB,
    INSIDE,
    OUTSIDE,
) = range(17)
"""Columns of a result: s_0, a, b, rms of the fit, variance of s_0 for unit noise, differences of the two halves of
each plateau, the sums that a common step in sigma is made of, by how much s_0 moves with a and b held elsewhere, and
its variance then, the normal equations of a and b with s_0 eliminated, the mean grey levels beyond the window on both
sides (from the variance on only where a step was fitted; the last two only where nothing else is near)."""
N_COLUMNS = 17
BORDER, NO_EDGE, THIN, NOT_CONVERGED = 1, 2, 4, 8


@njit(cache=True)
def _profile(c: Array, p: Array, n: Array, s_0: float, window: float, g: Array) -> Any:
    """Samples of p + s n (index units), s = s_0 - window ... s_0 + window; False where the line leaves the array."""
    m = g.shape[0]
    for e in (s_0 - window, s_0 + window):
        for a in range(3):
            x = p[a] + e * n[a]
            if x < 1.0 or x > c.shape[a] - 2.000001:
                return False
    for k in range(m):
        s = s_0 - window + k * STEP
        g[k] = spline_value(c, p[0] + s * n[0], p[1] + s * n[1], p[2] + s * n[2])
    return True


@njit(cache=True)
def plateaus(g: Array) -> Any:
    """Means of the first and last voxel of a profile."""
    per_voxel = round(1.0 / STEP) + 1
    a, b = 0.0, 0.0
    for k in range(per_voxel):
        a += g[k]
        b += g[g.shape[0] - 1 - k]
    return a / per_voxel, b / per_voxel


@njit(cache=True)
def crossing(g: Array, level: float, window: float) -> Any:
    """Falling crossing of `level` nearest to the middle, s relative to it; nan where there is no crossing."""
    best = np.nan
    for k in range(g.shape[0] - 1):
        if g[k] >= level > g[k + 1]:
            s = -window + (k + (g[k] - level) / (g[k] - g[k + 1])) * STEP
            if not abs(s) >= abs(best):
                best = s
    return best


@njit(cache=True)
def _steepest(c: Array, p: Array, n: Array, search: float, window: float) -> Any:
    """Where along +-search the grey falls most between the voxel before and the voxel behind."""
    best, where = -np.inf, np.nan
    steps = round(2 * search / STEP)
    for k in range(steps + 1):
        s = -search + k * STEP
        fall, inside = 0.0, True
        for e in (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5):
            z, y, x = p[0] + (s + e) * n[0], p[1] + (s + e) * n[1], p[2] + (s + e) * n[2]
            if (
                min(z, y, x) < 1.0
                or z > c.shape[0] - 2.000001
                or y > c.shape[1] - 2.000001
                or x > c.shape[2] - 2.000001
            ):
                inside = False
                break
            fall += spline_value(c, z, y, x) if e < 0 else -spline_value(c, z, y, x)
        if inside and fall > best:
            best, where = fall, s
    return where


@njit(cache=True)
def _another_edge(g: Array, s: float, a: float, b: float, window: float) -> Any:
    """True where the grey rises behind the edge at s and falls again, or falls before it and rises: a thin wall or gap.

    Means over a voxel are compared with the outermost ones, a and b.
    """
    per_voxel = round(1.0 / STEP) + 1
    high, low = a, b
    for k in range(g.shape[0] - per_voxel + 1):
        mean = 0.0
        for j in range(per_voxel):
            mean += g[k + j]
        mean /= per_voxel
        if -window + (k + per_voxel // 2) * STEP < s:
            high = max(high, mean)
        else:
            low = min(low, mean)
    return high - a > AGAIN * (high - low) or b - low > AGAIN * (high - low)


@njit(cache=True)
def fit_edge(g: Array, sigma: float, window: float, start: float, a: float, b: float, out: Array) -> Any:
    """Gauss-Newton for s_0, a, b; writes a row of results, s_0 relative to the profile's middle.  True if converged."""
    m = g.shape[0]
    s_0, converged = start, False
    width = sigma * math.sqrt(2.0)
    h11 = h12 = h13 = h22 = h23 = h33 = 0.0
    for _ in range(GAUSS_NEWTON):
        h11 = h12 = h13 = h22 = h23 = h33 = 0.0
        q1 = q2 = q3 = 0.0
        for k in range(m):
            t = -window + k * STEP - s_0
            phi = 0.5 * math.erfc(t / width)
            slope = (a - b) * math.exp(-0.5 * (t / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
            r = g[k] - (b + (a - b) * phi)
            h11 += slope * slope
            h12 += slope * phi
            h13 += slope * (1 - phi)
            h22 += phi * phi
            h23 += phi * (1 - phi)
            h33 += (1 - phi) * (1 - phi)
            q1 += slope * r
            q2 += phi * r
            q3 += (1 - phi) * r
        # 3 x 3 normal equations by cofactors.
        c11, c12, c13 = h22 * h33 - h23 * h23, h13 * h23 - h12 * h33, h12 * h23 - h13 * h22
        c22, c23, c33 = h11 * h33 - h13 * h13, h12 * h13 - h11 * h23, h11 * h22 - h12 * h12
        det = h11 * c11 + h12 * c12 + h13 * c13
        if not abs(det) > 1e-30:
            return False
        step = (c11 * q1 + c12 * q2 + c13 * q3) / det
        a += (c12 * q1 + c22 * q2 + c23 * q3) / det
        b += (c13 * q1 + c23 * q2 + c33 * q3) / det
        if not abs(step) <= 1.0:
            step = math.copysign(1.0, step)
        s_0 += step
        if not abs(s_0) < window:
            return False
        if abs(step) < 1e-6:
            converged = True
            break
    out[S], out[A], out[B] = s_0, a, b
    det = h11 * (h22 * h33 - h23 * h23) - h12 * (h12 * h33 - h13 * h23) + h13 * (h12 * h23 - h13 * h22)
    out[S_VARIANCE] = (h22 * h33 - h23 * h23) / det
    out[S_BY_A], out[S_BY_B], out[S_VARIANCE_HELD] = -h12 / h11, -h13 / h11, 1.0 / h11
    out[AA], out[AB], out[BB] = h22 - h12 * h12 / h11, h23 - h12 * h13 / h11, h33 - h13 * h13 / h11
    _judge(g, sigma, window, s_0, a, b, out)
    # What of a step in sigma the edge's own three parameters would take up.
    q1 = q2 = q3 = 0.0
    for k in range(m):
        t = -window + k * STEP - s_0
        phi = 0.5 * math.erfc(t / width)
        slope = (a - b) * math.exp(-0.5 * (t / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
        q1 += slope * slope * t / sigma
        q2 += phi * slope * t / sigma
        q3 += (1 - phi) * slope * t / sigma
    c11, c12, c13 = h22 * h33 - h23 * h23, h13 * h23 - h12 * h33, h12 * h23 - h13 * h22
    c22, c23, c33 = h11 * h33 - h13 * h13, h12 * h13 - h11 * h23, h11 * h22 - h12 * h12
    out[D_SIGMA_2] -= (
        q1 * (c11 * q1 + c12 * q2 + c13 * q3)
        + q2 * (c12 * q1 + c22 * q2 + c23 * q3)
        + q3 * (c13 * q1 + c23 * q2 + c33 * q3)
    ) / det
    return converged


@njit(cache=True)
def _judge(g: Array, sigma: float, window: float, s_0: float, a: float, b: float, out: Array) -> Any:
    """Residuals of the fit, the flatness of both plateaus, and the sums for a common step in sigma."""
    m = g.shape[0]
    square = up = down = 0.0
    near_in = near_out = far_in = far_out = 0.0
    n_near_in = n_near_out = n_far_in = n_far_out = 0
    edge = 2.5 * sigma
    half_in, half_out = 0.5 * (edge + window + s_0), 0.5 * (edge + window - s_0)
    for k in range(m):
        t = -window + k * STEP - s_0
        phi = 0.5 * math.erfc(t / (sigma * math.sqrt(2.0)))
        r = g[k] - (b + (a - b) * phi)
        by_sigma = (a - b) * t / sigma * math.exp(-0.5 * (t / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
        square += r * r
        up += by_sigma * r
        down += by_sigma * by_sigma
        if t < -edge:
            if -t > half_in:
                far_in, n_far_in = far_in + r, n_far_in + 1
            else:
                near_in, n_near_in = near_in + r, n_near_in + 1
        elif t > edge:
            if t > half_out:
                far_out, n_far_out = far_out + r, n_far_out + 1
            else:
                near_out, n_near_out = near_out + r, n_near_out + 1
    out[RMS] = math.sqrt(square / m)
    out[D_SIGMA], out[D_SIGMA_2] = up, down
    out[INNER_SLOPE] = far_in / n_far_in - near_in / n_near_in if n_far_in > 0 and n_near_in > 0 else np.nan
    out[OUTER_SLOPE] = far_out / n_far_out - near_out / n_near_out if n_far_out > 0 and n_near_out > 0 else np.nan


@njit(cache=True)
def _beyond(c: Array, p: Array, n: Array, middle: float, sigma: float, window: float, longer: float, out: Array) -> Any:
    """Mean grey from the window's ends to `longer` beyond them, into a row of results; nan for both where the line
    leaves the array, or where another edge is so near that its blur reaches there."""
    steps = round(longer / COARSE)
    guard = math.ceil(2.5 * sigma / COARSE)
    limit = AGAIN * (out[A] - out[B])
    inside = outside = 0.0
    for side in (-1.0, 1.0):
        level = out[A] if side < 0 else out[B]
        total = before = last = 0.0
        for k in range(1, steps + guard + 1):
            s = middle + side * (window + k * COARSE)
            z, y, x = p[0] + s * n[0], p[1] + s * n[1], p[2] + s * n[2]
            if (
                min(z, y, x) < 1.0
                or z > c.shape[0] - 2.000001
                or y > c.shape[1] - 2.000001
                or x > c.shape[2] - 2.000001
            ):
                return
            g = spline_value(c, z, y, x)
            if k > 2 and abs((g + last + before) / 3.0 - level) > limit:
                return
            before, last = last, g
            if k <= steps:
                total += g
        if side < 0:
            inside = total / steps
        else:
            outside = total / steps
    out[INSIDE], out[OUTSIDE] = inside, outside


@njit(cache=True, parallel=True)
def search_lines(
    c: Array, index: Array, step: Array, sigma: float, window: float, search: float, fit: bool, longer: float
) -> Any:
    """Edges along n lines.

    c: spline coefficients [z, y, x]; index (n, 3): start points as (iz, iy, ix); step (n, 3): the normal's unit length
    in the same units; sigma, window, search: in lengths of that unit; fit: False stops at the local 50 %; longer: how
    far beyond the window grey levels are looked at, 0 for not at all.
    Returns results (n, N_COLUMNS) and flags (n,) uint8; where a flag is set s_0 is nan or doubtful.
    """
    n = index.shape[0]
    result = np.full((n, N_COLUMNS), np.nan)
    flags = np.zeros(n, dtype=np.uint8)
    m = 2 * round(window / STEP) + 1
    for i in prange(n):
        g = np.empty(m)
        middle = 0.0
        if search > window:
            middle = _steepest(c, index[i], step[i], search, window)
            if not math.isfinite(middle):
                flags[i] = BORDER
                continue
        for _ in range(RECENTRINGS):
            flags[i] = 0
            if not _profile(c, index[i], step[i], middle, window, g):
                flags[i] = BORDER
                break
            a, b = plateaus(g)
            s = crossing(g, 0.5 * (a + b), window)
            if not (a > b and math.isfinite(s)):
                flags[i] = NO_EDGE
                break
            if _another_edge(g, s, a, b, window):
                flags[i] |= THIN
            if fit:
                if not fit_edge(g, sigma, window, s, a, b, result[i]):
                    flags[i] |= NOT_CONVERGED
                    break
            else:
                result[i, S], result[i, A], result[i, B] = s, a, b
                # The crossing moves with the level midway, along the slope of the blurred step.
                result[i, S_BY_A] = -0.5 * sigma * math.sqrt(2 * math.pi) / (a - b)
                result[i, S_BY_B] = result[i, S_BY_A]
                _judge(g, sigma, window, s, a, b, result[i])
            shift = result[i, S]
            result[i, S] = middle + shift
            if abs(shift) < 0.5:
                break
            middle += shift
        if not abs(result[i, S]) <= search and flags[i] == 0:
            flags[i] = NO_EDGE
        if fit and longer > 0 and flags[i] == 0:
            _beyond(c, index[i], step[i], middle, sigma, window, longer, result[i])
    return result, flags
