"""The numbers that define what a set of views is worth, with their defaults.

Measured on a plate with bores, planned on other points than judged: attenuation wrong by a factor of 0.67 to 2 costs 4
% of J, the tolerance of a tangent 1.0 deg in place of 1.5 deg 10 %, 2 to 2.5 deg 1 to 2 %, another soft width 1 %,
other weights up to 1 %.
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias, get_args

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array
from tomopose.values import value

Uncertainty: TypeAlias = Literal["filters", "exact", "drawn"]
UNCERTAINTIES = get_args(Uncertainty)
"""By filters in the place of SART; by SART's own steps backwards; by scans with drawn noise."""

FEWEST_DRAWS = 10
"""A standard deviation of 10 draws is itself uncertain by 24 %."""

WEIGHTS = (0.5, 0.3, 0.2)
"""Of coverage, completeness and transmission in J."""

LIFT_MM = 0.02
"""How far a surface point is moved along its normal before a line is traced: above the sagitta of fine facets."""

POINTS = 120
"""Sample points of a feature while choosing: with 40 the value on other points falls 12 % short, with 120 6 %."""

POINTS_JUDGED = 163
"""Sample points of a feature while judging; another pattern than the one that was planned on."""

MOST_POINTS, FEWEST_POINTS = 4000, 40
"""Of all features together while choosing, and of one feature however many there are."""

PLANES, TUY_POINTS = 250, 24
"""Directions of planes on a half sphere, and points of the part, of the completeness."""


@value
class PartSettings:
    """What J means and how it is searched.

    mu:                 linear attenuation coefficient of the part as a volume shows it, 1/mm.
    least_transmission: below it a ray holds no information on a surface.
    least_view_transmission:  mean over the points that a view has to have to be a candidate; 0 admits all.
    tangent:            rad; a ray within this angle of the surface's tangent plane shows where the surface is.
    tuy_width:          rad; standard width of the soft condition of Tuy.
    margin:             px that the whole part keeps from the panel's edge.
    alpha_step, tilt_step:  rad, of the grid of candidates.
    quanta, readout:    detected quanta of an open pixel and readout noise in quanta, of the predicted uncertainty.
    blur:               standard width of the unsharpness at the panel, px.
    sweeps, room:       of SART, and by how many mm the reconstructed box is larger than the part on each side; of the
                        predicted uncertainty too.
    uncertainty:        how lengths are predicted: filters; exact, about a reconstruction for each sum; drawn, a
                        reconstruction for each draw.
    draws:              scans that are drawn.
    beam:               (share of the empty beam's signal, attenuation in 1/mm) of each energy, for the drawn scans;
                        empty: one energy of attenuation mu.
    seed:               of the random points where the whole surface is the feature, and of the drawn noise.
    """

    mu: float
    least_transmission: float = 0.05
    least_view_transmission: float = 0.0
    tangent: float = math.radians(1.5)
    tuy_width: float = math.radians(3.0)
    margin: float = 2.0
    alpha_step: float = math.radians(3.0)
    tilt_step: float = math.radians(2.5)
    quanta: float = 20_000.0
    readout: float = 0.0
    blur: float = 0.5
    sweeps: int = 1
    room: float = 5.0
    uncertainty: Uncertainty = "filters"
    draws: int = 100
    beam: tuple[tuple[float, float], ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("mu", "tangent", "tuy_width", "alpha_step", "tilt_step", "quanta"):
            found = getattr(self, name)
            if not (math.isfinite(found) and found > 0):
                raise InputError(f"{name} is {found}; a positive number is needed")
        if not 0 < self.least_transmission < 1:
            raise InputError(f"least_transmission is {self.least_transmission}; a share between 0 and 1 is needed")
        if not 0 <= self.least_view_transmission < 1:
            raise InputError(
                f"least_view_transmission is {self.least_view_transmission}; a share from 0 to below 1 is needed"
            )
        if self.uncertainty not in UNCERTAINTIES:
            raise InputError(f"uncertainty is {self.uncertainty!r}; {', '.join(UNCERTAINTIES)} are known")
        if not (self.draws >= FEWEST_DRAWS and int(self.draws) == self.draws):
            raise InputError(f"draws is {self.draws}; a whole number from {FEWEST_DRAWS} is needed")
        if not (self.sweeps >= 1 and int(self.sweeps) == self.sweeps):
            raise InputError(f"sweeps is {self.sweeps}; a whole number from 1 is needed")
        for name in ("margin", "readout", "blur", "room"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"{name} is {getattr(self, name)}; a number from 0 is needed")

    def transmission(self, L: Array) -> Array:
        """Share of the empty beam's signal behind lengths L, mm, of the part."""
        L = np.maximum(L, 0.0)
        if not self.beam:
            return np.asarray(np.exp(-self.mu * L))
        return np.asarray(sum(share * np.exp(-mu * L) for share, mu in self.beam))
