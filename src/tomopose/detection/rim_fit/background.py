"""The background of the whole ring before the fit: robust against hot pixels, and without dead rows and columns."""

from __future__ import annotations

import numpy as np
from numba import njit

from tomopose.detection.rim_fit.order_statistics import median
from tomopose.detection.rim_fit.rim import STAY, Rim

GROSS = 0.1
"""Share of the contrast from which a residual can spoil a least-squares start."""
LINE = 6
"""Pixels with gross residuals from which a row or column may be a dead one."""
MOST_LINES = 6
"""Times that dead lines are looked for."""


@njit(cache=True)
def without_outliers(s, image, value, clear, least, weight):  # type: ignore[no-untyped-def]
    """(n,) the same weight for all pixels but those farther than `clear` from the rim that are outliers, by `least` at
    least and 8 standard deviations."""
    size, m = np.empty(s.shape[0]), 0
    for i in range(s.shape[0]):
        if abs(s[i]) > clear:
            size[m] = abs(image[i] - value[i])
            m += 1
    most = max(8 * 1.4826 * median(size[:m]), least) if m > 0 else np.inf
    out = np.full(s.shape[0], weight)
    for i in range(s.shape[0]):
        if abs(s[i]) > clear and abs(image[i] - value[i]) > most:
            out[i] = 0.0
    return out


def whole_ring(rim: Rim, spread: float) -> None:
    """From some of the pixels near the rim to all of the ring, with its background."""
    rim.outside, rim.every = rim.reach, 1
    rim.gather()
    rim.linear = True
    _robust_background(rim, spread)
    rim.linear = False
    rim.forget()


def _robust_background(rim: Rim, spread: float) -> None:
    """The background alone; dead lines and hot pixels, if there are any, get little weight (Cauchy)."""
    equal = np.full(rim.u.size, 1.0 / (0.03 * spread) ** 2)
    rim.weight = equal
    rim.evaluate(STAY)
    active = rim.active(curvature=False)
    rim.step(active)
    away = np.abs(rim.rim[0]) > 3.0
    for _ in range(6):
        size = np.abs(rim.residual[away])
        if size.size == 0 or size.max() < GROSS * abs(rim.level - rim.white):
            break
        scale = 1.4826 * float(np.median(size)) + 1e-9 * spread
        if size.max() < 9.0 * scale:
            break
        x = np.where(away, rim.residual / (3.0 * scale), 0.0)
        rim.weight = equal / (1.0 + x**2) ** 2
        rim.step(active)


def without_worst_lines(rim: Rim) -> bool:
    """Counts those rows and columns as bad whose pixels on the ring mostly have gross residuals, if there are any.

    Pixel by pixel they would go too, but not on the rim, where a line's value may look like the ball's.  The worst go
    first, since they spoil the background for others.
    """
    away = np.abs(rim.rim[0]) > 3.0
    size = np.abs(rim.residual)
    gross = away & (size > GROSS * abs(rim.level - rim.white))
    if np.count_nonzero(gross) < LINE:
        return False
    gross &= size > 9.0 * float(np.median(size[away]))
    found = []
    for index, axis in ((rim.v - rim.origin[1], 0), (rim.u - rim.origin[0], 1)):
        at, n = index.astype(np.int64), rim.good.shape[axis]
        of, bad = np.bincount(at[away], minlength=n), np.bincount(at[gross], minlength=n)
        mean = np.bincount(at[gross], size[gross], minlength=n) / np.maximum(bad, 1)
        found += [(mean[i], axis, i) for i in np.flatnonzero((bad >= LINE) & (bad > 0.5 * of))]
    if not found:
        return False
    rim.good = rim.good.copy()
    worst = max(found)[0]
    for mean_size, axis, i in found:
        if mean_size > 0.7 * worst:
            rim.good[(i, slice(None)) if axis == 0 else (slice(None), i)] = False
    return True
