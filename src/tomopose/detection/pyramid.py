"""Finding, first half: edges of a coarse image vote for the centres of circles (radial symmetry), both polarities."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomopose.units import Array

MOST = 10
"""Centres of a level that are looked at, those with most votes."""
SMALLEST, LARGEST = 3.4, 14.5
"""Radii, in px of a level, that are looked for on it; levels follow by factors of 2."""
BANDS = ((3.4, 5.6), (5.6, 9.0), (9.0, 14.5))


@njit(cache=True, fastmath=True)
def block_mean(image, factor):  # type: ignore[no-untyped-def]
    """float32 mean over factor x factor blocks; rows and columns that fill no block are dropped."""
    rows, columns = image.shape[0] // factor, image.shape[1] // factor
    out = np.empty((rows, columns), np.float32)
    scale = np.float32(1.0 / (factor * factor))
    line = np.empty(columns * factor, np.float32)
    for j in range(rows):
        line[:] = 0.0
        for y in range(factor):
            row = image[j * factor + y]
            for x in range(columns * factor):
                line[x] += np.float32(row[x])
        for i in range(columns):
            total = np.float32(0.0)
            for x in range(factor):
                total += line[i * factor + x]
            out[j, i] = total * scale
    return out


@njit(cache=True)
def _gradient_square(image):  # type: ignore[no-untyped-def]
    rows, columns = image.shape
    out = np.zeros((rows, columns), np.float32)
    for j in range(1, rows - 1):
        for i in range(1, columns - 1):
            gu = image[j, i + 1] - image[j, i - 1]
            gv = image[j + 1, i] - image[j - 1, i]
            out[j, i] = gu * gu + gv * gv
    return out


@njit(cache=True)
def _votes(image, square, threshold, bands):  # type: ignore[no-untyped-def]
    """(polarity, band, rows, columns): 1 for a full circle about that centre; polarity 0 is dark inside."""
    rows, columns = image.shape
    out = np.zeros((2, bands.shape[0], rows, columns), np.float32)
    for j in range(1, rows - 1):
        for i in range(1, columns - 1):
            here = square[j, i]
            if not here > threshold:
                continue
            gu = image[j, i + 1] - image[j, i - 1]
            gv = image[j + 1, i] - image[j - 1, i]
            length = math.sqrt(here)
            gu, gv = gu / length, gv / length
            du, dv = round(gu), round(gv)
            if square[j + dv, i + du] > here or square[j - dv, i - du] >= here:
                continue
            for band in range(bands.shape[0]):
                low, high = math.ceil(bands[band, 0]), int(bands[band, 1])
                for radius in range(low, high + 1):
                    weight = 1.0 / (2.0 * math.pi * radius)
                    for side in range(2):
                        sign = -1.0 if side == 0 else 1.0
                        x, y = round(i + sign * radius * gu), round(j + sign * radius * gv)
                        if 0 <= x < columns and 0 <= y < rows:
                            out[side, band, y, x] += weight
    return out


@njit(cache=True)
def _peaks(votes, reach, least, most):  # type: ignore[no-untyped-def]
    """(n, 3): u, v, votes of the highest local maxima of votes summed over (2 reach + 1)^2 pixels."""
    rows, columns = votes.shape
    total = np.zeros((rows, columns), np.float32)
    line = np.zeros((rows, columns), np.float32)
    for j in range(rows):
        for i in range(columns):
            if votes[j, i] != 0.0:
                for x in range(max(0, i - reach), min(columns, i + reach + 1)):
                    line[j, x] += votes[j, i]
    for j in range(rows):
        for i in range(columns):
            if line[j, i] != 0.0:
                for y in range(max(0, j - reach), min(rows, j + reach + 1)):
                    total[y, i] += line[j, i]
    out = np.zeros((most, 3))
    size = 0
    for j in range(rows):
        for i in range(columns):
            here = total[j, i]
            if here < least or (size == most and here <= out[size - 1, 2]):
                continue
            highest = True
            for y in range(max(0, j - 2), min(rows, j + 3)):
                for x in range(max(0, i - 2), min(columns, i + 3)):
                    if total[y, x] > here or (total[y, x] == here and (y < j or (y == j and x < i))):
                        highest = False
            if not highest:
                continue
            place = min(size, most - 1)
            while place > 0 and out[place - 1, 2] < here:
                out[place] = out[place - 1]
                place -= 1
            out[place, 0], out[place, 1], out[place, 2] = i, j, here
            size = min(size + 1, most)
    return out[:size]


def circle_centres(level: Array, most: int = 3) -> tuple[float, list[tuple[float, float, float, float, int]]]:
    """Noise of a pixel, and (u, v, low radius, high radius, polarity) of places that edges point to or away from."""
    if min(level.shape) < 9:
        return 0.0, []
    square = _gradient_square(level)
    sample = square[1:-1:3, 1:-1:3]
    # For normal noise |grad|^2 is exponential with mean 2 s^2: its lower quartile is 0.575 s^2, whatever the edges, and
    # s^2 = 2 sigma^2 for the difference of two pixels.
    noise = float(np.quantile(sample, 0.25)) / 0.575 / 2
    top = float(square.max())
    threshold = max(36.0 * noise, 2e-5 * top)
    if not top > threshold:
        return math.sqrt(noise), []
    votes = _votes(level, square, np.float32(threshold), np.array(BANDS))
    found: list[tuple[float, float, float, float, float, int]] = []
    for polarity in range(2):
        for band, (low, high) in enumerate(BANDS):
            for u, v, count in _peaks(votes[polarity, band], 1 if band == 0 else 2, 0.3, most):
                found.append((-float(count), float(u), float(v), low, high, polarity))
    return math.sqrt(noise), [f[1:] for f in sorted(found)[:MOST]]
