"""What the scan is for: points with normals on the part's features, and points and planes of Tuy's condition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.features.shapes import Shape, derivatives, frame_along, half_sphere
from tomopose.measurement.plan import FeaturePlan, MeasurementPlan
from tomopose.measurement.regions import nominal_pattern
from tomopose.planning.part.part import Part, surface_points
from tomopose.planning.part.settings import FEWEST_POINTS, MOST_POINTS, PLANES, POINTS, POINTS_JUDGED, TUY_POINTS
from tomopose.units import Array

SURFACE_POINTS = 1000
OFF_SURFACE_MM, OFF_SURFACE_SHARE = 0.25, 0.5
"""A feature is on the part if at half of its points material begins within 0.25 mm of where the plan puts it."""
INWARD = (0.3, 0.1, 0.03, 0.0)
"""mm by which a point of Tuy's condition goes into the material; less where a wall is thin."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """A feature: points x (m, 3), mm in W at home, unit normals n (m, 3) from material to air, area of each point,
    mm^2.

    shape: of a sphere, circle, cylinder or cone;  radius: of the surface's curvature, mm, inf for planes;
    length: along which a flat face extends, mm.
    """

    name: str
    kind: str
    x: Array
    n: Array
    area: float
    shape: Shape | None = None
    radius: float = np.inf
    length: float = np.inf

    @property
    def outward(self) -> Array:
        """(m,) 1 where the material lies inside the shape, -1 where it lies outside, as at a bore."""
        assert self.shape is not None
        y = self.x - self.shape.point
        if self.shape.kind != "sphere":
            y = y - np.outer(y @ self.shape.frame[2], self.shape.frame[2])
        side: Array = np.sign(np.einsum("mc,mc->m", y, self.n))
        return side

    @property
    def along(self) -> Array:
        """(3,) unit vector from the first point to the last: the direction of a line."""
        d = self.x[-1] - self.x[0]
        along: Array = d / np.linalg.norm(d)
        return along

    def derivatives(self) -> Array:
        """(m, p): of the distance along the normal by the feature's parameters; a plane's are offset and two tilts."""
        if self.shape is not None:
            return derivatives(self.shape, self.x)
        if self.kind not in ("plane", "line"):
            return np.ones((len(self.x), 1))
        frame = frame_along(self.n[0])
        y = (self.x - self.x.mean(axis=0)) @ frame.T
        columns = [np.ones(len(y)), y[:, 0], y[:, 1]]
        return np.column_stack([c for c in columns if np.ptp(c) > 1e-9 or c is columns[0]])


def targets_of(part: Part, plan: MeasurementPlan | None, *, judged: bool = False, seed: int = 0) -> tuple[Target, ...]:
    """The features of a measurement plan, or the whole surface without a plan.

    judged: points of another pattern than those that views are chosen with.
    """
    if plan is None or not plan.features:
        x, n = surface_points(part.mesh, SURFACE_POINTS, seed + 1000 * judged + 1)
        area = np.linalg.norm(part.mesh.face_normals, axis=1).sum() / 2
        return (Target(name="surface", kind="surface", x=x, n=n, area=float(area) / len(x), length=part.mesh.size),)
    each = int(np.clip(MOST_POINTS // len(plan.features), FEWEST_POINTS, POINTS))
    each = each * POINTS_JUDGED // POINTS if judged else each
    found = tuple(_target(name, p, _start(plan), each) for name, p in plan.features.items())
    _require_on_part(part, found)
    return found


def probed_targets(plan: MeasurementPlan, most: int) -> tuple[Target, ...]:
    """The features of a plan with the points that they are measured at, at most `most` of each."""
    return tuple(_target(name, p, _start(plan), min(p.n_points, most)) for name, p in plan.features.items())


def _start(plan: MeasurementPlan) -> Alignment:
    rows = np.array(plan.alignment.start, dtype=np.float64)
    return Alignment(R=rows[:, :3], t=rows[:, 3], rule="given")


def _target(name: str, p: FeaturePlan, alignment: Alignment, each: int) -> Target:
    x, n = nominal_pattern(p.model_copy(update={"n_points": max(each, 10)}), alignment)
    shape, radius, length = None, np.inf, np.inf
    if p.kind in ("sphere", "calotte", "cylinder", "cone", "circle"):
        radius = float(p.radius_mm or np.inf)
        shape = Shape(
            kind="sphere" if p.kind == "calotte" else p.kind,
            point=alignment.points(p.point),
            frame=np.eye(3) if p.direction is None else frame_along(alignment.directions(p.direction)),
            radius=radius,
            psi=float(np.radians(p.half_angle_deg or 0.0)),
        )
    if p.kind == "plane":
        length = float(np.sqrt(4 * np.linalg.norm(p.u or (1.0,)) * np.linalg.norm(p.v or (1.0,))))
    if p.kind == "line":
        length = float(p.length_mm or np.inf)
    return Target(name=name, kind=p.kind, x=x, n=n, area=_area(p) / len(x), shape=shape, radius=radius, length=length)


def _area(p: FeaturePlan) -> float:
    """mm^2 of a feature's surface; a circle or line counts as a band of 1 mm."""
    r, length = float(p.radius_mm or 0.0), float(p.length_mm or 0.0)
    if p.kind == "plane":
        return float(4 * np.linalg.norm(p.u or (0.0,)) * np.linalg.norm(p.v or (0.0,)))
    if p.kind in ("sphere", "calotte"):
        cap = np.pi if p.kind == "sphere" else np.radians(float(p.cap_deg or 180.0))
        return float(2 * np.pi * r**2 * (1 - np.cos(cap)))
    if p.kind == "circle":
        return 2 * np.pi * r
    if p.kind == "line":
        return length
    return 2 * np.pi * r * length / float(np.cos(np.radians(p.half_angle_deg or 0.0)))


def _require_on_part(part: Part, found: tuple[Target, ...]) -> None:
    for target in found:
        inside = part.winding(target.x - OFF_SURFACE_MM * target.n) > 0.5
        outside = part.winding(target.x + OFF_SURFACE_MM * target.n) < 0.5
        share = float((inside & outside).mean())
        if share < OFF_SURFACE_SHARE:
            side = "inward is missing or too much" if (~inside & ~outside).mean() > OFF_SURFACE_SHARE else "it lies off"
            raise InputError(
                f"feature {target.name!r}: at only {100 * share:.0f} % of its points the surface of {part.name} lies "
                f"within {OFF_SURFACE_MM} mm with the material behind it ({side}); give the feature in the part's "
                "coordinates, and alignment.start where these are not those of W"
            )


def tuy_points(part: Part, targets: tuple[Target, ...]) -> Array:
    """(k, 3): points in the material near the features, spread as far from one another as they can be."""
    x, n = (np.concatenate([getattr(t, name) for t in targets]) for name in ("x", "n"))
    chosen = [int(np.argmin(np.linalg.norm(x - x.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(x - x[chosen[0]], axis=1)
    while len(chosen) < min(TUY_POINTS, len(x)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(x - x[chosen[-1]], axis=1))
    out = x[chosen].copy()
    for step in reversed(INWARD):
        moved = x[chosen] - step * n[chosen]
        inside = part.winding(moved) > 0.5
        out[inside] = moved[inside]
    return out


def plane_normals() -> Array:
    """(250, 3) directions of planes, even over a half sphere."""
    return half_sphere(PLANES)
