"""The focal spot and movement during the exposure: one frame as a weighted sum of sharp ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array

FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True, kw_only=True)
class FocalSpot:
    """size_u, size_v (mm, in the plane of S): full width at half maximum of a "gaussian", diameters of a "disc",
    sides of a "rectangle".

    method "convolved" (gaussian only): the spot's shadow on the panel, (M - 1) times its size with M at the origin
    of M, joins the detector's blur.  "sampled": the frame is the mean over `points` point sources, exact in depth.
    """

    shape: Literal["point", "gaussian", "disc", "rectangle"] = "point"
    size_u: float = 0.0
    size_v: float = 0.0
    method: Literal["convolved", "sampled"] = "convolved"
    points: int = 21

    def __post_init__(self) -> None:
        if self.shape == "point":
            return
        if not (self.size_u > 0 and self.size_v > 0):
            raise InputError(f"focal spot: sizes are {self.size_u} and {self.size_v} mm; positive numbers are needed")
        if self.method == "convolved" and self.shape != "gaussian":
            raise InputError(f'focal spot: a {self.shape} cannot be convolved; give method = "sampled"')
        if self.points < 3:
            raise InputError(f"focal spot: {self.points} points are too few; 3 is the least")

    @property
    def sampled(self) -> bool:
        return self.shape != "point" and self.method == "sampled"

    def sources(self) -> Array:
        """(k, 3) mm in S: point sources of equal weight with the spot's centre and, to rounding, its variance."""
        if not self.sampled:
            return np.zeros((1, 3))
        n = self.points
        k = np.arange(n) + 0.5
        if self.shape == "rectangle":
            x, y = k / n - 0.5, (k * (math.sqrt(5) - 1) / 2) % 1 - 0.5
            wanted = 1 / 12
        else:
            share, angle = k / n, k * GOLDEN_ANGLE
            radius = 0.5 * np.sqrt(share) if self.shape == "disc" else np.sqrt(-2 * np.log(1 - share)) / FWHM_PER_SIGMA
            x, y = radius * np.cos(angle), radius * np.sin(angle)
            wanted = 1 / 16 if self.shape == "disc" else 1 / FWHM_PER_SIGMA**2
        x, y = ((a - a.mean()) * math.sqrt(wanted) / a.std() for a in (x, y))
        return np.stack([x * self.size_u, y * self.size_v, np.zeros(n)], axis=1)

    def blur(self, magnification: float, p_u: float, p_v: float) -> tuple[float, float]:
        """Standard deviations (px) along u and v that a convolved spot adds to the blur."""
        if self.shape != "gaussian" or self.method != "convolved":
            return 0.0, 0.0
        k = (magnification - 1) / FWHM_PER_SIGMA
        return k * self.size_u / p_u, k * self.size_v / p_v


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Even movement during one exposure, centred on the pose: the table by `alpha` rad, the object by `shift` mm in W;
    the frame is the mean of `points` moments."""

    alpha: float = 0.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    points: int = 7

    def __post_init__(self) -> None:
        if not np.isfinite([self.alpha, *self.shift]).all() or self.points < 1:
            raise InputError(
                f"motion: alpha {self.alpha} rad, shift {self.shift} mm, {self.points} points cannot be used"
            )

    def moments(self) -> Array:
        """Times from -1/2 to 1/2, midpoints of equal parts; a single 0 where nothing moves."""
        if self.alpha == 0 and not any(self.shift):
            return np.zeros(1)
        return (np.arange(self.points) + 0.5) / self.points - 0.5
