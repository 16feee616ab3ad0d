"""From cells to pixels: Gaussian unsharpness and the pixel's own area in one separable kernel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from scipy.special import ndtr

from tomopose.units import Array

REACH = 5.0
"""Kernels are cut at this many standard deviations (3e-7 of the light lies outside)."""


def margin(sigma: float) -> int:
    """Pixels around a pixel that a blur of `sigma` (px) draws from."""
    return math.ceil(REACH * sigma) + 1


def pixel_kernel(sigma: float, f: int, half: int) -> Array:
    r"""Weights ((2 half + 1) f,) of the cells around a pixel, f cells a pixel: box * Gaussian, integrated over each cell.

    A cell's mean is spread evenly over the cell, which together with its taking has the variance h^2 / 6 (h = 1/f); the
    Gaussian is made narrower by that, so that the blur's second moment is exact.
    """
    h = 1.0 / f
    s = math.sqrt(max(sigma**2 - h**2 / 6, 0.0))
    x = (np.arange((2 * half + 1) * f) + 0.5) * h - half - 0.5

    def twice_integrated(x: Array) -> Array:
        if s == 0:
            return np.maximum(x, 0.0)
        return np.asarray(x * ndtr(x / s) + s * np.exp(-0.5 * (x / s) ** 2) / math.sqrt(2 * math.pi))

    a, b = 0.5 + h / 2, 0.5 - h / 2
    k = twice_integrated(x + a) - twice_integrated(x + b) - twice_integrated(x - b) + twice_integrated(x - a)
    return np.asarray(k / k.sum())


@njit(cache=True, nogil=True)
def _reduce_rows(cells: Any, k: Any, f: int, half: int, j_0: int, j_1: int, out: Any) -> None:
    n_v = cells.shape[0] // f
    for j in range(j_0, j_1):
        out[j, :] = 0.0
        for a in range(len(k)):
            row = (j - half) * f + a
            row = min(max(row, 0), n_v * f - 1)
            weight = k[a]
            for i in range(cells.shape[1]):
                out[j, i] += weight * cells[row, i]


@njit(cache=True, nogil=True)
def _reduce_columns(rows: Any, k: Any, f: int, half: int, j_0: int, j_1: int, out: Any) -> None:
    last = rows.shape[1] - 1
    for j in range(j_0, j_1):
        for i in range(out.shape[1]):
            total, start = 0.0, (i - half) * f
            if start >= 0 and start + len(k) <= last + 1:
                for a in range(len(k)):
                    total += k[a] * rows[j, start + a]
            else:
                for a in range(len(k)):
                    total += k[a] * rows[j, min(max(start + a, 0), last)]
            out[j, i] = total


def to_pixels(cells: Array, *, f: int, sigma_u: float, sigma_v: float, threads: int = 1) -> Array:
    """Pixel values (n_v, n_u) of cells (n_v f, n_u f) under a Gaussian blur of sigma_u, sigma_v px."""
    from tomopose.simulation.projector import in_bands

    n_v, n_u = cells.shape[0] // f, cells.shape[1] // f
    half_u, half_v = margin(sigma_u), margin(sigma_v)
    k_u, k_v = pixel_kernel(sigma_u, f, half_u), pixel_kernel(sigma_v, f, half_v)
    rows, out = np.empty((n_v, n_u * f)), np.empty((n_v, n_u))
    in_bands(lambda lo, hi: _reduce_rows(cells, k_v, f, half_v, lo, hi, rows), n_v, threads)
    in_bands(lambda lo, hi: _reduce_columns(rows, k_u, f, half_u, lo, hi, out), n_v, threads)
    return out
