"""Values and derivatives of a volume between its voxels.

Interpolation by cubic B-splines: the coefficients follow from the voxels by the recursive filter of Unser, IEEE
Signal Process. Mag. 16(6) (1999) 22, with mirrored ends; the influence of a voxel falls by 0.27 a voxel.  Gradients for
normals are those of the volume smoothed by a Gaussian, summed where they are wanted instead of over the volume.
All positions here are fractional indices (iz, iy, ix) into the array.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from tomopose.kernel_cache import njit
from tomopose.units import Array

POLE = math.sqrt(3.0) - 2.0
REACH = 14
"""Voxels after which the filter's memory has fallen below 1e-8."""
GAUSS_REACH = 4.0


def spline_coefficients(values: np.ndarray) -> np.ndarray:
    """B-spline coefficients, float32, of a volume [z, y, x] of at least two voxels along each axis."""
    c = np.array(values, dtype=np.float32, order="C")
    _filter_along_x(c)
    _filter_along_y(c)
    _filter_along_z(c)
    return c


@njit(cache=True)
def _filter_row(row: np.ndarray) -> Any:
    n = row.shape[0]
    total, power = 0.0, 1.0
    for k in range(min(n, 2 * REACH)):
        total += power * row[k]
        power *= POLE
    row[0] = total
    for k in range(1, n):
        row[k] += POLE * row[k - 1]
    row[n - 1] = POLE / (POLE * POLE - 1.0) * (row[n - 1] + POLE * row[n - 2])
    for k in range(n - 2, -1, -1):
        row[k] = POLE * (row[k + 1] - row[k])
    for k in range(n):
        row[k] *= 6.0


@njit(cache=True, parallel=True)
def _filter_along_x(c: np.ndarray) -> Any:
    for z in prange(c.shape[0]):
        row = np.empty(c.shape[2])
        for y in range(c.shape[1]):
            row[:] = c[z, y]
            _filter_row(row)
            c[z, y] = row


@njit(cache=True, parallel=True)
def _filter_along_y(c: np.ndarray) -> Any:
    for z in prange(c.shape[0]):
        _filter_plane(c[z])


@njit(cache=True, parallel=True)
def _filter_along_z(c: np.ndarray) -> Any:
    for y in prange(c.shape[1]):
        _filter_plane(c[:, y])


@njit(cache=True)
def _filter_plane(plane: np.ndarray) -> Any:
    """The filter along the first axis, a whole row at a time."""
    n, m = plane.shape
    first = np.zeros(m)
    power = 1.0
    for k in range(min(n, 2 * REACH)):
        for x in range(m):
            first[x] += power * plane[k, x]
        power *= POLE
    for x in range(m):
        plane[0, x] = first[x]
    for k in range(1, n):
        for x in range(m):
            plane[k, x] += POLE * plane[k - 1, x]
    gain = POLE / (POLE * POLE - 1.0)
    for x in range(m):
        plane[n - 1, x] = gain * (plane[n - 1, x] + POLE * plane[n - 2, x])
    for k in range(n - 2, -1, -1):
        for x in range(m):
            plane[k, x] = POLE * (plane[k + 1, x] - plane[k, x])
    for k in range(n):
        for x in range(m):
            plane[k, x] *= 6.0


@njit(cache=True, inline="always")
def _weights(t: float) -> Any:
    """The four cubic B-spline weights at the fraction t of a voxel."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    )


@njit(cache=True)
def spline_value(c: Array, z: float, y: float, x: float) -> Any:
    """The spline at (z, y, x), which must lie at least one voxel inside the array."""
    iz, iy, ix = math.floor(z), math.floor(y), math.floor(x)
    wz, wy, wx = _weights(z - iz), _weights(y - iy), _weights(x - ix)
    total = 0.0
    for k in range(4):
        plane = 0.0
        for j in range(4):
            row = c[iz - 1 + k, iy - 1 + j]
            line = wx[0] * row[ix - 1] + wx[1] * row[ix] + wx[2] * row[ix + 1] + wx[3] * row[ix + 2]
            plane += wy[j] * line
        total += wz[k] * plane
    return total


@njit(cache=True)
def _gauss(position: float, sigma: float, centre: float, reach: int, out: Array) -> Any:
    """Normalised Gaussian weights, their first and second derivatives, at the voxels around `position`."""
    norm = 0.0
    for k in range(2 * reach + 1):
        d = centre - reach + k - position
        w = math.exp(-0.5 * (d / sigma) ** 2)
        out[0, k] = w
        out[1, k] = w * d / sigma**2
        out[2, k] = w * ((d / sigma) ** 2 - 1.0) / sigma**2
        norm += w
    for k in range(2 * reach + 1):
        for j in range(3):
            out[j, k] /= norm


@njit(cache=True, parallel=True)
def smoothed_gradients(values: np.ndarray, index: Array, sigma: float) -> Any:
    """(n, 3) gradients (d/dz, d/dy, d/dx), per voxel, of the volume smoothed by a Gaussian of `sigma` voxels, at index
    (n, 3).  Voxels beyond the border repeat the outermost."""
    reach = math.ceil(GAUSS_REACH * sigma)
    out = np.zeros((index.shape[0], 3))
    for n in prange(index.shape[0]):
        taps = np.empty((3, 3, 2 * reach + 1))
        centre = np.empty(3, dtype=np.int64)
        for a in range(3):
            centre[a] = round(min(max(index[n, a], -1.0 * reach), values.shape[a] - 1.0 + reach))
            _gauss(index[n, a], sigma, centre[a], reach, taps[a])
        for k in range(2 * reach + 1):
            z = min(max(centre[0] - reach + k, 0), values.shape[0] - 1)
            for j in range(2 * reach + 1):
                y = min(max(centre[1] - reach + j, 0), values.shape[1] - 1)
                line, slope = 0.0, 0.0
                for i in range(2 * reach + 1):
                    x = min(max(centre[2] - reach + i, 0), values.shape[2] - 1)
                    g = values[z, y, x]
                    line += taps[2, 0, i] * g
                    slope += taps[2, 1, i] * g
                out[n, 0] += taps[0, 1, k] * taps[1, 0, j] * line
                out[n, 1] += taps[0, 0, k] * taps[1, 1, j] * line
                out[n, 2] += taps[0, 0, k] * taps[1, 0, j] * slope
    return out


@njit(cache=True, parallel=True)
def smoothed_curvatures(values: np.ndarray, index: Array, spacing: Array, sigma: float) -> Any:
    """(n,) mean curvature (k_1 + k_2) / 2, 1/mm, of the grey level's surface through index (n, 3), smoothed likewise.

    Positive where the brighter side is convex: -div(grad g / |grad g|) / 2.  spacing: (z, y, x) in mm.
    """
    reach = math.ceil(GAUSS_REACH * sigma)
    out = np.zeros(index.shape[0])
    for n in prange(index.shape[0]):
        taps = np.empty((3, 3, 2 * reach + 1))
        centre = np.empty(3, dtype=np.int64)
        for a in range(3):
            centre[a] = round(min(max(index[n, a], -1.0 * reach), values.shape[a] - 1.0 + reach))
            _gauss(index[n, a], sigma, centre[a], reach, taps[a])
        g, H = np.zeros(3), np.zeros((3, 3))
        for k in range(2 * reach + 1):
            z = min(max(centre[0] - reach + k, 0), values.shape[0] - 1)
            for j in range(2 * reach + 1):
                y = min(max(centre[1] - reach + j, 0), values.shape[1] - 1)
                line, slope, bend = 0.0, 0.0, 0.0
                for i in range(2 * reach + 1):
                    x = min(max(centre[2] - reach + i, 0), values.shape[2] - 1)
                    v = values[z, y, x]
                    line += taps[2, 0, i] * v
                    slope += taps[2, 1, i] * v
                    bend += taps[2, 2, i] * v
                g[0] += taps[0, 1, k] * taps[1, 0, j] * line
                g[1] += taps[0, 0, k] * taps[1, 1, j] * line
                g[2] += taps[0, 0, k] * taps[1, 0, j] * slope
                H[0, 0] += taps[0, 2, k] * taps[1, 0, j] * line
                H[1, 1] += taps[0, 0, k] * taps[1, 2, j] * line
                H[2, 2] += taps[0, 0, k] * taps[1, 0, j] * bend
                H[0, 1] += taps[0, 1, k] * taps[1, 1, j] * line
                H[0, 2] += taps[0, 1, k] * taps[1, 0, j] * slope
                H[1, 2] += taps[0, 0, k] * taps[1, 1, j] * slope
        square, trace, bent = 0.0, 0.0, 0.0
        for a in range(3):
            g[a] /= spacing[a]
            square += g[a] * g[a]
            for b in range(a, 3):
                H[a, b] /= spacing[a] * spacing[b]
                H[b, a] = H[a, b]
        for a in range(3):
            trace += H[a, a]
            for b in range(3):
                bent += g[a] * H[a, b] * g[b]
        if square > 0.0:
            out[n] = -0.5 * (trace - bent / square) / math.sqrt(square)
    return out


def index_gradient_to_W(gradient: Array, spacing: Array) -> Array:
    """Gradients (n, 3) per voxel as (d/dz, d/dy, d/dx) to (d/dx, d/dy, d/dz) per mm; spacing is (x, y, z)."""
    return gradient[:, ::-1] / spacing
