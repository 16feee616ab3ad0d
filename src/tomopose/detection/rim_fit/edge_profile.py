r"""Profiles across the rim of a blurred ball, tabulated over the signed distance s (px, outside positive).

With t(s) the share of the background that comes through (1 outside; inside exp(-kappa chord / diameter), or 0 for an
opaque ball) and * the convolution with a Gaussian of width sigma:

    O = t * g            share of the background level seen at s
    R = (s t) * g        share of the background's slope; for an opaque ball s Phi(s/sigma) + sigma phi(s/sigma)
    Q = (max(s, 0)^2 / 2) * g   share of its curvature, which is followed outside only

The convolution is taken along the normal of the rim; what the rim's curvature adds, a shift by sigma^2 / 2 radius, is
the same all round and leaves the centre alone.  sigma d/dsigma comes from the second derivative (heat equation).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomopose.units import Array

OPAQUE, COLUMNS = 5, 10
"""O, O', O'', R, Q and, where X-rays pass the ball, R', R'', dO/dkappa, dR/dkappa, Q'; of an opaque one R' = O,
R'' = O' and Q' = R."""

STEPS_PER_SIGMA = 32
REACH = 6.0
"""Gaussian tails beyond this many sigmas (1e-9) count as zero."""
PHI = np.array([0.5 * math.erfc(-k / STEPS_PER_SIGMA / math.sqrt(2)) for k in range(-288, 289)])
PHI_PRIME = np.exp(-0.5 * (np.arange(-288, 289) / STEPS_PER_SIGMA) ** 2) / math.sqrt(2 * math.pi)
"""The normal distribution and its density on the table's grid, up to 9 sigmas, where they are 0 or 1 to 1e-18."""
DEPTH_NODES = 160
PIXEL_CUMULANT = -0.75 / 120.0
"""Fourth cumulant of a square pixel across an edge, px^4, mean over the edge's directions: a box is no Gaussian.
It adds kappa_4 / 24 times the fourth derivative of O."""


def edge_profile(sigma: float, kappa: float, radius: float, s_low: float, s_high: float) -> tuple[Array, float, float]:
    """(table (n, 5 or 10), first s, step): the profiles for s in [s_low, s_high]; kappa = inf is an opaque ball."""
    step = sigma / STEPS_PER_SIGMA
    first = math.floor(s_low / step)
    return _table(sigma, kappa, radius, first, math.ceil(s_high / step) - first + 2), first * step, step


@njit(cache=True)
def _table(sigma, kappa, radius, first, n):  # type: ignore[no-untyped-def]
    opaque = math.isinf(kappa)
    out = np.zeros((n, OPAQUE if opaque else COLUMNS))
    middle = PHI.shape[0] // 2
    for i in range(n):
        x = (first + i) / STEPS_PER_SIGMA
        s, at = x * sigma, min(max(first + i + middle, 0), 2 * middle)
        Phi, phi = PHI[at], PHI_PRIME[at] / sigma
        out[i, 0] = Phi - PIXEL_CUMULANT / 24.0 * (x * x * x - 3.0 * x) / sigma**3 * phi
        out[i, 1] = phi
        out[i, 2] = -x / sigma * phi
        out[i, 3] = s * Phi + sigma * sigma * phi
        out[i, 4] = 0.5 * ((s * s + sigma * sigma) * Phi + s * sigma * sigma * phi)
        if not opaque:
            out[i, 5] = Phi
            out[i, 6] = phi
            out[i, 9] = out[i, 3]
            _add_inside(out, i, s, sigma, kappa, radius)
    return out


@njit(cache=True)
def _add_inside(out, i, s, sigma, kappa, radius):  # type: ignore[no-untyped-def]
    """Adds the part that comes through the ball: depth = q^2 below the rim smooths the square root of the chord."""
    low, high = max(0.0, -s - REACH * sigma), min(2.0 * radius, -s + REACH * sigma)
    if high <= low:
        return
    q_low, q_high = math.sqrt(low), math.sqrt(high)
    h = (q_high - q_low) / DEPTH_NODES
    for k in range(DEPTH_NODES):
        q = q_low + (k + 0.5) * h
        depth = q * q
        chord = math.sqrt(max(0.0, 1.0 - (1.0 - depth / radius) ** 2))
        x = (s + depth) / sigma
        g = math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi) / sigma * 2.0 * q * h
        first, second = -x / sigma, (x * x - 1.0) / (sigma * sigma)
        t = math.exp(-kappa * chord) * g
        out[i, 0] += t
        out[i, 1] += t * first
        out[i, 2] += t * second
        out[i, 3] -= t * depth
        out[i, 5] -= t * depth * first
        out[i, 6] -= t * depth * second
        out[i, 7] -= t * chord
        out[i, 8] += t * chord * depth
