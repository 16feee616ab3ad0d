"""From cells to pixels: Gaussian unsharpness and the pixel's own area in one separable kernel."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from tomopose.kernel_cache import njit
from tomopose.units import Array

REACH = 5.0
"""Kernels are cut at this many standard deviations (3e-7 of the light lies outside)."""


def margin(sigma: float) -> int:
    """Pixels around a pixel that a blur of `sigma` (px) draws from."""
    return math.ceil(REACH * sigma) + 1


def pixel_kernel(sigma: float, f: int, half: int) -> Array:
    r"""Weights (3, (2 half + 1) f) with which a pixel takes means, slopes and curvatures (per px) of the cells around.

    The pixel's response to light at distance x is k(x) = Phi((x + 1/2) / sigma) - Phi((x - 1/2) / sigma); a cell of
    side h holds m + s y + c (y^2 - h^2 / 12) / 2, y = x - x_c: its weights are the integrals of k times 1, y and
    (y^2 - h^2 / 12) / 2 over the cell.
    """
    h = 1.0 / f
    centre = (np.arange((2 * half + 1) * f) + 0.5) * h - half - 0.5
    node, weight = np.polynomial.legendre.leggauss(24)
    x = centre[:, None] + node * (h / 2)
    k = np.asarray(ndtr((x + 0.5) / sigma) - ndtr((x - 0.5) / sigma)) if sigma > 0 else (np.abs(x) < 0.5).astype(float)
    k = k * weight * (h / 2)
    y = node * (h / 2)
    kernel = np.stack([k.sum(axis=1), (k * y).sum(axis=1), (k * (y**2 - h**2 / 12) / 2).sum(axis=1)])
    return np.asarray(kernel / kernel[0].sum())


@njit(cache=True, nogil=True)
def _reduce_rows(cells: np.ndarray, k: np.ndarray, f: int, half: int, j_0: int, j_1: int, out: np.ndarray) -> None:
    last = cells.shape[1] - 1
    for j in range(j_0, j_1):
        out[:, j, :] = 0.0
        for a in range(k.shape[1]):
            row = (j - half) * f + a
            row = min(max(row, 0), last)
            k_0, k_1, k_2 = k[0, a], k[1, a], k[2, a]
            for i in range(cells.shape[2]):
                out[0, j, i] += k_0 * cells[0, row, i] + k_1 * cells[2, row, i] + k_2 * cells[5, row, i]
                out[1, j, i] += k_0 * cells[1, row, i] + k_1 * cells[3, row, i]
                out[2, j, i] += k_0 * cells[4, row, i]


@njit(cache=True, nogil=True)
def _reduce_columns(rows: np.ndarray, k: np.ndarray, f: int, half: int, j_0: int, j_1: int, out: np.ndarray) -> None:
    last = rows.shape[2] - 1
    for j in range(j_0, j_1):
        for i in range(out.shape[1]):
            total, start = 0.0, (i - half) * f
            for a in range(k.shape[1]):
                column = min(max(start + a, 0), last)
                total += k[0, a] * rows[0, j, column] + k[1, a] * rows[1, j, column] + k[2, a] * rows[2, j, column]
            out[j, i] = total


def to_pixels(cells: np.ndarray, *, f: int, sigma_u: float, sigma_v: float, threads: int = 1) -> Array:
    """Pixel values (n_v, n_u) of cells (HELD, n_v f, n_u f; see `cells`) under a Gaussian blur of sigma_u,
    sigma_v px."""
    from tomopose.simulation.projector.view import in_bands

    n_v, n_u = cells.shape[1] // f, cells.shape[2] // f
    half_u, half_v = margin(sigma_u), margin(sigma_v)
    kernel_u, kernel_v = pixel_kernel(sigma_u, f, half_u), pixel_kernel(sigma_v, f, half_v)
    rows, out = np.empty((3, n_v, n_u * f), dtype=np.float32), np.empty((n_v, n_u))
    in_bands(lambda lo, hi: _reduce_rows(cells, kernel_v, f, half_v, lo, hi, rows), n_v, threads)
    in_bands(lambda lo, hi: _reduce_columns(rows, kernel_u, f, half_u, lo, hi, out), n_v, threads)
    return out
