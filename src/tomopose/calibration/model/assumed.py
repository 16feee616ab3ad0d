"""What nobody stated is not exact: default standard uncertainties of a scanner's values, and of what a ball cannot see.

A value of the scanner with a standard deviation in scanner.json is estimated with it as prior.  One with 0 is exact, in
the user's own words.  One with neither gets the default below.  The defaults are orders of magnitude of a well-kept
metrology scanner whose alignment nobody has written down; where the poses determine a value, its default plays no
part, and where they do not, the stated uncertainty of the scan shows it.

| value | default | source |
|---|---|---|
| d_SD | 0.5 mm | reviews of geometrical calibration put a maker's distances at some tenths of a mm (Ferrucci et al., Meas. Sci. Technol. 26 (2015) 092003) |
| d_SR | 0.2 mm | as above; the position of a magnification axis after its last reference run |
| p_u, p_v | 1e-4 of the pitch | glass panels expand by 3e-6 to 8e-6 a kelvin, and pitches are printed with four digits |
| u_0, v_0 | 0.5 px | the half pixel between counting from the corner and from the centre of a pixel |
| eta | 1 mrad | 0.06 degrees: mechanical alignment by a spirit level; at 1000 columns 1 px of shear |
| theta, phi | 2 mrad | 0.1 degrees: 0.8 mm over a panel of 400 mm, what a feeler gauge shows |
| rotation scale | 5e-5 | the scale of a linear encoder with the geometry of its joints; a ball cannot tell it from its own lever |
| table wobble | 0.1 um, 0.5 urad | radial, axial and tilt error motion of a rotary table with an air bearing, harmonics 1 and 2 |

These numbers are no measurement of anybody's scanner: state your own in scanner.json.  axis_y and the tilts of the
table axis have none, since the axis defines W: a displaced axis is a displaced and turned panel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner

DEFAULTS: Mapping[str, Callable[[Scanner], float]] = MappingProxyType(
    {
        "d_SD": lambda s: 0.5,
        "d_SR": lambda s: 0.2,
        "p_u": lambda s: 1e-4 * s.p_u,
        "p_v": lambda s: 1e-4 * s.p_v,
        "u_0": lambda s: 0.5,
        "v_0": lambda s: 0.5,
        "eta": lambda s: 1e-3,
        "theta": lambda s: 2e-3,
        "phi": lambda s: 2e-3,
    }
)
"""Name -> standard deviation of a scanner's value that nobody stated, in the value's own unit."""

ROTATION_SCALE = 5e-5
WOBBLE_MM, WOBBLE_RAD = 1e-4, 0.5e-6

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


def assumed_of(scanner: Scanner, *, skip: Iterable[str] = ()) -> tuple[Assumed, ...]:
    """What a calibration assumes of this scanner; `skip`: values that are not assumed but freed or without effect."""
    known = set(skip)
    found = []
    for name in PARAMETER_UNITS:
        if name in known or (name not in scanner.sigma and name not in DEFAULTS):
            continue
        stated = scanner.sigma.get(name)
        sigma = DEFAULTS[name](scanner) if stated is None else stated
        origin: Origin = "default" if stated is None else "exact" if stated == 0 else "scanner.json"
        found.append(Assumed(name=name, sigma=sigma, unit=PARAMETER_UNITS[name], origin=origin))
    return tuple(found)


def with_assumed(scanner: Scanner, *, skip: Iterable[str] = ()) -> Scanner:
    """The scanner with a standard deviation for every value; values in `skip` keep what they have."""
    return replace(scanner, sigma={**scanner.sigma, **{a.name: a.sigma for a in assumed_of(scanner, skip=skip)}})
