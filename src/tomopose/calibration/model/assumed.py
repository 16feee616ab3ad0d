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
from typing import Literal, TypeAlias

from tomopose.calibration.model.parameters import FreeParameters, free_parameters
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.units import Array


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
        "d_SR": Default(sigma=0.15, source=f"{_DISTANCES}; a magnification axis after its reference run"),
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

ROTATION_SCALE, AS_DELIVERED_ROTATION_SCALE = 2e-5, 1.3e-4
"""Scale error of a platform's rotations: that of linear encoders with the geometry of the joints; and of a platform as
it was delivered, each joint known to 0.01 mm (typical_hexapod: 1.25e-4 rms over the axes)."""

TRANSLATION_SCALE, AS_DELIVERED_TRANSLATION_SCALE, ROBOT_TRANSLATION_SCALE = 3e-6, 5e-5, 1e-3
"""Scale error of the translations of a platform: a glass scale of the grade +-5 um a metre, 5 / sqrt(3); of one as it
was delivered, as above (typical_hexapod: 4.5e-5 common to the three axes); of a robot: a millimetre a metre, as arms
whose links nobody calibrated reach (Mooring, Roth and Driels, Fundamentals of Manipulator Calibration, 1991).  No image
shows it: the translations are the only lengths that a calibration by one ball knows.  A prior of `translation_scale`
states another, and fixing it says that it is exact.

Who states a standard deviation of every value of the scanner (0 where it is exact) has measured the set-up, and has the
first of the numbers; who leaves one to its default has a platform as it was delivered.  This condition and the 0.01 mm
were tuned on benchmarks/reality."""

WOBBLE_MM, WOBBLE_RAD = 3e-5, 0.25e-6
"""Radial, axial and tilt error motion of a rotary table with an air bearing, first harmonic."""

Source: TypeAlias = Literal["scanner.json", "default", "exact", "option"]


@dataclass(frozen=True, kw_only=True)
class Assumed:
    """A value that enters the result with an uncertainty that was not measured here.

    value: as it was given, None where that is not known;  sigma: standard uncertainty in `unit`.
    source: "scanner.json" (the user's number), "default" (nobody stated any), "exact" (the user's 0, or `fix`),
    "option" (priors).
    """

    name: str
    sigma: float
    unit: str
    source: Source
    value: float | None = None


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
        source: Source = "default" if stated is None else "exact" if stated == 0 else "scanner.json"
        found.append(
            Assumed(name=name, value=getattr(scanner, name), sigma=sigma, unit=PARAMETER_UNITS[name], source=source)
        )
    return tuple(found)


def with_assumed(scanner: Scanner, assumed: Iterable[Assumed]) -> Scanner:
    """The scanner with the standard deviations that are assumed of it."""
    return replace(scanner, sigma={**scanner.sigma, **{a.name: a.sigma for a in assumed}})


def without_effect(alpha: Array, *, moving_scanner: bool) -> tuple[str, ...]:
    """Scanner values on which nothing depends beside the mount, given the table angles (n,) of a run.

    A scanner that moves as a whole takes a roll and a shift of the origin of W into its mount, and has no table.
    """
    return ("d_SR", "eta", "axis_y", "axis_tilt_x", "axis_tilt_y") if moving_scanner and not alpha.any() else ()


def assumed_for(
    scanner: Scanner,
    *,
    free: Iterable[str],
    fix: Iterable[str],
    priors: Mapping[str, float],
    no_effect: Iterable[str] = (),
) -> tuple[Assumed, ...]:
    """What a calibration assumes, with the words of its options: `free` and `fix` names, `priors` (sigma by name)."""
    free, fix = set(free), set(fix)
    skip = {n for n in free if not scanner.sigma.get(n)} | set(no_effect)
    skip |= {"p_u"} if "pitch_ratio" in free | set(priors) else set()
    found = []
    for a in assumed_of(scanner, skip=skip):
        if a.name in fix:
            a = replace(a, sigma=0.0, source="exact")
        elif a.name in priors:
            a = replace(a, sigma=float(priors[a.name]), source="option")
        found.append(a)
    return tuple(found)


def taken_as_known(
    scanners: tuple[Scanner, ...],
    *,
    free: Iterable[str] = (),
    fix: Iterable[str] = (),
    priors: Mapping[str, float] | None = None,
    no_effect: Iterable[str] = (),
) -> tuple[tuple[Assumed, ...], tuple[Scanner, ...], FreeParameters]:
    """(what is assumed of the first scanner, the scanners with it, what is estimated) of a calibration and of a plan
    that predicts it; arguments as of `assumed_for`."""
    free, fix, priors, no_effect = tuple(free), tuple(fix), dict(priors or {}), tuple(no_effect)
    assumed = [assumed_for(s, free=free, fix=fix, priors=priors, no_effect=no_effect) for s in scanners]
    known = tuple(with_assumed(s, a) for s, a in zip(scanners, assumed, strict=True))
    return assumed[0], known, free_parameters(known, free=free, fix=fix, priors=priors)


def scatter_assumed(t_mm: float, w_rad: float, source: Source) -> tuple[Assumed, ...]:
    """The prior of the poses' scatter, a coordinate each.

    Backlash and periodic errors of drives, which one ball cannot distinguish from scatter, are within it.
    """
    return (
        Assumed(name="scatter_and_backlash_t", sigma=t_mm, unit="mm", source=source),
        Assumed(name="scatter_and_backlash_w", sigma=w_rad, unit="rad", source=source),
    )
