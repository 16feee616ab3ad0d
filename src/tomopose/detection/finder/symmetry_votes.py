"""Finding, first half: edges of a coarse image vote for the centres of circles (radial symmetry), both polarities."""

from __future__ import annotations

import math

import numpy as np

from tomopose.kernel_cache import njit
from tomopose.units import Array

SMALLEST, LARGEST = 3.4, 14.5
"""Radii, in px of a level, that are looked for on it; levels follow by factors of 2."""
BANDS = ((3.4, 5.6), (5.6, 9.0), (9.0, 14.5))
VOTED = np.array([(math.ceil(low), int(high)) for low, high in BANDS])


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
def _gradient_square(image, out):  # type: ignore[no-untyped-def]
    """out (rows, columns): the squared gradient, but at the border."""
    for j in range(1, image.shape[0] - 1):
        for i in range(1, image.shape[1] - 1):
            gu = image[j, i + 1] - image[j, i - 1]
            gv = image[j + 1, i] - image[j - 1, i]
            out[j, i] = gu * gu + gv * gv


@njit(cache=True, inline="always")
def _vote_along(out, band, i, j, du, dv, radii):  # type: ignore[no-untyped-def]
    """The votes of an edge at (i, j) for the centres of a band's radii in the direction (du, dv)."""
    for radius in range(radii[band, 0], radii[band, 1] + 1):
        x, y = round(i + radius * du), round(j + radius * dv)
        if 0 <= x < out.shape[2] and 0 <= y < out.shape[1]:
            out[band, y, x] += 1.0 / (2.0 * math.pi * radius)


@njit(cache=True)
def _votes(image, square, threshold, radii, out):  # type: ignore[no-untyped-def]
    """Adds to `out` (polarity, band, rows, columns): 1 for a full circle about that centre; polarity 0 is dark inside.

    radii: (bands, 2), the first and the last of each band that an edge votes for.
    """
    for j in range(1, image.shape[0] - 1):
        for i in range(1, image.shape[1] - 1):
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
            for k in range(2 * radii.shape[0]):
                sign = -1.0 if k < radii.shape[0] else 1.0
                _vote_along(out[k // radii.shape[0]], k % radii.shape[0], i, j, sign * gu, sign * gv, radii)


@njit(cache=True)
def _maxima(votes, reach, least, total, out):  # type: ignore[no-untyped-def]
    """Writes u, v, votes of the local maxima of at least so many votes into out, and returns how many there are.

    total (rows, columns): zeros; becomes the votes summed over (2 reach + 1)^2 pixels.  A maximum has no higher pixel
    within 2 px; of equal ones the first counts.
    """
    rows, columns = votes.shape
    for j in range(rows):
        for i in range(columns):
            if votes[j, i] == 0.0:
                continue
            for y in range(max(0, j - reach), min(rows, j + reach + 1)):
                for x in range(max(0, i - reach), min(columns, i + reach + 1)):
                    total[y, x] += votes[j, i]
    n = 0
    for j in range(rows):
        for i in range(columns):
            here = total[j, i]
            highest = here >= least and here > 0.0
            for k in range(25 if highest else 0):
                y, x = j + k // 5 - 2, i + k % 5 - 2
                if 0 <= y < rows and 0 <= x < columns:
                    highest &= not (total[y, x] > here or (k < 12 and total[y, x] == here))
            if highest:
                out[n, 0], out[n, 1], out[n, 2] = i, j, here
                n += 1
    return n


def _peaks(votes: Array, reach: int, least: float, most: int) -> Array:
    """(n, 3), n <= most: u, v, votes of the highest local maxima of votes summed over (2 reach + 1)^2 pixels."""
    # two maxima lie at least 3 px apart along u or v
    out = np.empty((-(-votes.shape[0] // 3) * -(-votes.shape[1] // 3), 3))
    n = _maxima(votes, reach, least, np.zeros_like(votes), out)
    return _highest(out[:n], most)


def _highest(rows: Array, most: int) -> Array:
    """The rows whose last column is highest, highest first; of equal ones the first."""
    return np.asarray(rows[np.argsort(-rows[:, -1], kind="stable")[:most]])


def circle_centres(
    level: Array, least_votes: float, edge_noise: float, edge_share: float, most: int, peaks: int
) -> tuple[float, Array]:
    """(noise of a pixel, (n, 5)): u, v, band, polarity, votes of places that edges point to or away from, most first.

    level: float32; the rest: of FinderSettings.  The polarity is 0 for an inside darker than its surroundings, 1
    for a brighter one.
    """
    if min(level.shape) < 9:
        return 0.0, np.empty((0, 5))
    square = np.zeros_like(level)
    _gradient_square(level, square)
    # For normal noise |grad|^2 is exponential with mean 2 s^2: its lower quartile is 0.575 s^2, whatever the edges, and
    # s^2 = 2 sigma^2 for the difference of two pixels.
    sample = square[1:-1:3, 1:-1:3].ravel()
    noise = float(np.partition(sample, sample.size // 4)[sample.size // 4]) / 0.575 / 2
    top = float(square.max())
    threshold = np.float32(max(edge_noise**2 * noise, edge_share**2 * top))
    found = [np.empty((0, 5))]
    if top > threshold:
        votes = np.zeros((2, len(BANDS), *level.shape), np.float32)
        _votes(level, square, threshold, VOTED, votes)
        for polarity in range(2):
            for band in range(len(BANDS)):
                u, v, count = _peaks(votes[polarity, band], 1 if band == 0 else 2, least_votes, peaks).T
                found.append(np.column_stack([u, v, np.full(len(u), band), np.full(len(u), polarity), count]))
    return math.sqrt(noise), _highest(np.concatenate(found), most)
