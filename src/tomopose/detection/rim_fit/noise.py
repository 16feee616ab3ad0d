"""Noise as the image shows it: variance that grows with the level, and correlation between neighbours."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.ndimage import convolve

from tomopose.detection.rim_fit.order_statistics import median, select
from tomopose.units import Array

REACH = 5
"""Lag, px, at which noise no longer counts as correlated: a scintillator's or an interpolation's ends before."""
SIGNIFICANT = 3.5
"""Standard deviations by which a neighbour's correlation must differ from 0 before noise counts as correlated."""
SMALLEST = 0.06
"""Correlation of neighbours below which noise counts as white: a holder leaves some in the residuals too."""


LEAK, ENOUGH = 3, 50
"""Distance from the rim, px, within which noise is measured px by px, and the pixels that this takes."""
CLIPPED = 0.25
"""Share of the lower quartile below which a sector's variance is that of a saturated background."""
NORMAL_MEDIAN = 0.455
"""Median of the square of a standard normal variable."""
KEPT, SHORT = 1.5, 0.139
"""Standard deviations above their mean up to which sectors' variances count as noise alone, and what that cut takes
from the mean: phi(1.5) / Phi(1.5)."""


RARE = 0.1
"""Prior share of sets of residuals that hold more than noise."""


@njit(cache=True)
def evident(square, freedom):  # type: ignore[no-untyped-def]
    """Mean square of so many residuals in standard deviations, brought down to 1 so far as chance may have raised it.

    What is above 1 counts by the probability that there is more than noise: the likelihood ratio at its maximum,
    times the width that it has in `square`, against the prior odds.
    """
    if not square > 1.0:
        return 1.0
    chance = (1.0 / RARE - 1.0) * math.sqrt(0.5 * freedom)
    chance *= math.exp(-0.5 * freedom * (square - 1.0 - math.log(square)))
    return 1.0 + (square - 1.0) / (1.0 + chance)


@njit(cache=True, fastmath={"reassoc", "contract"}, error_model="numpy")
def weights(s, residual, model, first, sigma, level, white, floor, parameters, outlier):  # type: ignore[no-untyped-def]
    """(weight (n,), variance inside, outside, excess (k,), spread): weights by a variance linear in the level.

    s: signed distance; first: (k + 1,) of by_sector; floor: least variance; parameters: linear parameters that a
    sector's pixels determine.  Pixels more than `outlier` standard deviations off get no weight.  The variance outside
    is that of the sectors that are fitted well, NaN where none has enough pixels; excess: each sector's chi-square
    outside less 1; spread: what noise alone lets it vary by.
    """
    n, k = s.shape[0], first.shape[0] - 1
    square = residual * residual
    limit, part = np.zeros(k), np.empty(n)
    largest, n_rim = 0.0, 0
    for j in range(k):
        m = 0
        for i in range(first[j], first[j + 1]):
            part[m] = square[i]
            m += s[i] > 3 * sigma
        limit[j] = median(part[:m]) if m > 0 else -1.0
        largest = max(largest, limit[j])
    for j in range(k):
        limit[j] = outlier**2 * ((limit[j] if limit[j] >= 0.0 else largest) / NORMAL_MEDIAN + floor)
    for i in range(n):
        part[n_rim] = square[i]
        n_rim += abs(s[i]) <= 3 * sigma
    rim_limit = outlier**2 * median(part[:n_rim]) / NORMAL_MEDIAN if n_rim > 0 else 0.0
    used = np.empty(n)
    mean, level_of, count = np.zeros(k), np.zeros(k), np.zeros(k)
    n_core, n_inner, core, inner, core_level, inner_level = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(k):
        on_rim, within = max(limit[j], rim_limit), max(limit[j], outlier**2 * floor)
        for i in range(first[j], first[j + 1]):
            outside, deep = s[i] > 3 * sigma, s[i] < -3 * sigma
            most = limit[j] if outside else within if deep else on_rim
            used[i] = 1.0 if square[i] < most else 0.0
            out = used[i] if outside else 0.0
            mean[j] += out * square[i]
            level_of[j] += out * model[i]
            count[j] += out
            within_rim, at_core = used[i] if s[i] < 0.0 else 0.0, used[i] if deep else 0.0
            n_inner += within_rim
            inner += within_rim * square[i]
            inner_level += within_rim * model[i]
            n_core += at_core
            core += at_core * square[i]
            core_level += at_core * model[i]
    enough = count > 2 * parameters + 2
    if not np.any(enough):
        return np.zeros(n), np.nan, np.nan, mean, 1.0
    if n_core <= 20:
        n_core, core, core_level = n_inner, inner, inner_level
    mean = mean / np.maximum(count - parameters, 1.0)
    v_in, level_in = (core / n_core, core_level / n_core) if n_core > 0 else (median(mean[enough]), white)
    v_in = max(v_in, floor)
    share = (level_of / np.maximum(count, 1.0) - level_in) / (level - level_in)
    usual = select(mean[enough], np.sum(enough) // 4)
    # What a sector's variance would be at the mean level of the background.
    for j in range(k):
        mean[j] /= min(max((v_in + (usual - v_in) * share[j]) / max(usual, 1e-300), 0.5), 2.0)
    v_out, spread = _quiet(mean[enough], median(count[enough]))
    v_out = max(v_out, floor)
    weight, chi2 = np.empty(n), np.zeros(k)
    per_level = 1.0 / (level - level_in)
    for j in range(k):
        for i in range(first[j], first[j + 1]):
            x = min(max((model[i] - level_in) * per_level, 0.0), 1.3)
            weight[i] = used[i] / max(v_in + (v_out - v_in) * x, min(v_in, v_out))
            chi2[j] += square[i] * (weight[i] if s[i] > 3 * sigma else 0.0)
        chi2[j] = chi2[j] / max(count[j] - parameters, 1.0) - 1.0 if enough[j] else 0.0
    return weight, v_in, v_out, chi2, spread


@njit(cache=True)
def _quiet(variance, n):  # type: ignore[no-untyped-def]
    """(mean, relative spread) of the sectors' variances that belong together at their low end.

    n: pixels of a sector.  A holder's edges add to a sector's variance; only a clipped background takes some away.
    """
    ordered = np.sort(variance)
    ordered = ordered[ordered > CLIPPED * ordered[ordered.shape[0] // 4]]
    m = ordered.shape[0]
    low, quarter = ordered[m // 10], ordered[m // 4]
    spread = max(math.sqrt(2.0 / n), min((quarter - low) / (0.607 * max(quarter, 1e-300)), 0.5))
    middle = quarter * (1.0 + 0.67 * spread)
    for _ in range(4):
        kept = ordered[ordered < middle * (1.0 + KEPT * spread)]
        middle = np.mean(kept) * (1.0 + SHORT * spread)
    return middle, spread


def correlation(u: Array, v: Array, normalised: Array) -> Array:
    """Autocorrelation (2 REACH + 1, 2 REACH + 1) of normalised residuals at pixels u, v; a delta where it is white.

    A fit takes as much away from every lag (and from the variance) as residuals at a distance of REACH are
    correlated, where the noise itself is not.
    """
    rho = np.zeros((2 * REACH + 1, 2 * REACH + 1))
    rho[REACH, REACH] = 1.0
    grid = _grid(u, v, normalised)
    near, count = _correlation(grid, 1)
    neighbour = max(abs(near[1, 2]), abs(near[2, 1]))
    if not neighbour > max(SIGNIFICANT / math.sqrt(max(count[1, 2], 1.0)), SMALLEST):
        return rho
    rho, count = _correlation(grid, REACH)
    rim = np.ones(rho.shape, dtype=bool)
    rim[1:-1, 1:-1] = False
    rho += max(-float(np.average(rho[rim], weights=count[rim])), 0.0)
    lag = np.abs(np.arange(-REACH, REACH + 1))
    ring = np.maximum(lag[:, None], lag)
    # They end where a ring of lags is 0; of its 8 r lags half repeat the others, and neighbours vary together.
    chance = float(near.sum()) / math.sqrt(count[REACH, REACH])
    over = next(r for r in range(3, REACH + 1) if r == REACH or rho[ring == r].mean() < 2.0 * chance / math.sqrt(4 * r))
    rho[ring >= over] = 0.0
    return rho


def _correlation(grid: Array, reach: int) -> tuple[Array, Array]:
    """Autocorrelation and the number of pairs, both (2 reach + 1, 2 reach + 1)."""
    total, count = _lags(grid, reach)
    count = np.maximum(count, 1.0)
    return (total / count) / (total[reach, reach] / count[reach, reach]), count


def sandwich(u: Array, v: Array, influence: Array, rho: Array) -> Array:
    """Covariance (m, m) of estimates with influence (n, m), in units of a pixel's own noise, under correlation rho.

    In no direction smaller than under white noise: a rho cut off at REACH need not be positive definite.
    """
    grids = [_grid(u, v, influence[:, k], fill=0.0) for k in range(influence.shape[1])]
    spread = [convolve(grid, rho, mode="constant") for grid in grids]
    out = np.array([[float((a * b).sum()) for b in grids] for a in spread])
    root = np.linalg.cholesky(influence.T @ influence)
    ratio = np.linalg.solve(root, np.linalg.solve(root, (out + out.T) / 2).T)
    values, axes = np.linalg.eigh((ratio + ratio.T) / 2)
    axes = root @ axes
    return np.asarray((axes * np.maximum(values, 1.0)) @ axes.T)


def across(s: Array, normalised: Array, clean: npt.NDArray[np.bool_]) -> Array:
    """(n,) standard deviation of the noise in what was taken for it, by the distance s from the rim.

    Light that spreads in a scintillator carries the background's noise over the rim, where the level tells of none.
    """
    bins = np.clip(np.floor(s), -LEAK - 1, LEAK).astype(np.int64) + LEAK + 1
    square = np.bincount(bins[clean], normalised[clean] ** 2, 2 * LEAK + 2)
    count = np.bincount(bins[clean], minlength=2 * LEAK + 2)
    return np.asarray(np.sqrt(np.where(count > ENOUGH, square / np.maximum(count, 1), 1.0))[bins])


def _grid(u: Array, v: Array, values: Array, fill: float = np.nan) -> Array:
    """Values on the pixel grid, with an empty margin of REACH."""
    i, j = u.astype(np.int64), v.astype(np.int64)
    grid = np.full((np.ptp(j) + 1 + 2 * REACH, np.ptp(i) + 1 + 2 * REACH), fill)
    grid[j - j.min() + REACH, i - i.min() + REACH] = values
    return grid


@njit(cache=True)
def _lags(grid, reach):  # type: ignore[no-untyped-def]
    """(sum of products, number of pairs), both (2 reach + 1, 2 reach + 1), of values that lie so many px apart."""
    size = 2 * reach + 1
    total, count = np.zeros((size, size)), np.zeros((size, size))
    for j in range(reach, grid.shape[0] - reach):
        for i in range(reach, grid.shape[1] - reach):
            here = grid[j, i]
            if np.isnan(here):
                continue
            for dv in range(-reach, reach + 1):
                for du in range(-reach, reach + 1):
                    there = grid[j + dv, i + du]
                    if not np.isnan(there):
                        total[dv + reach, du + reach] += here * there
                        count[dv + reach, du + reach] += 1.0
    return total, count
