"""Finding, first half: edges of a coarse image vote for the centres of circles (radial symmetry), both polarities."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomopose.detection.order_statistics import select

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
def _vote_along(out, band, i, j, du, dv):  # type: ignore[no-untyped-def]
    """The votes of an edge at (i, j) for the centres of a band's radii in the direction (du, dv)."""
    for radius in range(math.ceil(BANDS[band][0]), int(BANDS[band][1]) + 1):
        x, y = round(i + radius * du), round(j + radius * dv)
        if 0 <= x < out.shape[1] and 0 <= y < out.shape[0]:
            out[y, x] += 1.0 / (2.0 * math.pi * radius)


@njit(cache=True)
def _votes(image, square, threshold):  # type: ignore[no-untyped-def]
    """(polarity, band, rows, columns): 1 for a full circle about that centre; polarity 0 is dark inside."""
    rows, columns = image.shape
    out = np.zeros((2, len(BANDS), rows, columns), np.float32)
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
            for band in range(len(BANDS)):
                _vote_along(out[0, band], band, i, j, -gu, -gv)
                _vote_along(out[1, band], band, i, j, gu, gv)
    return out


@njit(cache=True)
def _peaks(votes, reach, least, most):  # type: ignore[no-untyped-def]
    """(n, 3), n <= most: u, v, votes of the highest local maxima of votes summed over (2 reach + 1)^2 pixels."""
    rows, columns = votes.shape
    total = np.zeros((rows, columns), np.float32)
    for j in range(rows):
        for i in range(columns):
            if votes[j, i] != 0.0:
                total[max(0, j - reach) : j + reach + 1, max(0, i - reach) : i + reach + 1] += votes[j, i]
    out = np.zeros((most, 3))
    for j in range(rows):
        for i in range(columns):
            here = total[j, i]
            if here >= least and here > out[most - 1, 2] and _is_highest(total, i, j):
                _rank(out, np.array([i, j, here]))
    return out[: np.sum(out[:, 2] > 0.0)]


@njit(cache=True)
def _is_highest(total, i, j):  # type: ignore[no-untyped-def]
    """Whether no pixel within 2 px is higher; of equal ones the first counts."""
    here = total[j, i]
    for y in range(max(0, j - 2), min(total.shape[0], j + 3)):
        for x in range(max(0, i - 2), min(total.shape[1], i + 3)):
            if total[y, x] > here or (total[y, x] == here and (y < j or (y == j and x < i))):
                return False
    return True


@njit(cache=True)
def circle_centres(level, least_votes, edge_noise, edge_share, most, peaks):  # type: ignore[no-untyped-def]
    """(noise of a pixel, (n, 5)): u, v, band, polarity, votes of places that edges point to or away from, most first.

    level: float32; the rest: of FinderSettings.  The polarity is 0 for an inside darker than its surroundings, 1
    for a brighter one.
    """
    found = np.zeros((most, 5))
    if min(level.shape) < 9:
        return 0.0, found[:0]
    square = _gradient_square(level)
    # For normal noise |grad|^2 is exponential with mean 2 s^2: its lower quartile is 0.575 s^2, whatever the edges, and
    # s^2 = 2 sigma^2 for the difference of two pixels.
    sample = square[1:-1:3, 1:-1:3].copy().ravel()
    noise = select(sample, sample.shape[0] // 4) / 0.575 / 2
    top = np.max(square)
    threshold = np.float32(max(edge_noise**2 * noise, edge_share**2 * top))
    if top > threshold:
        votes = _votes(level, square, threshold)
        for polarity in range(2):
            for band in range(len(BANDS)):
                for u, v, count in _peaks(votes[polarity, band], 1 if band == 0 else 2, least_votes, peaks):
                    _rank(found, np.array([u, v, band, polarity, count]))
    return math.sqrt(noise), found[: np.sum(found[:, 4] > 0.0)]


@njit(cache=True)
def _rank(table, row):  # type: ignore[no-untyped-def]
    """Inserts the row into a table that its last column orders downwards; the last row falls out."""
    place = table.shape[0]
    while place > 0 and table[place - 1, -1] < row[-1]:
        if place < table.shape[0]:
            table[place] = table[place - 1]
        place -= 1
    if place < table.shape[0]:
        table[place] = row
