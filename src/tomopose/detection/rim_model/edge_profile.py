r"""Profiles across the rim of a blurred ball, tabulated over the signed distance s (px, outside positive).

With r = R + s the distance from the centre of a ball of silhouette radius R, t(r) the share of the background that
passes (1 outside; inside exp(-kappa chord / diameter), or 0 for an opaque ball) and G the two-dimensional Gaussian of
width sigma:

    O = G * t                                  share of the background's level seen at s
    R = s O + sigma^2 O'                       share of its slope
    Q = ((s^2 + sigma^2) O + 2 sigma^2 s O' + sigma^4 O'') / 2    share of its curvature, by the opaque ball's O

R and Q follow from x G = -sigma^2 G' (Stein's identity): R is exact for a background that is linear across the image.
sigma dO/dsigma = sigma^2 (O'' + O'/r) is the heat equation, and R dO/dR = -r O' - sigma^2 (O'' + O'/r), since O depends
on ratios of lengths only.

For sigma < CURVED R the rim counts as straight: G acts along its normal, on a rim that lies sigma^2 / 2R further in,
which is the first effect of its curvature; the next is of the order (sigma / R)^2 of the contrast.  For larger blur the
convolution is taken in the plane: over angles it gives the kernel (rho / sigma^2) exp(-(r^2 + rho^2) / 2 sigma^2)
I_0(r rho / sigma^2), whose derivatives by r bring in I_1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tomopose.kernel_cache import njit
from tomopose.units import Array

STRAIGHT, COLUMNS = 5, 11
"""Columns of the table.  O, O', O'', R, Q; and where X-rays pass the ball or the rim counts as curved also R', R'',
dO/dkappa, dR/dkappa, Q', and -dO/dR.  For an opaque ball with a straight rim R' = O, R'' = O', Q' = R, -dO/dR = O'."""
CURVED = 0.05
"""Ratio of blur to radius from which the rim counts as curved: what a straight one leaves out, about (sigma / R)^2 / 10
of the contrast, is 0.0003 there."""
STEPS_PER_SIGMA = 32
"""Of the table with a straight rim: linear interpolation is good to 3e-5 of the contrast."""
COARSE_STEPS_PER_SIGMA = 16
"""Of the table with a curved rim: to 1e-4."""
REACH = 6.0
"""Gaussian tails beyond this many sigmas (1e-9) count as zero."""
PHI = np.array([0.5 * math.erfc(-k / STEPS_PER_SIGMA / math.sqrt(2)) for k in range(-288, 289)])
PHI_PRIME = np.exp(-0.5 * (np.arange(-288, 289) / STEPS_PER_SIGMA) ** 2) / math.sqrt(2 * math.pi)
"""The normal distribution and its density on the table's grid, up to 9 sigmas, where they are 0 or 1 to 1e-18."""
DEPTH_NODES = 160
RADIAL_NODES = 96
"""Of the sums over depth (straight rim) and radius (curved rim), at equal steps of the square root of the depth: the
widest step of the latter, 2 R / 96, is below half of the least blur, CURVED R."""
PIXEL_CUMULANT = -0.75 / 120.0
"""Fourth cumulant of a square pixel across an edge, px^4, mean over the edge's directions: a box is no Gaussian.
It adds kappa_4 / 24 times the fourth derivative of O."""


class EdgeProfile(NamedTuple):
    """table (n, 5 or 11): the profiles at s = first, first + step, ..., px."""

    table: Array
    first: float
    step: float


def edge_profile(sigma: float, kappa: float, radius: float, s_low: float, s_high: float) -> EdgeProfile:
    """The profiles for s in [s_low, s_high], px; kappa = inf is an opaque ball."""
    if sigma > CURVED * radius:
        step = sigma / COARSE_STEPS_PER_SIGMA
        first = math.floor(s_low / step) - 1
        return EdgeProfile(
            _curved(sigma, kappa, radius, first, math.ceil(s_high / step) - first + 3), first * step, step
        )
    step, inwards = sigma / STEPS_PER_SIGMA, sigma**2 / (2 * radius)
    first = math.floor((s_low + inwards) / step) - 1
    n = math.ceil((s_high + inwards) / step) - first + 3
    make = _straight_opaque if math.isinf(kappa) else _straight_transparent
    return EdgeProfile(make(sigma, kappa, radius, first, n), first * step - inwards, step)


@njit(cache=True)
def _straight_opaque(sigma, kappa, radius, first, n):  # type: ignore[no-untyped-def]
    out = np.zeros((n, STRAIGHT))
    inwards = sigma * sigma / (2.0 * radius)
    middle = PHI.shape[0] // 2
    for i in range(n):
        x = (first + i) / STEPS_PER_SIGMA
        s, at = x * sigma - inwards, min(max(first + i + middle, 0), 2 * middle)
        Phi, phi = PHI[at], PHI_PRIME[at] / sigma
        out[i, 0] = Phi - PIXEL_CUMULANT / 24.0 * (x * x * x - 3.0 * x) / sigma**3 * phi
        out[i, 1] = phi
        out[i, 2] = -x / sigma * phi
        out[i, 3] = s * Phi + sigma * sigma * phi
        out[i, 4] = 0.5 * ((s * s + sigma * sigma) * Phi + (s - inwards) * sigma * sigma * phi)
    return out


@njit(cache=True)
def _straight_transparent(sigma, kappa, radius, first, n):  # type: ignore[no-untyped-def]
    """What passes the ball, summed over depth = q^2 below the rim: so the square root of the chord is smooth."""
    opaque = _straight_opaque(sigma, kappa, radius, first, n)
    out = np.zeros((n, COLUMNS))
    out[:, 4] = opaque[:, 4]
    inwards = sigma * sigma / (2.0 * radius)
    for i in range(n):
        x = (first + i) / STEPS_PER_SIGMA
        s = x * sigma
        O, O1, O2, by_kappa, slope_by_kappa = opaque[i, 0], opaque[i, 1], opaque[i, 2], 0.0, 0.0
        low, high = max(0.0, -s - REACH * sigma), min(2.0 * radius, -s + REACH * sigma)
        q_low, q_high = math.sqrt(low), math.sqrt(max(high, low))
        h = (q_high - q_low) / DEPTH_NODES
        for k in range(DEPTH_NODES if high > low else 0):
            q = q_low + (k + 0.5) * h
            depth = q * q
            chord = math.sqrt(max(0.0, 1.0 - (1.0 - depth / radius) ** 2))
            y = (s + depth) / sigma
            t = math.exp(-kappa * chord - 0.5 * y * y) / math.sqrt(2.0 * math.pi) / sigma * 2.0 * q * h
            O += t
            O1 -= t * y / sigma
            O2 += t * (y * y - 1.0) / (sigma * sigma)
            by_kappa -= t * chord
            slope_by_kappa += t * chord * y / sigma
        out[i, 0], out[i, 1], out[i, 2] = O, O1, O2
        out[i, 7] = by_kappa
        out[i, 8] = (s - inwards) * by_kappa + sigma * sigma * slope_by_kappa
    _add_the_rest(out, sigma, radius, first * sigma / STEPS_PER_SIGMA - inwards, sigma / STEPS_PER_SIGMA)
    return out


@njit(cache=True)
def _curved(sigma, kappa, radius, first, n):  # type: ignore[no-untyped-def]
    """The opaque ball in closed form, O by summing O' from far outside; what passes it, summed over radius."""
    out = np.zeros((n, COLUMNS))
    step, square = sigma / COARSE_STEPS_PER_SIGMA, sigma * sigma
    O, before, bend_before = 1.0, 0.0, 0.0
    start = max(first + n - 1, int(REACH * COARSE_STEPS_PER_SIGMA) + 1)
    for at in range(start, first - 1, -1):
        s = at * step
        r = max(abs(radius + s), 1e-6 * sigma)
        z, y = r * radius / square, s / sigma
        i_0, i_1 = scaled_bessel(z)
        height = radius / square * math.exp(-0.5 * y * y)
        O1 = height * i_1
        laplacian = height * (radius * i_0 - r * i_1) / square
        O2 = laplacian - O1 / r
        if at < start:
            O -= 0.5 * step * (O1 + before) + step * step / 12.0 * (O2 - bend_before)
        before, bend_before = O1, O2
        if at < first + n:
            i = at - first
            out[i, 0], out[i, 1], out[i, 2] = O, O1, O2
            out[i, 4] = 0.5 * ((s * s + square) * O + 2.0 * square * s * O1 + square * square * O2)
            x = s / sigma + sigma / (2.0 * radius)
            out[i, 0] -= PIXEL_CUMULANT / 24.0 * (x * x * x - 3.0 * x) / sigma**4 * 0.3989423 * math.exp(-0.5 * x * x)
    if not math.isinf(kappa):
        _add_what_passes(out, sigma, kappa, radius, first)
    _add_the_rest(out, sigma, radius, first * step, step)
    return out


@njit(cache=True)
def _add_what_passes(out, sigma, kappa, radius, first):  # type: ignore[no-untyped-def]
    """Adds to O, O', O'' what passes the ball, and puts dO/dkappa and dO'/dkappa into columns 7 and 8."""
    step, square, h = sigma / COARSE_STEPS_PER_SIGMA, sigma * sigma, math.sqrt(radius) / RADIAL_NODES
    rho, share, chord = np.empty(RADIAL_NODES), np.empty(RADIAL_NODES), np.empty(RADIAL_NODES)
    for k in range(RADIAL_NODES):
        q = (k + 0.5) * h
        rho[k] = radius - q * q
        chord[k] = math.sqrt(max(0.0, 1.0 - (rho[k] / radius) ** 2))
        share[k] = math.exp(-kappa * chord[k]) * rho[k] / square * 2.0 * q * h
    for i in range(out.shape[0]):
        r = max(abs(radius + (first + i) * step), 1e-6 * sigma)
        if r > radius + REACH * sigma:
            break
        for k in range(RADIAL_NODES):
            y = (r - rho[k]) / sigma
            if y > REACH:
                break
            if y < -REACH:
                continue
            i_0, i_1 = scaled_bessel(r * rho[k] / square)
            t = share[k] * math.exp(-0.5 * y * y)
            O, O1 = t * i_0, t * (rho[k] * i_1 - r * i_0) / square
            laplacian = (
                t * (((r * r + rho[k] * rho[k]) / square - 2.0) * i_0 - 2.0 * r * rho[k] / square * i_1) / square
            )
            out[i, 0] += O
            out[i, 1] += O1
            out[i, 2] += laplacian - O1 / r
            out[i, 7] -= chord[k] * O
            out[i, 8] -= chord[k] * O1
    for i in range(out.shape[0]):
        out[i, 8] = (first + i) * step * out[i, 7] + square * out[i, 8]


@njit(cache=True)
def _add_the_rest(out, sigma, radius, first_s, step):  # type: ignore[no-untyped-def]
    """R, R', R'', Q' and -dO/dR from O, O', O'' and Q; second derivatives of R and Q by differences along the table."""
    square, n = sigma * sigma, out.shape[0]
    for i in range(n):
        s = first_s + i * step
        r = max(radius + s, 0.1 * sigma)
        out[i, 3] = s * out[i, 0] + square * out[i, 1]
        out[i, 5] = out[i, 0] + s * out[i, 1] + square * out[i, 2]
        out[i, 10] = (r * out[i, 1] + square * (out[i, 2] + out[i, 1] / r)) / radius
    for i in range(1, n - 1):
        out[i, 6] = (out[i + 1, 5] - out[i - 1, 5]) / (2.0 * step)
        out[i, 9] = (out[i + 1, 4] - out[i - 1, 4]) / (2.0 * step)
    for c in (6, 9):
        out[0, c], out[n - 1, c] = out[1, c], out[n - 2, c]


@njit(cache=True)
def scaled_bessel(z):  # type: ignore[no-untyped-def]
    """exp(-z) I_0(z) and exp(-z) I_1(z) for z >= 0, to 2e-7 (Abramowitz & Stegun, 9.8.1 to 9.8.4)."""
    if z < 3.75:
        t = (z / 3.75) ** 2
        scale = math.exp(-z)
        i_0 = 1.0 + t * (
            3.5156229 + t * (3.0899424 + t * (1.2067492 + t * (0.2659732 + t * (0.0360768 + t * 0.0045813))))
        )
        i_1 = 0.5 + t * (
            0.87890594 + t * (0.51498869 + t * (0.15084934 + t * (0.02658733 + t * (0.00301532 + t * 0.00032411))))
        )
        return scale * i_0, scale * z * i_1
    t, scale = 3.75 / z, 1.0 / math.sqrt(z)
    i_0 = 0.39894228 + t * (
        0.01328592
        + t
        * (
            0.00225319
            + t
            * (
                -0.00157565
                + t * (0.00916281 + t * (-0.02057706 + t * (0.02635537 + t * (-0.01647633 + t * 0.00392377))))
            )
        )
    )
    i_1 = 0.39894228 + t * (
        -0.03988024
        + t
        * (
            -0.00362018
            + t
            * (
                0.00163801
                + t * (-0.01031555 + t * (0.02282967 + t * (-0.02895312 + t * (0.01787654 - t * 0.00420059))))
            )
        )
    )
    return scale * i_0, scale * i_1
