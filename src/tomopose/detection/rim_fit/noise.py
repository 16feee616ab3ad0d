"""Noise as the image shows it: variance that grows with the level, and correlation between neighbours."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import convolve

from tomopose.coverage import NORMAL_MEDIAN
from tomopose.detection.order_statistics import arrange, median, select
from tomopose.detection.rim_fit.state import Noise, RimFit
from tomopose.detection.rim_model.ring import SHELLS
from tomopose.detection.settings import NoiseSettings
from tomopose.errors import BallNotFoundError
from tomopose.kernel_cache import njit
from tomopose.units import Array

SHORT = 0.139
"""What a cut 1.5 standard deviations above it takes from a normal mean: phi(1.5) / Phi(1.5)."""


@njit(cache=True)
def excess_variance(square, freedom, rare):  # type: ignore[no-untyped-def]
    """Mean square of so many residuals in standard deviations, brought down to 1 so far as chance may have raised it.

    What is above 1 counts by the probability that there is more than noise: the likelihood ratio at its maximum,
    times the width that it has in `square`, against the prior odds of `rare`.
    """
    if not square > 1.0:
        return 1.0
    chance = (1.0 / rare - 1.0) * math.sqrt(0.5 * freedom)
    chance *= math.exp(-0.5 * freedom * (square - 1.0 - math.log(square)))
    return 1.0 + (square - 1.0) / (1.0 + chance)


@njit(cache=True, fastmath={"reassoc", "contract"})
def _weights(s, residual, model, first, stand, parameters, outlier, clipped, kept_below):  # type: ignore[no-untyped-def]
    """(weight (n,), variance inside, outside, excess (k,), spread): weights by a variance linear in the level.

    s: signed distance; first: (k + 1,), where sectors begin; state: blur, background level, ball's value, and least
    variance; parameters: linear parameters that a sector's pixels determine.  Pixels more than `outlier` standard
    deviations off get no weight.  The variance outside is that of the sectors that are fitted well, NaN where none has
    enough pixels; excess: each sector's chi-square outside less 1; spread: what noise alone lets it vary by.
    """
    sigma, level, white, floor = stand
    n, k = s.shape[0], first.shape[0] - 1
    square, used, part, weight = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    limit, mean, level_of, count = np.zeros(k), np.zeros(k), np.zeros(k), np.zeros(k)
    largest, n_rim = 0.0, 0
    for i in range(n):
        square[i] = residual[i] * residual[i]
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
    fewest, m = 2 * parameters + 2, 0
    for j in range(k):
        if count[j] > fewest:
            mean[j] /= max(count[j] - parameters, 1.0)
            part[m] = mean[j]
            m += 1
    if m == 0:
        return weight, np.nan, np.nan, mean, 1.0
    usual = select(part[:m], m // 4)
    if n_core <= 20:
        n_core, core, core_level = n_inner, inner, inner_level
    v_in, level_in = (core / n_core, core_level / n_core) if n_core > 0 else (median(part[:m]), white)
    v_in = max(v_in, floor)
    # What a sector's variance would be at the mean level of the background.
    m = 0
    for j in range(k):
        if count[j] > fewest:
            share = (level_of[j] / max(count[j], 1.0) - level_in) / (level - level_in)
            part[m] = mean[j] / min(max((v_in + (usual - v_in) * share) / max(usual, 1e-300), 0.5), 2.0)
            limit[m] = count[j]
            m += 1
    v_out, spread = _quiet(part[:m], median(limit[:m]), clipped, kept_below)
    v_out = max(v_out, floor)
    per_level = 1.0 / (level - level_in)
    for j in range(k):
        chi2 = 0.0
        for i in range(first[j], first[j + 1]):
            x = min(max((model[i] - level_in) * per_level, 0.0), 1.3)
            weight[i] = used[i] / max(v_in + (v_out - v_in) * x, min(v_in, v_out))
            chi2 += square[i] * (weight[i] if s[i] > 3 * sigma else 0.0)
        mean[j] = chi2 / max(count[j] - parameters, 1.0) - 1.0 if count[j] > fewest else 0.0
    return weight, v_in, v_out, mean, spread


@njit(cache=True)
def _quiet(variance, n, clipped, kept_below):  # type: ignore[no-untyped-def]
    """(mean, relative spread) of the sectors' variances that belong together at their low end; orders them.

    n: pixels of a sector.  A holder's edges add to a sector's variance; only a clipped background takes some away.
    """
    arrange(variance)
    m = variance.shape[0]
    least, first = clipped * variance[m // 4], 0
    while variance[first] <= least and first < m - 1:
        first += 1
    m -= first
    low, quarter = variance[first + m // 10], variance[first + m // 4]
    spread = max(math.sqrt(2.0 / n), min((quarter - low) / (0.607 * max(quarter, 1e-300)), 0.5))
    middle = quarter * (1.0 + 0.67 * spread)
    for _ in range(4):
        total, kept, most = 0.0, 0, middle * (1.0 + kept_below * spread)
        while kept < m and variance[first + kept] < most:
            total += variance[first + kept]
            kept += 1
        middle = total / kept * (1.0 + SHORT * spread)
    return middle, spread


def weighted(fit: RimFit, parameters: float) -> RimFit:
    """Pixels weighted by the noise of the image; parameters: linear ones that a sector's pixels determine."""
    p = fit.parameters
    weight, v_in, v_out, excess, scatter = _weights(
        fit.distance, fit.residual, fit.model, fit.pixels.bounds[::SHELLS],
        (p.blur, p.level, float(p.white), fit.floor), parameters, fit.settings.fit.outlier,
        fit.settings.noise.clipped, fit.settings.noise.kept,
    )  # fmt: skip
    if not math.isfinite(v_out):
        raise BallNotFoundError(
            f"too few usable pixels outside the rim to measure the noise: the blur of {p.blur:.1f} px, the image's "
            f"border or bad pixels leave no sector with enough of them beyond {3 * p.blur:.1f} px"
        )
    return replace(fit, weight=weight, noise=Noise(v_in, v_out, excess, scatter, np.ones((1, 1)), apart=False))


def with_noise_correlation(fit: RimFit) -> RimFit:
    """The noise's autocorrelation, where the background fits: what is left of an edge is correlated too.

    On a ring too small to distinguish the two, what is left counts as noise.
    """
    outside = (fit.distance > 3 * fit.parameters.blur) & (fit.weight > 0)
    quiet = outside & (fit.noise.excess < fit.noise.scatter)[fit.pixels.sector]
    apart = bool(np.count_nonzero(quiet) > fit.settings.noise.enough_quiet)
    used = np.flatnonzero(quiet if apart else outside)
    rho = np.ones((1, 1))
    if used.size > fit.settings.noise.fewest_pixels:
        normalised = (fit.residual * np.sqrt(fit.weight))[used]
        rho = correlation(fit.pixels.u[used], fit.pixels.v[used], normalised, fit.settings.noise)
    return replace(fit, noise=fit.noise._replace(rho=rho, apart=apart))


def correlation(u: Array, v: Array, normalised: Array, settings: NoiseSettings) -> Array:
    """Autocorrelation (2 reach + 1, 2 reach + 1) of normalised residuals at pixels u, v; a delta where it is white.

    A fit takes as much away from every lag (and from the variance) as residuals at a distance of `reach` are
    correlated, where the noise itself is not.
    """
    reach = settings.reach
    rho = np.zeros((2 * reach + 1, 2 * reach + 1))
    rho[reach, reach] = 1.0
    grid = _grid(u, v, normalised, reach)
    near, count = _correlation(grid, 1, reach)
    neighbour = max(abs(near[1, 2]), abs(near[2, 1]))
    if not neighbour > max(settings.significant / math.sqrt(max(count[1, 2], 1.0)), settings.smallest):
        return rho
    rho, count = _correlation(grid, reach, reach)
    rim = np.ones(rho.shape, dtype=bool)
    rim[1:-1, 1:-1] = False
    rho += max(-float(np.average(rho[rim], weights=count[rim])), 0.0)
    lag = np.abs(np.arange(-reach, reach + 1))
    ring = np.maximum(lag[:, None], lag)
    # They end where a ring of lags is 0; of its 8 r lags half repeat the others, and neighbours vary together.
    chance = float(near.sum()) / math.sqrt(count[reach, reach])
    over = next(r for r in range(3, reach + 1) if r == reach or rho[ring == r].mean() < 2.0 * chance / math.sqrt(4 * r))
    rho[ring >= over] = 0.0
    return rho


def _correlation(grid: Array, reach: int, margin: int) -> tuple[Array, Array]:
    """Autocorrelation and the number of pairs, both (2 reach + 1, 2 reach + 1)."""
    total, count = _lags(grid, reach, margin)
    count = np.maximum(count, 1.0)
    return (total / count) / (total[reach, reach] / count[reach, reach]), count


def sandwich(u: Array, v: Array, influence: Array, rho: Array) -> Array:
    """Covariance (m, m) of estimates with influence (n, m), in units of a pixel's own noise, under correlation rho.

    In no direction smaller than under white noise: a rho that is cut off need not be positive definite.
    """
    grids = [_grid(u, v, influence[:, k], len(rho) // 2, fill=0.0) for k in range(influence.shape[1])]
    spread = [convolve(grid, rho, mode="constant") for grid in grids]
    out = np.array([[float((a * b).sum()) for b in grids] for a in spread])
    root = np.linalg.cholesky(influence.T @ influence)
    ratio = np.linalg.solve(root, np.linalg.solve(root, (out + out.T) / 2).T)
    values, axes = np.linalg.eigh((ratio + ratio.T) / 2)
    axes = root @ axes
    return np.asarray((axes * np.maximum(values, 1.0)) @ axes.T)


def noise_by_distance(
    s: Array, normalised: Array, clean: npt.NDArray[np.bool_], settings: NoiseSettings
) -> Array:  # fmt: skip
    """(n,) standard deviation of the noise in what was taken for it, by the distance s from the rim.

    Light that spreads in a scintillator carries the background's noise over the rim, where the level does not show it.
    """
    leak = settings.leak
    bins = np.clip(np.floor(s), -leak - 1, leak).astype(np.int64) + leak + 1
    square = np.bincount(bins[clean], normalised[clean] ** 2, 2 * leak + 2)
    count = np.bincount(bins[clean], minlength=2 * leak + 2)
    enough = count > settings.leak_pixels
    return np.asarray(np.sqrt(np.where(enough, square / np.maximum(count, 1), 1.0))[bins])


def _grid(u: Array, v: Array, values: Array, margin: int, fill: float = np.nan) -> Array:
    """Values on the pixel grid, with an empty margin."""
    i, j = u.astype(np.int64), v.astype(np.int64)
    grid = np.full((np.ptp(j) + 1 + 2 * margin, np.ptp(i) + 1 + 2 * margin), fill)
    grid[j - j.min() + margin, i - i.min() + margin] = values
    return grid


@njit(cache=True)
def _lags(grid, reach, margin):  # type: ignore[no-untyped-def]
    """(sum of products, number of pairs), both (2 reach + 1, 2 reach + 1), of values that lie so many px apart."""
    size = 2 * reach + 1
    total, count = np.zeros((size, size)), np.zeros((size, size))
    for j in range(margin, grid.shape[0] - margin):
        for i in range(margin, grid.shape[1] - margin):
            here = grid[j, i]
            if np.isnan(here):
                continue
            for k in range(size * size):
                dv, du = k // size, k % size
                there = grid[j + dv - reach, i + du - reach]
                if not np.isnan(there):
                    total[dv, du] += here * there
                    count[dv, du] += 1.0
    return total, count
