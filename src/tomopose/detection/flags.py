"""Warnings about one image.  Each is a word in the observation's status; the row stays usable."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tomopose.detection.rim_fit.covariance import ConeFit
from tomopose.detection.rim_model.ring import BallWindow, annulus_pixels
from tomopose.detection.settings import DetectionSettings, FlagSettings
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


def saturated_share(window: BallWindow, ceiling: float, fit: ConeFit, settings: FlagSettings) -> float:
    """Share of the pixels just outside the rim that have the image's largest value, where that is a clipped one.

    Counts clip at a power of two less 1; of other values that many alike are clipped too,
    unless the image is a simulated one without noise.
    """
    radius, blur = float(fit.shape[2]), float(fit.shape[3])
    low = radius + 2.5 * blur
    ring = annulus_pixels(
        replace(window, good=np.ones_like(window.good)), fit.shape, low, max(radius + 12.0, low + 5.0)
    )
    if ring.size == 0 or not math.isfinite(ceiling):
        return 0.0
    share = float((ring >= ceiling).mean())
    power_of_two = ceiling >= 255 and float(np.log2(ceiling + 1)).is_integer()
    noisy = math.sqrt(max(fit.noise.inside, fit.noise.outside)) > settings.noise_free * fit.contrast
    return share if power_of_two or (share > settings.mostly_saturated and noisy) else 0.0


def expected_radius(scanner: Scanner, ball_diameter: float) -> float:
    """Radius of a ball on the rotation axis, px of size sqrt(p_u p_v)."""
    return ball_diameter / 2 * scanner.magnification / math.sqrt(scanner.p_u * scanner.p_v)


def motion_length(anisotropy: Array, covariance: Array, blur: float, settings: DetectionSettings) -> float:
    """Length of the motion that would explain the blur's anisotropy, px; 0 where it is within its noise, or short."""
    significance = float(anisotropy @ np.linalg.solve(covariance, anisotropy))
    length = math.sqrt(24.0 * math.hypot(*anisotropy))
    shortest = max(settings.flags.motion, settings.flags.motion_widths * blur)
    return length if significance > settings.fit.moved and length > shortest else 0.0


def flags_of(
    fit: ConeFit, *, saturated: float, expected: float, bright: bool, eight_bit: bool, settings: DetectionSettings
) -> tuple[str, ...]:
    """The flags of one fit; DetectionError where the rim is mostly saturated or lost."""
    limits = settings.flags
    if saturated > limits.mostly_saturated:
        raise DetectionError(
            f"saturated rim: {100 * saturated:.0f} % of the background along the rim is clipped; lower the exposure"
        )
    if fit.lost > limits.most_lost:
        raise DetectionError(f"bad pixels on the rim: {100 * fit.lost:.0f} % of its pixels cannot be used")
    moved = motion_length(*fit.anisotropy, float(fit.shape[3]), settings) > 0
    present = {
        "truncated": fit.visible < limits.whole_rim,
        "bad pixels on the rim": fit.lost > limits.lost,
        "saturated": saturated > limits.saturated,
        "few photons": fit.snr < limits.few,
        "edge at the rim": fit.doubt > limits.doubted and not moved,
        "radius off nominal": abs(fit.shape[2] / expected - 1.0) > limits.off_nominal,
        "moved": moved,
        "bright ball": bright,
        "8-bit": eight_bit,
    }
    return tuple(name for name, yes in present.items() if yes)
