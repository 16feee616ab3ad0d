"""A fitted feature as a value, and the form deviations that follow from its residuals.

Every feature is one vector of eight numbers, so that measurands and their uncertainties need only one rule:

    (x, y, z, n_x, n_y, n_z, r, psi)      a point, a unit direction, a radius, a half angle; mm and rad

| kind     | point                         | direction                    | radius    | half angle |
|----------|-------------------------------|------------------------------|-----------|------------|
| plane    | centroid of the used points   | normal                       | –         | –          |
| line     | centroid of the used points   | along the line               | –         | –          |
| circle   | centre                        | normal of its plane          | its own   | –          |
| sphere   | centre                        | –                            | its own   | –          |
| cylinder | on the axis, next to centroid | along the axis               | its own   | –          |
| cone     | on the axis, next to centroid | along the axis, widening     | at point  | its own    |

A calotte is a sphere of which a part was seen; it differs by its kind alone.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array, float_array
from tomopose.values import value

PARAMETERS = ("x_mm", "y_mm", "z_mm", "n_x", "n_y", "n_z", "radius_mm", "half_angle_rad")
HAS_DIRECTION = ("plane", "line", "circle", "cylinder", "cone")
HAS_RADIUS = ("circle", "sphere", "calotte", "cylinder", "cone")
Association = Literal["least-squares", "minimum-zone", "minimum-circumscribed", "maximum-inscribed"]
N_REPRESENTATIVE = 25
D95_SHARE = 0.95


@value
class Feature:
    """A feature fitted to points.

    vector:       (8,) as in the module's table; what a kind does not have is nan.
    covariance:   (8, 8) of the vector, zero where the kind has nothing or the value was held.
    points:       (n, 3) mm, all points given;  used: (n,) bool, those that the fit kept.
    residuals:    (n,) signed orthogonal distances of all points, mm; positive outside (along the normal of a plane).
    n_effective:  number of independent points that carry the same information as the used ones.
    dof:          degrees of freedom of the covariance; fewer than those points, since their correlation is estimated.
    outlier_rule: in words.
    association:  the criterion: least-squares, minimum-zone, minimum-circumscribed or maximum-inscribed.
    contacts:     indices of the points that determine a feature other than the least-squares one.
    """

    kind: str
    vector: Array
    covariance: Array
    points: Array
    used: np.ndarray
    residuals: Array
    n_effective: float
    dof: float
    outlier_rule: str = "none"
    association: Association = "least-squares"
    contacts: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name in ("vector", "covariance", "points", "residuals"):
            object.__setattr__(self, name, float_array(getattr(self, name)))
        used = np.array(self.used, dtype=bool)
        used.setflags(write=False)
        object.__setattr__(self, "used", used)

    @property
    def point(self) -> Array:
        return self.vector[:3]

    @property
    def direction(self) -> Array:
        """Unit vector (3,).  InputError where the kind has none."""
        if self.kind not in HAS_DIRECTION:
            raise InputError(f"a {self.kind} has no direction; give a {', '.join(HAS_DIRECTION)}")
        return self.vector[3:6]

    @property
    def radius(self) -> float:
        """mm.  InputError where the kind has none."""
        if self.kind not in HAS_RADIUS:
            raise InputError(f"a {self.kind} has no radius; give a {', '.join(HAS_RADIUS)}")
        return float(self.vector[6])

    @property
    def diameter(self) -> float:
        return 2.0 * self.radius

    @property
    def half_angle(self) -> float:
        """Half the apex angle of a cone, rad."""
        if self.kind != "cone":
            raise InputError(f"a {self.kind} has no half angle; give a cone")
        return float(self.vector[7])

    @property
    def apex(self) -> Array:
        """Apex (3,) of a cone, mm."""
        return self.point - self.direction * (self.radius / math.tan(self.half_angle))

    @property
    def u(self) -> Array:
        """(8,) standard uncertainties of the vector."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def n_used(self) -> int:
        return int(self.used.sum())

    @property
    def used_residuals(self) -> Array:
        result: Array = self.residuals[self.used]
        return result

    @property
    def rms(self) -> float:
        """Root mean square of the used residuals, mm."""
        return float(np.sqrt(np.mean(self.used_residuals**2)))

    @property
    def n_set_aside(self) -> int:
        """Points that the outlier rule set aside."""
        return len(self.used) - self.n_used

    @property
    def form(self) -> float:
        """Peak-to-valley deviation of *all* points, mm: largest minus smallest residual.

        Of a line whose residuals have no sign: twice the largest, the diameter of the zone about it (ISO 12780-1).
        It grows with noise and with the number of points.
        """
        return form_of(self, "form")

    @property
    def form_95(self) -> float:
        """Width of the narrowest shell that holds 95 % of all points, mm (D95 %)."""
        return form_of(self, "form_95")

    @property
    def form_25(self) -> float:
        """Range of 25 representative points, each the mean residual of one patch of all points, mm."""
        return form_of(self, "form_25")

    def to_json(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            "parameters": {n: v for n, v in zip(PARAMETERS, self.vector.tolist(), strict=True) if math.isfinite(v)},
            "u": {n: u for n, u, v in zip(PARAMETERS, self.u.tolist(), self.vector, strict=True) if math.isfinite(v)},
            "n_points": len(self.points),
            "n_used": self.n_used,
            "n_set_aside": self.n_set_aside,
            "association": self.association,
            "contacts": self.contacts,
            "n_effective": self.n_effective,
            "dof": self.dof,
            "rms_mm": self.rms,
            "form_mm": self.form,
            "form_95_mm": self.form_95,
            "outlier_rule": self.outlier_rule,
        }


def narrowest_shell(residuals: Array, share: float) -> float:
    """Width of the narrowest interval that holds `share` of the residuals, mm."""
    ordered = np.sort(residuals)
    inside = max(math.ceil(share * len(ordered)), 1)
    return float(np.min(ordered[inside - 1 :] - ordered[: len(ordered) - inside + 1]))


def form_of(feature: Feature, which: str, *, all_points: bool = True) -> float:
    """form, form_95 or form_25 of a feature, mm.  all_points False leaves out what the outlier rule set aside."""
    chosen = np.ones(len(feature.used), dtype=bool) if all_points else feature.used
    d = feature.residuals[chosen]
    if which == "form_25":
        return float(np.ptp(patch_means(feature.points[chosen], d, N_REPRESENTATIVE)))
    if feature.kind == "line" and d.min() >= 0:
        # Distances without a sign: the zone is a cylinder about the line.
        return 2 * float(d.max() if which == "form" else np.sort(d)[max(math.ceil(D95_SHARE * len(d)), 1) - 1])
    return float(np.ptp(d)) if which == "form" else narrowest_shell(d, D95_SHARE)


def noise_range(feature: Feature) -> float:
    """Largest peak-to-valley deviation, mm, that noise alone makes of a perfect feature, in 95 % of cases.

    The noise is the robust standard deviation of the residuals (median of their sizes), so that a dent does not count
    as noise; n normal errors keep within +- z, z the normal quantile at 1 - 0.025 / n.
    """
    from scipy.special import ndtri

    d = feature.residuals - np.median(feature.residuals)
    sigma = float(np.median(np.abs(d))) / float(ndtri(0.75))
    return 2 * sigma * float(ndtri(1 - 0.025 / len(d)))


def patch_means(points: Array, residuals: Array, n: int) -> Array:
    """Mean residuals (n,) of patches of even size: cells about n of the points (m, 3), spread over them.

    The seeds come one by one, each the point farthest from those before it, so they depend on nothing but the points.
    InputError where there are fewer points than patches.
    """
    x = points
    if len(x) < n:
        raise InputError(f"{len(x)} points cannot form {n} patches; give more points")
    nearest = np.full(len(x), np.inf)
    patch = np.zeros(len(x), dtype=np.intp)
    seed = int(np.argmax(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))
    for k in range(n):
        distance = np.sum((x - x[seed]) ** 2, axis=1)
        patch[distance < nearest] = k
        nearest = np.minimum(nearest, distance)
        seed = int(np.argmax(nearest))
    count = np.bincount(patch, minlength=n)
    total = np.bincount(patch, weights=residuals, minlength=n)
    return total[count > 0] / count[count > 0]
