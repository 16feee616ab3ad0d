"""Which points belong to a feature: its nominal geometry with a safety distance, and edges masked.

Extents shrink by the safety distance.  A surface point whose normal turns more than `max_angle` from the nominal one
lies at an edge (a shaft, a rim), and so does everything within the safety distance of it; the paper's rule is 0.5 mm
and 15 degrees (sec. 6.2).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.features.shapes import frame_along
from tomopose.measurement.plan import FeaturePlan
from tomopose.measurement.probing import circle_pattern, cylinder_pattern, line_pattern, plane_pattern, sphere_pattern
from tomopose.units import Array

T = TypeVar("T")


def without_edges(points: Array, angle: Array, max_angle: float, safety: float) -> np.ndarray:
    """(n,) True for points (n, 3), mm, that keep `safety` from every point whose angle (n,), rad, is too large."""
    from scipy.spatial import cKDTree

    steep = angle > max_angle
    if not steep.any():
        return ~steep
    if steep.all() or safety == 0:
        return ~steep
    apart = cKDTree(points[steep]).query(points, distance_upper_bound=safety)[0]
    return ~steep & (apart > safety)


def nominal_pattern(plan: FeaturePlan, alignment: Alignment) -> tuple[Array, Array]:
    """Points (n, 3) and normals (n, 3) from material to background, in W, to probe a feature at.

    InputError where the safety distance leaves nothing of it.
    """
    point = alignment.points(plan.point)
    s = plan.safety_mm
    if plan.kind in ("sphere", "calotte"):
        radius = given(plan.radius_mm)
        cap = np.pi if plan.kind == "sphere" else np.radians(given(plan.cap_deg)) - s / radius
        _require_left(plan.kind, float(cap))
        axis = (0.0, 0.0, 1.0) if plan.direction is None else alignment.directions(given(plan.direction))
        x, n = sphere_pattern(point, radius, plan.n_points, axis=axis, cap=float(cap))
    elif plan.kind == "plane":
        u, v = (np.asarray(w, dtype=np.float64) for w in (plan.u, plan.v))
        sides = [w * (1 - s / float(np.linalg.norm(w))) for w in (u, v)]
        _require_left(plan.kind, float(min(np.linalg.norm(w) for w in (u, v))) - s)
        half_u, half_v = (alignment.directions(w) for w in sides)
        x, n = plane_pattern(point, alignment.directions(given(plan.direction)), half_u, half_v, plan.n_points)
    elif plan.kind == "circle":
        x, n = circle_pattern(point, alignment.directions(given(plan.direction)), given(plan.radius_mm), plan.n_points)
    elif plan.kind == "line":
        length = given(plan.length_mm) - 2 * s
        _require_left(plan.kind, length)
        x, n = line_pattern(
            point,
            alignment.directions(given(plan.direction)),
            alignment.directions(given(plan.normal)),
            length,
            plan.n_points,
        )
    else:
        length = given(plan.length_mm) - 2 * s
        _require_left(plan.kind, length)
        half_angle = np.radians(given(plan.half_angle_deg)) if plan.kind == "cone" else 0.0
        x, n = cylinder_pattern(
            point,
            alignment.directions(given(plan.direction)),
            given(plan.radius_mm),
            length,
            plan.n_points,
            half_angle=float(half_angle),
        )
    return x, -n if plan.inward else n


def surface_region(plan: FeaturePlan, alignment: Alignment, points: Array, normals: Array) -> np.ndarray:
    """(n,) True for surface points (n, 3) with normals (n, 3), in W, that belong to the feature."""
    x = (points - alignment.t) @ alignment.R - np.asarray(plan.point)
    n = normals @ alignment.R * (-1.0 if plan.inward else 1.0)
    s = plan.safety_mm
    band = plan.band_mm if plan.band_mm is not None else 0.5
    if plan.kind in ("sphere", "calotte"):
        rho = np.linalg.norm(x, axis=1)
        outward = x / np.maximum(rho, 1e-300)[:, None]
        off, inside = rho - given(plan.radius_mm), np.ones(len(x), dtype=bool)
        if plan.kind == "calotte":
            axis = frame_along(np.asarray(plan.direction))[2]
            inside = np.arccos(np.clip(outward @ axis, -1, 1)) <= np.radians(given(plan.cap_deg)) - s / max(
                given(plan.radius_mm), 1e-9
            )
    elif plan.kind == "plane":
        frame = frame_along(np.asarray(plan.direction))
        u, v = (np.asarray(w, dtype=np.float64) for w in (plan.u, plan.v))
        along = [np.abs(x @ w) / np.linalg.norm(w) <= np.linalg.norm(w) - s for w in (u, v)]
        off, inside = x @ frame[2], along[0] & along[1]
        outward = np.broadcast_to(frame[2], x.shape)
    else:
        frame = frame_along(np.asarray(plan.direction))
        y = x @ frame.T
        psi = np.radians(given(plan.half_angle_deg)) if plan.kind == "cone" else 0.0
        rho = np.maximum(np.hypot(y[:, 0], y[:, 1]), 1e-300)
        off = (rho - given(plan.radius_mm)) * np.cos(psi) - y[:, 2] * np.sin(psi)
        inside = np.abs(y[:, 2]) <= given(plan.length_mm) / 2 - s
        radial = np.column_stack([y[:, 0] / rho, y[:, 1] / rho, np.zeros(len(y))])
        outward = (radial * np.cos(psi) - np.array([0, 0, np.sin(psi)])) @ frame
    near = np.flatnonzero(inside & (np.abs(off) <= band))
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", n[near], outward[near]), -1, 1))
    # The other side of a thin wall looks the other way: it is no edge, it is another feature.
    same_side = angle < np.pi / 2
    near, angle = near[same_side], angle[same_side]
    mask = np.zeros(len(points), dtype=bool)
    mask[near[without_edges(points[near], angle, np.radians(plan.max_angle_deg), s)]] = True
    return mask


def given(value: T | None) -> T:
    """A number or vector of a feature's nominal geometry.  InputError where the plan does not hold it."""
    if value is None:
        raise InputError("the feature's nominal geometry is incomplete")
    return value


def _require_left(kind: str, left: float) -> None:
    if left <= 0:
        raise InputError(f"the safety distance leaves nothing of the {kind}; make safety_mm smaller")
