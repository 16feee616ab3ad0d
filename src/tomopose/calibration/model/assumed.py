"""What nobody stated is not exact: default standard uncertainties of a scanner's values, and of what a ball cannot see.

A value of the scanner with a standard deviation in scanner.json is estimated with it as prior.  One with 0 is exact, in
the user's own words.  One with neither gets the default below.  The defaults are orders of magnitude of a well-kept
metrology scanner whose alignment nobody has written down; where the poses determine a value, its default plays no
part, and where they do not, the stated uncertainty of the scan shows it.  They are no measurement of anybody's scanner:
state your own in scanner.json.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner


@dataclass(frozen=True, kw_only=True)
class Default:
    """A standard deviation for a value that nobody stated: in its unit, or as a part of the value; and its source."""

    sigma: float
    source: str
    relative: bool = False


_DISTANCES = "makers state distances to some tenths of a mm: Ferrucci et al., Meas. Sci. Technol. 26 (2015) 092003"
_PITCH = "glass expands by 3e-6 to 8e-6 a kelvin, and data sheets print pitches with four digits"
_HALF_PIXEL = "half a pixel lies between counting from the corner and from the centre of a pixel"
_AXIS = "the axis defines W; what is left of its alignment after a search for the centre of rotation"

DEFAULTS: Mapping[str, Default] = MappingProxyType(
    {
        "d_SD": Default(sigma=0.5, source=_DISTANCES),
        "d_SR": Default(sigma=0.2, source=f"{_DISTANCES}; a magnification axis after its reference run"),
        "p_u": Default(sigma=1e-4, relative=True, source=_PITCH),
        "p_v": Default(sigma=1e-4, relative=True, source=_PITCH),
        "u_0": Default(sigma=0.5, source=_HALF_PIXEL),
        "v_0": Default(sigma=0.5, source=_HALF_PIXEL),
        "eta": Default(sigma=1e-3, source="0.06 degrees, what a machinist's level shows of a panel"),
        "theta": Default(sigma=2e-3, source="0.1 degrees: 0.8 mm over a panel of 400 mm"),
        "phi": Default(sigma=2e-3, source="0.1 degrees: 0.8 mm over a panel of 400 mm"),
        "axis_y": Default(sigma=0.02, source=_AXIS),
        "axis_tilt_x": Default(sigma=2e-4, source=_AXIS),
        "axis_tilt_y": Default(sigma=2e-4, source=_AXIS),
    }
)
"""Name -> default of a scanner's value, in the value's own unit."""

ROTATION_SCALE = 5e-5
"""Scale error of a platform's rotations: that of linear encoders with the geometry of the joints."""

WOBBLE_MM, WOBBLE_RAD = 1e-4, 0.5e-6
"""Radial, axial and tilt error motion of a rotary table with an air bearing, first harmonic."""

Origin = Literal["scanner.json", "default", "exact", "option", "hexapod.json", "robot.json"]


@dataclass(frozen=True, kw_only=True)
class Assumed:
    """A value that enters the result with an uncertainty that was not measured here.

    sigma: standard uncertainty in `unit`; origin: who said so.
    """

    name: str
    sigma: float
    unit: str
    origin: Origin

    def to_json(self) -> dict[str, str | float]:
        return {"name": self.name, "sigma": self.sigma, "unit": self.unit, "from": self.origin}


def default_sigma(scanner: Scanner, name: str) -> float:
    """The default of one value of this scanner, in the value's unit."""
    default = DEFAULTS[name]
    return default.sigma * (abs(getattr(scanner, name)) if default.relative else 1.0)


def assumed_of(scanner: Scanner, *, skip: Iterable[str] = ()) -> tuple[Assumed, ...]:
    """What a calibration assumes of this scanner; `skip`: values that are not assumed but freed or without effect."""
    known = set(skip)
    found = []
    for name in PARAMETER_UNITS:
        if name in known or (name not in scanner.sigma and name not in DEFAULTS):
            continue
        stated = scanner.sigma.get(name)
        sigma = default_sigma(scanner, name) if stated is None else stated
        origin: Origin = "default" if stated is None else "exact" if stated == 0 else "scanner.json"
        found.append(Assumed(name=name, sigma=sigma, unit=PARAMETER_UNITS[name], origin=origin))
    return tuple(found)


def with_assumed(scanner: Scanner, *, skip: Iterable[str] = ()) -> Scanner:
    """The scanner with a standard deviation for every value; values in `skip` keep what they have."""
    return replace(scanner, sigma={**scanner.sigma, **{a.name: a.sigma for a in assumed_of(scanner, skip=skip)}})
