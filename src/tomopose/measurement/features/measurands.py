"""From features to lengths, angles and form, each with its uncertainty.

A measurand is a function of one or two feature vectors (`features.PARAMETERS`); its uncertainty follows from their
covariances by the law of propagation (JCGM 100:2008, 5.1), with derivatives by central differences.

Rules for distances:
    plane to plane          centroid-of-second: of the second plane's centroid from the first (default)
                            symmetric: of the two centroids along the mean normal
    centre to centre        spheres, calottes, circles, cone apexes: the straight distance
    centre to plane, axis   perpendicular
    axis to axis            at the foot next to the first axis' point

A length is unidirectional where an error of the edge threshold moves both ends alike, so that it cancels; bidirectional
where both ends move apart; one-sided where only one end is a surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from tomopose.coverage import combined
from tomopose.errors import InputError
from tomopose.measurement.features.feature import Feature, form_of
from tomopose.units import Array

Kind = Literal["distance", "diameter", "angle", "apex_angle", "form", "form_95", "form_25", "position", "x", "y", "z"]
Rule = Literal["centroid-of-second", "symmetric"]
CENTRED = ("sphere", "calotte", "circle")
AXIAL = ("line", "cylinder", "cone")
UNITS = {"angle": "rad", "apex_angle": "rad"}
REFERENCE_TEMPERATURE_C = 20.0


@dataclass(frozen=True, kw_only=True)
class Measured:
    """value and standard uncertainty u, mm or rad; dof: degrees of freedom of u; direction: uni-, bi- or one-sided."""

    value: float
    u: float
    dof: float
    unit: str
    direction: str
    method: str


def distance(first: Feature, second: Feature, *, rule: Rule = "centroid-of-second") -> Measured:
    """Distance of two features, mm, by the rules above.  InputError for a pair that has no rule."""
    kinds = _class(first), _class(second)
    if kinds == ("plane", "plane"):
        along = np.sign(first.direction @ second.direction) or 1.0

        def between(a: Array, b: Array) -> float:
            n = a[3:6] if rule == "centroid-of-second" else a[3:6] + along * b[3:6]
            return abs(float((b[:3] - a[:3]) @ n)) / float(np.linalg.norm(n))

        direction = "unidirectional" if along > 0 else "bidirectional"
        return _propagated(between, (first, second), "mm", direction, f"plane to plane, {rule}")
    if kinds == ("centre", "centre"):
        return _propagated(
            lambda a, b: float(np.linalg.norm(a[:3] - b[:3])),
            (first, second),
            "mm",
            "unidirectional",
            "centre to centre",
        )
    if kinds in (("centre", "plane"), ("plane", "centre")):
        centre, plane = (first, second) if kinds[0] == "centre" else (second, first)
        return _propagated(
            lambda a, b: abs(float((a[:3] - b[:3]) @ b[3:6])) / float(np.linalg.norm(b[3:6])),
            (centre, plane),
            "mm",
            "one-sided",
            "centre to plane",
        )
    if kinds in (("centre", "axis"), ("axis", "centre")):
        centre, axis = (first, second) if kinds[0] == "centre" else (second, first)
        return _propagated(_from_axis, (centre, axis), "mm", "unidirectional", "centre to axis")
    if kinds == ("axis", "axis"):
        return _propagated(_from_axis, (first, second), "mm", "unidirectional", "axis point to axis")
    raise InputError(f"the distance of a {first.kind} and a {second.kind} has no rule")


def diameter(feature: Feature) -> Measured:
    """Diameter, mm; of a cone at its point."""
    _ = feature.radius
    return _propagated(lambda a: 2.0 * float(a[6]), (feature,), "mm", "bidirectional", feature.association)


def angle(first: Feature, second: Feature) -> Measured:
    """Angle between directions, rad, 0 to pi/2: between two axes or two normals; axis and plane: to the plane."""
    mixed = (first.kind == "plane") != (second.kind == "plane")

    def between(a: Array, b: Array) -> float:
        p, q = a[3:6] / np.linalg.norm(a[3:6]), b[3:6] / np.linalg.norm(b[3:6])
        cross, dot = float(np.linalg.norm(np.cross(p, q))), abs(float(p @ q))
        return float(np.arctan2(dot, cross) if mixed else np.arctan2(cross, dot))

    _ = first.direction, second.direction
    return _propagated(between, (first, second), "rad", "unidirectional", "between directions")


def apex_angle(feature: Feature) -> Measured:
    """Full apex angle of a cone, rad."""
    _ = feature.half_angle
    return _propagated(lambda a: 2.0 * float(a[7]), (feature,), "rad", "unidirectional", feature.association)


def form(feature: Feature, which: str, *, all_points: bool = True) -> Measured:
    """Form deviation, mm: range of all points, narrowest shell of 95 % of them, or range of 25 patch means.

    all_points: False leaves out the points that the feature's outlier rule set aside; the method says how many.
    Its uncertainty is not determinable from one surface: noise adds to it on one side only.
    """
    n = len(feature.points) if all_points else feature.n_used
    words = {
        "form": f"range of {n} points",
        "form_95": f"95 % of {n} points",
        "form_25": f"25 patch means of {n} points",
    }
    if which not in words:
        raise InputError(f"{which!r} is not a form deviation; choose one of {', '.join(words)}")
    aside = "all points" if all_points else f"{feature.n_set_aside} points set aside by {feature.outlier_rule}"
    return Measured(
        value=form_of(feature, which, all_points=all_points),
        u=np.nan,
        dof=np.nan,
        unit="mm",
        direction="bidirectional",
        method=f"{words[which]} about the {feature.association} {feature.kind}; {aside}",
    )


def position(feature: Feature, nominal: npt.ArrayLike) -> Measured:
    """Position deviation, mm: twice the distance of the feature's point from `nominal` (3,); for an axis, across it."""
    x = np.asarray(nominal, dtype=np.float64)
    if x.shape != (3,):
        raise InputError(f"a nominal position is (3,); got {x.shape}")
    if _class(feature) == "axis":
        return _propagated(lambda a: 2 * _from_axis(x, a), (feature,), "mm", "unidirectional", "zone diameter, of axis")
    return _propagated(
        lambda a: 2 * float(np.linalg.norm(a[:3] - x)), (feature,), "mm", "unidirectional", "zone diameter, of point"
    )


def coordinate(feature: Feature, axis: str) -> Measured:
    """Coordinate x, y or z of the feature's point, mm, in W."""
    if axis not in ("x", "y", "z"):
        raise InputError(f"{axis!r} is no coordinate; x, y or z is needed")
    k = "xyz".index(axis)
    return _propagated(lambda a: float(a[k]), (feature,), "mm", "unidirectional", f"coordinate {axis}")


def at_reference_temperature(measured: Measured, temperature_C: float, expansion_per_K: float) -> Measured:
    """A length measured at a temperature, as it is at 20 C: L / (1 + alpha (T - 20))."""
    factor = 1.0 / (1.0 + expansion_per_K * (temperature_C - REFERENCE_TEMPERATURE_C))
    return Measured(
        value=measured.value * factor,
        u=measured.u * factor,
        dof=measured.dof,
        unit=measured.unit,
        direction=measured.direction,
        method=f"{measured.method}; from {temperature_C:g} to 20 C",
    )


def maximum_permissible_error(length: float, A_um: float, K: float | None = None, B_um: float | None = None) -> float:
    """A + L/K, micrometres, L in mm; at most B where that is given.  All three are the user's: nothing is built in."""
    if not A_um > 0 or (K is not None and not K > 0) or (B_um is not None and not B_um > 0):
        raise InputError(f"MPE needs positive A_um, K and B_um; got {A_um}, {K}, {B_um}")
    limit = A_um + (length / K if K is not None else 0.0)
    return limit if B_um is None else min(limit, B_um)


def _class(feature: Feature) -> str:
    if feature.kind in CENTRED:
        return "centre"
    return "axis" if feature.kind in AXIAL else feature.kind


def _from_axis(point: Array, axis: Array) -> float:
    n = axis[3:6] / np.linalg.norm(axis[3:6])
    d = point[:3] - axis[:3]
    return float(np.linalg.norm(d - (d @ n) * n))


def _propagated(
    function: Callable[..., float], features: tuple[Feature, ...], unit: str, direction: str, method: str
) -> Measured:
    """The value with u^2 = sum over features of g' C g; dof by Welch and Satterthwaite (JCGM 100:2008, G.4)."""
    vectors = [np.array(f.vector) for f in features]
    value = function(*vectors)
    if any(f.association != "least-squares" for f in features):
        # Extreme points determine these features; the scatter of one surface does not say how uncertain they are.
        return Measured(value=value, u=np.nan, dof=np.nan, unit=unit, direction=direction, method=method)
    shares = []
    for k, f in enumerate(features):
        u = np.sqrt(np.diag(f.covariance))
        g = np.zeros(8)
        for i in np.flatnonzero(u > 0):
            h = 1e-3 * u[i] if np.isfinite(u[i]) else 1e-6
            moved = [v.copy() for v in vectors]
            moved[k][i] += h
            above = function(*moved)
            moved[k][i] -= 2 * h
            g[i] = (above - function(*moved)) / (2 * h)
        used = g != 0
        shares.append(float(g[used] @ f.covariance[np.ix_(used, used)] @ g[used]))
    u_all, dof = combined(
        (math.sqrt(max(share, 0.0)), max(f.dof, 1.0)) for share, f in zip(shares, features, strict=True)
    )
    return Measured(value=value, u=u_all, dof=dof, unit=unit, direction=direction, method=method)
