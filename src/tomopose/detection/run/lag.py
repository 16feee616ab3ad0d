"""Lag: the previous pose's ball, faintly left in this image by the detector's afterglow; measured and corrected.

An image with lag is the present one plus a share of the previous, and that share is what remains of the step across the
previous ball's rim.  The previous image times the share is subtracted and the ball is measured again; what the share's
own uncertainty leaves of the centre's shift D is added to the covariance: (u(share) / share)^2 D D'.  Where the two
balls overlap, so that the previous rim cannot be seen, the share is what the run's earlier images have shown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.detection.reading import Image, native_part
from tomopose.detection.settings import RunSettings
from tomopose.units import Array

ARCS, FEWEST_ARCS, FEWEST_PIXELS = 48, 8, 4
"""Arcs that the previous rim is divided into, those that a median requires, and the pixels on each side of one."""
OVERLAP = 4.0
"""Distance of the two balls, px, below which their rims cannot be distinguished."""
MEDIAN_LOSS = 1.2533
"""Standard deviation of a median over that of the mean, for normal values."""


class Lag(NamedTuple):
    """Share of the ball's contrast that remains where the previous ball was, and its standard deviation."""

    share: float
    sigma: float


NO_LAG = Lag(0.0, 0.0)


def usual_lag(measured: Sequence[Lag]) -> Lag:
    """The median of those that the run has shown; a single one keeps its own uncertainty."""
    if not measured:
        return NO_LAG
    share = np.array([lag.share for lag in measured])
    own = float(np.median([lag.sigma for lag in measured]))
    spread = float(share.std(ddof=1)) if len(share) > 2 else own
    return Lag(float(np.median(share)), MEDIAN_LOSS * max(own, spread) / math.sqrt(len(share)))


class Ball(NamedTuple):
    """Centre (u, v) and radius, px, of a measured ball."""

    u: float
    v: float
    radius: float


def measured_lag(
    window: Array, corner: tuple[int, int], here: Ball, previous: Ball, *, contrast: float, aspect: float,
    settings: RunSettings,
) -> Lag | None:  # fmt: skip
    """What is left of the previous ball; NO_LAG where that is not significant, None where it cannot be measured.

    The step across the previous rim is measured on each of many short arcs that lie clear of the present ball, inside
    against outside at 2 to 5 px, and their median is taken: a holder's edge disturbs a few arcs only.
    """
    if math.hypot(previous.u - here.u, (previous.v - here.v) * aspect) < OVERLAP:
        return None
    v, u = np.mgrid[: window.shape[0], : window.shape[1]]
    u, v = u + float(corner[0]), v + float(corner[1])
    clear = np.hypot(u - here.u, (v - here.v) * aspect) > here.radius + 10.0
    du, dv = u - previous.u, (v - previous.v) * aspect
    s = np.hypot(du, dv) - previous.radius
    clear &= np.isfinite(window) & (np.abs(s) < 5.0) & (np.abs(s) > 2.0)
    arc = np.floor((np.arctan2(dv, du) / (2 * math.pi) + 0.5) * ARCS * (1 - 1e-12)).astype(int)
    steps = []
    for k in range(ARCS):
        inside, outside = window[clear & (arc == k) & (s < 0)], window[clear & (arc == k) & (s > 0)]
        if min(inside.size, outside.size) >= FEWEST_PIXELS:
            steps.append(float(outside.mean() - inside.mean()))
    if len(steps) < FEWEST_ARCS:
        return None
    values = np.array(steps)
    step = float(np.median(values))
    sigma = MAD_TO_SIGMA * MEDIAN_LOSS * float(np.median(np.abs(values - step))) / math.sqrt(len(values))
    found = Lag(step / contrast, sigma / abs(contrast))
    evident = abs(step) > settings.lag_significant * sigma
    return found if found.share > settings.lag_smallest and evident else NO_LAG


class WithoutLag:
    """An image less a share of the previous one, of which only what is asked for is read."""

    def __init__(self, image: Image, previous: Image, share: float) -> None:
        self.image, self.previous, self.share = image, previous, share

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(getattr(self.image, "shape", None) or np.shape(self.image))

    def region(self, v0: int, v1: int, u0: int, u1: int) -> Array:
        box = (v0, v1, u0, u1)
        part = native_part(self.image, box).astype(np.float64)
        return np.asarray(part - self.share * native_part(self.previous, box).astype(np.float64))
