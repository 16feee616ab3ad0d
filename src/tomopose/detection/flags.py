"""Warnings about one image.  Each is a word in the observation's status; the row stays usable."""

from __future__ import annotations

import math

import numpy as np

from tomopose.detection.rim_fit.cone import ring_pixels
from tomopose.detection.rim_fit.fit import ConeFit
from tomopose.errors import DetectionError
from tomopose.geometry.scanner import Scanner
from tomopose.units import Array

FLAGS = {
    "truncated": "part of the rim lies outside the image; the larger sigma says so",
    "bad pixels on the rim": "dead, hot or masked pixels on the rim were left out",
    "saturated": "part of the background along the rim is clipped at the detector's ceiling",
    "few photons": "contrast below 15 standard deviations of a pixel's noise",
    "edge at the rim": "a holder's edge or glue at the rim makes the centre uncertain; the larger sigma says so",
    "radius off nominal": "silhouette more than 20 % off what ball_diameter gives at the rotation axis, or more than "
    "2 % in every image of a run",
    "moved": "the blur depends on direction, as when the ball moves during the exposure",
    "bright ball": "the ball is brighter than its surroundings: is the image inverted or a logarithm?",
    "8-bit": "the image has 256 levels at most",
    "lag": "the previous pose's ball is still faintly visible",
}

WHOLE_RIM = 0.985
LOST = 0.01
SATURATED, MOSTLY_SATURATED = 0.02, 0.3
NOISE_FREE = 1e-4
"""Noise, in contrasts, below which an image counts as computed without noise."""
FEW = 15.0
DOUBTED = 0.4
"""Share of the centre's variance from which edges at the rim are worth a word."""
OFF_NOMINAL = 0.2
MOTION = 0.5
"""Shortest motion that is called so, px: a uniform motion by L adds L^2 / 12 to the blur's variance along it."""
MOTION_CHI2 = 30.0


def saturated_share(window: Array, ceiling: float, fit: ConeFit, origin: tuple[int, int]) -> float:
    """Share of the pixels just outside the rim that stand at the image's largest value, where that is a clipped one.

    Counts clip at a power of two less 1; of other values that many alike are clipped too,
    unless the image is a simulated one without noise.
    """
    u, v, radius, sigma = (float(x) for x in fit.shape[:4])
    every_one = np.ones(window.shape, dtype=bool)
    low, high = radius + 2.5 * sigma, radius + 12.0
    *_, ring = ring_pixels(window, every_one, origin[0], origin[1], u, v, low, high, 1.0, 1.0, 1)
    if ring.size == 0 or not math.isfinite(ceiling):
        return 0.0
    share = float((ring >= ceiling).mean())
    power_of_two = ceiling >= 255 and float(np.log2(ceiling + 1)).is_integer()
    noisy = max(fit.noise_in, fit.noise_out) > NOISE_FREE * abs(fit.level - fit.white)
    return share if power_of_two or (share > MOSTLY_SATURATED and noisy) else 0.0


def expected_radius(scanner: Scanner, ball_diameter: float) -> float:
    """Radius of a ball on the rotation axis, px of size sqrt(p_u p_v)."""
    return ball_diameter / 2 * scanner.magnification / math.sqrt(scanner.p_u * scanner.p_v)


def motion_length(anisotropy: Array, covariance: Array) -> float:
    """Length of the motion that would explain the blur's anisotropy, px; 0 where it is within its noise."""
    significance = float(anisotropy @ np.linalg.solve(covariance, anisotropy))
    return math.sqrt(24.0 * math.hypot(*anisotropy)) if significance > MOTION_CHI2 else 0.0


def flags_of(fit: ConeFit, *, saturated: float, expected: float, bright: bool, eight_bit: bool) -> tuple[str, ...]:
    """The flags of one fit; DetectionError where the rim is mostly saturated or lost."""
    if saturated > MOSTLY_SATURATED:
        raise DetectionError(
            f"saturated rim: {100 * saturated:.0f} % of the background along the rim is clipped; lower the exposure"
        )
    if fit.lost > 0.5:
        raise DetectionError(f"bad pixels on the rim: {100 * fit.lost:.0f} % of its pixels cannot be used")
    moved = motion_length(fit.anisotropy, fit.anisotropy_covariance) > MOTION
    present = {
        "truncated": fit.visible < WHOLE_RIM,
        "bad pixels on the rim": fit.lost > LOST,
        "saturated": saturated > SATURATED,
        "few photons": fit.snr < FEW,
        "edge at the rim": fit.doubt > DOUBTED and not moved,
        "radius off nominal": abs(fit.shape[2] / expected - 1.0) > OFF_NOMINAL,
        "moved": moved,
        "bright ball": bright,
        "8-bit": eight_bit,
    }
    return tuple(name for name, yes in present.items() if yes)
