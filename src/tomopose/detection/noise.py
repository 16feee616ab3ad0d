"""Noise as the image shows it: variance that grows with the level, and correlation between neighbours."""

from __future__ import annotations

import numpy as np
from numba import njit

from tomopose.units import Array

REACH = 2
"""Largest lag, px, at which correlation is looked for: a scintillator's or an interpolation's."""
SIGNIFICANT = 5.0
"""Standard deviations by which a neighbour's correlation must differ from 0 before noise counts as correlated."""
SMALLEST = 0.06
"""Correlation of neighbours below which noise counts as white: a holder leaves some in the residuals too."""


NORMAL_MEDIAN = 0.455
"""Median of the square of a standard normal variable."""


@njit(cache=True)
def weights(s, residual, model, first, sigma, level, white, floor, parameters, outlier):  # type: ignore[no-untyped-def]
    """(weight (n,), variance inside, outside, chi-square (k,) and number (k,) of each sector's pixels outside).

    s: signed distance; first: (k + 1,) of by_sector; floor: least variance; parameters: linear parameters that a
    sector's pixels determine.  Pixels more than `outlier` standard deviations off get no weight.  The variance
    outside is the median over the sectors, NaN where none has enough pixels.
    """
    n, k = s.shape[0], first.shape[0] - 1
    square = residual * residual
    limit, part = np.zeros(k), np.empty(n)
    largest, n_rim = 0.0, 0
    for j in range(k):
        m = 0
        for i in range(first[j], first[j + 1]):
            if s[i] > 3 * sigma:
                part[m] = square[i]
                m += 1
        limit[j] = np.median(part[:m]) if m > 0 else -1.0
        largest = max(largest, limit[j])
    for j in range(k):
        limit[j] = outlier**2 * ((limit[j] if limit[j] >= 0.0 else largest) / NORMAL_MEDIAN + floor)
    for i in range(n):
        if abs(s[i]) <= 3 * sigma:
            part[n_rim] = square[i]
            n_rim += 1
    rim_limit = outlier**2 * np.median(part[:n_rim]) / NORMAL_MEDIAN if n_rim > 0 else 0.0
    used = np.zeros(n, np.bool_)
    mean, count = np.zeros(k), np.zeros(k)
    n_core, n_inner, core, inner, core_level, inner_level = 0, 0, 0.0, 0.0, 0.0, 0.0
    for j in range(k):
        for i in range(first[j], first[j + 1]):
            most = max(limit[j], rim_limit) if abs(s[i]) <= 3 * sigma else limit[j]
            if s[i] <= -3 * sigma:
                most = max(most, outlier**2 * floor)
            if not square[i] < most:
                continue
            used[i] = True
            if s[i] > 3 * sigma:
                mean[j] += square[i]
                count[j] += 1.0
            elif s[i] < 0.0:
                n_inner += 1
                inner += square[i]
                inner_level += model[i]
                if s[i] < -3 * sigma:
                    n_core += 1
                    core += square[i]
                    core_level += model[i]
    enough = count > 2 * parameters + 2
    if not np.any(enough):
        return np.zeros(n), np.nan, np.nan, mean, count
    v_out = max(np.median((mean / np.maximum(count - parameters, 1.0))[enough]), floor)
    if n_core <= 20:
        n_core, core, core_level = n_inner, inner, inner_level
    v_in, level_in = (core / n_core, core_level / n_core) if n_core > 0 else (v_out, white)
    v_in = max(v_in, floor)
    weight, chi2 = np.zeros(n), np.zeros(k)
    for j in range(k):
        for i in range(first[j], first[j + 1]):
            if used[i]:
                x = min(max((model[i] - level_in) / (level - level_in), 0.0), 1.3)
                weight[i] = 1.0 / max(v_in + (v_out - v_in) * x, min(v_in, v_out))
                if s[i] > 3 * sigma:
                    chi2[j] += square[i] * weight[i]
        chi2[j] /= max(count[j], 1.0)
    return weight, v_in, v_out, chi2, count


def correlation(u: Array, v: Array, normalised: Array, per_parameter: float) -> Array:
    """Autocorrelation (2 REACH + 1, 2 REACH + 1) of normalised residuals at pixels u, v; a delta where it is white.

    per_parameter: pixels per fitted parameter; a fit takes its reciprocal away from every lag.
    """
    grid = _grid(u, v, normalised)
    rho, count = _lags(grid)
    rho, count = rho / rho[REACH, REACH], np.maximum(count, 1)
    rho = rho * count[REACH, REACH] / count
    white = np.zeros_like(rho)
    white[REACH, REACH] = 1.0
    corrected = rho + 1.0 / per_parameter
    neighbour = max(abs(corrected[REACH, REACH + 1]), abs(corrected[REACH + 1, REACH]))
    if not neighbour > max(SIGNIFICANT / np.sqrt(count[REACH, REACH + 1]), SMALLEST):
        return white
    corrected[REACH, REACH] = 1.0
    return np.asarray(corrected)


def sandwich(u: Array, v: Array, influence: Array, rho: Array) -> Array:
    """Covariance (m, m) of estimates with influence (n, m), in units of a pixel's own noise, under correlation rho."""
    out = np.zeros((influence.shape[1], influence.shape[1]))
    grids = [_grid(u, v, influence[:, k], fill=0.0) for k in range(influence.shape[1])]
    for dv in range(-REACH, REACH + 1):
        for du in range(-REACH, REACH + 1):
            weight = rho[dv + REACH, du + REACH]
            if weight == 0.0:
                continue
            for i, a in enumerate(grids):
                shifted = np.roll(a, (dv, du), axis=(0, 1))
                for j, b in enumerate(grids):
                    out[i, j] += weight * float((shifted * b).sum())
    return (out + out.T) / 2


def _grid(u: Array, v: Array, values: Array, fill: float = np.nan) -> Array:
    """Values on the pixel grid, with an empty margin of REACH."""
    i, j = u.astype(np.int64), v.astype(np.int64)
    grid = np.full((np.ptp(j) + 1 + 2 * REACH, np.ptp(i) + 1 + 2 * REACH), fill)
    grid[j - j.min() + REACH, i - i.min() + REACH] = values
    return grid


@njit(cache=True)
def _lags(grid):  # type: ignore[no-untyped-def]
    size = 2 * REACH + 1
    total, count = np.zeros((size, size)), np.zeros((size, size))
    for j in range(REACH, grid.shape[0] - REACH):
        for i in range(REACH, grid.shape[1] - REACH):
            here = grid[j, i]
            if np.isnan(here):
                continue
            for dv in range(-REACH, REACH + 1):
                for du in range(-REACH, REACH + 1):
                    there = grid[j + dv, i + du]
                    if not np.isnan(there):
                        total[dv + REACH, du + REACH] += here * there
                        count[dv + REACH, du + REACH] += 1.0
    return total, count
