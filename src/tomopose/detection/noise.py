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


@njit(cache=True)
def sector_median(values, sector, k):  # type: ignore[no-untyped-def]
    """Median of the values in each of k sectors; the largest of these where a sector has no value."""
    count = np.zeros(k + 1, np.int64)
    for i in range(sector.shape[0]):
        count[sector[i] + 1] += 1
    first = np.cumsum(count)
    place = first.copy()
    ordered = np.empty(values.shape[0])
    for i in range(sector.shape[0]):
        ordered[place[sector[i]]] = values[i]
        place[sector[i]] += 1
    out = np.full(k, np.nan)
    for n in range(k):
        if first[n + 1] > first[n]:
            out[n] = np.median(ordered[first[n] : first[n + 1]])
    largest = np.nanmax(out) if np.any(~np.isnan(out)) else 0.0
    return np.where(np.isnan(out), largest, out)


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
