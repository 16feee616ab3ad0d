"""Lag: the previous pose's ball, faintly left in this image by the detector's afterglow."""

from __future__ import annotations

import math

import numpy as np

from tomopose.units import Array

SIGNIFICANT = 6.0
SMALLEST = 0.002
"""Share of the contrast below which a ghost is of no consequence."""


def ghost_share(
    window: Array, corner: tuple[int, int], here: Array, radius: float, previous: Array, previous_radius: float,
    contrast: float, aspect: float,
) -> float:  # fmt: skip
    """Share of the ball's contrast that remains where the previous ball was; 0 where it is not significant.

    The step across the previous rim is measured on each of many short arcs that lie clear of the present ball, inside
    against outside at 2 to 5 px, and their median is taken: a holder's edge disturbs a few arcs only.
    """
    if math.hypot(previous[0] - here[0], (previous[1] - here[1]) * aspect) < 4.0:
        return 0.0
    v, u = np.mgrid[: window.shape[0], : window.shape[1]]
    u, v = u + float(corner[0]), v + float(corner[1])
    clear = np.hypot(u - here[0], (v - here[1]) * aspect) > radius + 10.0
    du, dv = u - previous[0], (v - previous[1]) * aspect
    s = np.hypot(du, dv) - previous_radius
    clear &= np.isfinite(window) & (np.abs(s) < 5.0) & (np.abs(s) > 2.0)
    arcs = 48
    arc = np.floor((np.arctan2(dv, du) / (2 * math.pi) + 0.5) * arcs * (1 - 1e-12)).astype(int)
    steps = []
    for k in range(arcs):
        inside, outside = window[clear & (arc == k) & (s < 0)], window[clear & (arc == k) & (s > 0)]
        if inside.size >= 4 and outside.size >= 4:
            steps.append(float(outside.mean() - inside.mean()))
    if len(steps) < 8:
        return 0.0
    values = np.array(steps)
    step = float(np.median(values))
    uncertainty = 1.4826 * 1.2533 * float(np.median(np.abs(values - step))) / math.sqrt(len(values))
    share = step / contrast
    return share if share > SMALLEST and abs(step) > SIGNIFICANT * uncertainty else 0.0
