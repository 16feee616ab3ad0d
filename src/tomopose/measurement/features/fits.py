"""Least-squares features by orthogonal distance, with covariance, outlier rule and the mask of used points.

Method: Shakarji, J. Res. NIST 103 (1998) 633, doi 10.6028/jres.103.043.  Plane and line by singular values; sphere,
circle, cylinder and cone by Levenberg-Marquardt from algebraic start values, cylinder and cone from many directions.
A circle in space is the two-step one: plane first, then the circle in it.

All functions take points (n, 3), mm in any one frame, and share these options:

sigma:              (n,) standard uncertainties of the points, mm; equal unless given.
area:               (n,) of the surface that each point represents; equal unless given.  Vertices of a mesh crowd where
                    it passes close to a voxel's centre; weighed by areas, each piece of the surface counts alike.
outliers:           points farther than so many rms from the fit are dropped and the fit is repeated; None keeps all.
correlation_range:  distance up to which neighbouring points are tested for common errors, mm; 0 takes every point as
                    independent.  Vertices of a CT surface share voxels: give about 6 voxels.

They raise ShapeError for an array of the wrong shape, InputError for points that are not finite, too few or degenerate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tomopose.errors import InputError, ShapeError
from tomopose.measurement.features.correlation import Independence, independence
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.features.shapes import (
    DEGENERATE,
    Shape,
    derivatives,
    distances,
    frame_along,
    free_columns,
    half_sphere,
    refine,
    require_determined,
    start_circle,
    start_sphere,
    starts_about_axes,
)
from tomopose.units import Array

LEAST_POINTS = {"plane": 3, "line": 2, "circle": 3, "sphere": 4, "calotte": 4, "cylinder": 5, "cone": 6}
START_DIRECTIONS, STARTS, START_POINTS = 300, 6, 1000
MAX_OUTLIER_ROUNDS = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """One linear least-squares problem at the solution: distances d (m,) with sigma (m,), their derivatives J (m, p),
    and T (8, p), the derivatives of the feature's vector.  The blocks of a feature are independent of one another.
    m is the number of points or a multiple of it: one component of all points after the other."""

    d: Array
    sigma: Array
    J: Array
    T: Array


Fit = Callable[[Array, Array], tuple[Array, list[Block]]]
"""(points, sigma) -> vector (8,), blocks."""


def fit_plane(
    points: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    area: npt.ArrayLike | None = None,
    outliers: float | None = None,
    correlation_range: float = 0.0,
) -> Feature:
    """Plane through the weighted centroid; the normal belongs to the least singular value.

    The normal's sign makes its largest component positive.
    """
    return _fit("plane", _plane, points, sigma, area, outliers, correlation_range)


def fit_line(
    points: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    area: npt.ArrayLike | None = None,
    outliers: float | None = None,
    correlation_range: float = 0.0,
) -> Feature:
    """Line through the weighted centroid along the greatest singular value.  Residuals are distances, not signed."""
    return _fit("line", _line, points, sigma, area, outliers, correlation_range)


def fit_circle(
    points: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    area: npt.ArrayLike | None = None,
    outliers: float | None = None,
    correlation_range: float = 0.0,
) -> Feature:
    """Circle in space: the plane of the points, then the circle in it.  Residuals are those in the plane."""
    return _fit("circle", _circle, points, sigma, area, outliers, correlation_range)


def fit_sphere(
    points: npt.ArrayLike,
    *,
    radius: float | None = None,
    sigma: npt.ArrayLike | None = None,
    area: npt.ArrayLike | None = None,
    outliers: float | None = None,
    correlation_range: float = 0.0,
) -> Feature:
    """Sphere; with `radius`, mm, held at that value.

    On a calotte centre and radius hang together strongly: their covariance says how, and a known radius frees it.
    """
    if radius is not None and not (np.isfinite(radius) and radius > 0):
        raise InputError(f"the radius held is {radius} mm; a positive length is needed")
    return _fit("sphere", lambda x, s: _sphere(x, s, radius), points, sigma, area, outliers, correlation_range)


def fit_cylinder(
    points: npt.ArrayLike,
    *,
    direction: npt.ArrayLike | None = None,
    sigma: npt.ArrayLike | None = None,
    area: npt.ArrayLike | None = None,
    outliers: float | None = None,
    correlation_range: float = 0.0,
) -> Feature:
    """Cylinder.  direction: (3,) about along the axis, where it is known; otherwise it is searched for."""
    return _fit(
        "cylinder",
        lambda x, s: _about_axis("cylinder", x, s, direction),
        points,
        sigma,
        area,
        outliers,
        correlation_range,
    )


def fit_cone(
    points: npt.ArrayLike,
    *,
    direction: npt.ArrayLike | None = None,
    sigma: npt.ArrayLike | None = None,
    area: npt.ArrayLike | None = None,
    outliers: float | None = None,
    correlation_range: float = 0.0,
) -> Feature:
    """Cone; its direction is that in which it widens.  direction: (3,) about along the axis, where it is known."""
    return _fit(
        "cone", lambda x, s: _about_axis("cone", x, s, direction), points, sigma, area, outliers, correlation_range
    )


# -- the common part -------------------------------------------------------------------------------------------------


def _checked(
    kind: str, points: npt.ArrayLike, sigma: npt.ArrayLike | None, area: npt.ArrayLike | None
) -> tuple[Array, Array, Array]:
    x = np.asarray(points, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ShapeError(f"points of a {kind} are (n, 3); got {x.shape}")
    if len(x) < LEAST_POINTS[kind]:
        raise InputError(f"{len(x)} points; a {kind} needs at least {LEAST_POINTS[kind]}")
    if not np.isfinite(x).all():
        raise InputError(f"{int((~np.isfinite(x)).any(axis=1).sum())} of {len(x)} points are not finite; drop them")
    each = []
    for name, given, what in (("sigma", sigma, "length"), ("area", area, "area")):
        values = np.ones(len(x)) if given is None else np.asarray(given, dtype=np.float64)
        if values.shape != (len(x),) or not (np.isfinite(values).all() and (values > 0).all()):
            raise InputError(f"{name} needs one positive {what} for each of {len(x)} points; got shape {values.shape}")
        each.append(values)
    return x, each[0], each[1]


def _fit(
    kind: str,
    fit: Fit,
    points: npt.ArrayLike,
    sigma: npt.ArrayLike | None,
    area: npt.ArrayLike | None,
    outliers: float | None,
    correlation_range: float,
) -> Feature:
    x, s, a = _checked(kind, points, sigma, area)
    if outliers is not None and not outliers > 0:
        raise InputError(f"outliers is {outliers}; a positive number of rms, or None, is needed")
    keep = np.ones(len(x), dtype=bool)
    for _ in range(MAX_OUTLIER_ROUNDS):
        used = keep
        w = a[used] / a[used].mean()
        vector, blocks = fit(x[used], s[used] / np.sqrt(w))
        d = feature_distances(kind, vector, x)
        if outliers is None:
            break
        z = d / s
        keep = np.abs(z) <= outliers * np.sqrt(np.mean(z[used] ** 2)) if np.any(z[used]) else used
        if keep.sum() < LEAST_POINTS[kind]:
            raise InputError(f"outlier rule {outliers:g} rms leaves {int(keep.sum())} of {len(x)} points for a {kind}")
        if np.array_equal(keep, used):
            break
    shares = [_covariance(b, x[used], w, correlation_range) for b in blocks]
    return Feature(
        kind=kind,
        vector=vector,
        covariance=sum((c for c, _ in shares), np.zeros((8, 8))),
        points=x,
        used=used,
        residuals=d,
        n_effective=min(i.n_effective for _, i in shares),
        dof=min(i.dof for _, i in shares),
        outlier_rule="none" if outliers is None else f"{outliers:g} rms, repeated until none is left",
    )


def _covariance(block: Block, points: Array, weight: Array, correlation_range: float) -> tuple[Array, Independence]:
    """(8, 8) = T s^2 L (J' W J)^-1 T', s^2 L from the residuals; infinite where no degree of freedom is left.

    weight: (n,) of mean 1, that the block's sigma hold beside the points' own uncertainties."""
    p, n = block.J.shape[1], len(points)
    J = block.J / block.sigma[:, None]
    d = (block.d / block.sigma).reshape(-1, n)
    found = independence(points, d, J.reshape(-1, n, p), correlation_range, weight)
    covariance = block.T @ np.linalg.pinv(J.T @ J, hermitian=True) @ block.T.T
    return np.multiply(covariance, found.variance, out=np.zeros((8, 8)), where=covariance != 0), found


def feature_distances(kind: str, vector: Array, points: Array) -> Array:
    """(n,) signed orthogonal distances of points (n, 3) to a feature's vector (8,), mm; unsigned for a line."""
    point, direction = vector[:3], vector[3:6]
    if kind == "plane":
        return (points - point) @ direction
    if kind == "line":
        result: Array = np.linalg.norm(np.cross(points - point, direction), axis=1)
        return result
    shape_kind = "sphere" if kind == "calotte" else kind
    frame = np.eye(3) if shape_kind == "sphere" else frame_along(direction)
    psi = float(vector[7]) if kind == "cone" else 0.0
    return distances(Shape(kind=shape_kind, point=point, frame=frame, radius=float(vector[6]), psi=psi), points)


def _vector(point: Array, direction: npt.ArrayLike = np.nan, radius: float = np.nan, psi: float = np.nan) -> Array:
    return np.concatenate([point, np.broadcast_to(direction, (3,)), [radius, psi]])


def _sense(direction: Array) -> Array:
    """The direction or its opposite, so that the largest component is positive."""
    result: Array = direction * np.sign(direction[int(np.argmax(np.abs(direction)))])
    return result


def _centroid_frame(points: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Weighted centroid, singular values and right singular vectors of the centred points."""
    w = 1 / sigma**2
    centroid = np.sum(w[:, None] * points, axis=0) / w.sum()
    _, values, vectors = np.linalg.svd((points - centroid) / sigma[:, None], full_matrices=False)
    return centroid, values, vectors


# -- each kind -------------------------------------------------------------------------------------------------------


def _plane(points: Array, sigma: Array) -> tuple[Array, list[Block]]:
    centroid, values, vectors = _centroid_frame(points, sigma)
    if values[1] <= DEGENERATE * values[0]:
        raise InputError(f"all {len(points)} points of a plane lie on a line; give points beside it")
    n = _sense(np.cross(vectors[0], vectors[1]))
    frame = frame_along(n)
    y = (points - centroid) @ frame.T
    J = np.column_stack([-np.ones(len(y)), y[:, 0], y[:, 1]])
    T = np.zeros((8, 3))
    T[:3, 0] = n
    T[3:6, 1:] = frame[:2].T
    return _vector(centroid, n), [Block(d=y[:, 2], sigma=sigma, J=J, T=T)]


def _line(points: Array, sigma: Array) -> tuple[Array, list[Block]]:
    centroid, values, vectors = _centroid_frame(points, sigma)
    if values[0] == 0:
        raise InputError(f"all {len(points)} points of a line coincide; give points apart")
    n = _sense(vectors[0])
    frame = frame_along(n)
    y = (points - centroid) @ frame.T
    # Each point has two components across the line; both are residuals.
    zero, one = np.zeros(len(y)), np.ones(len(y))
    J = np.vstack([np.column_stack([-one, zero, -y[:, 2], zero]), np.column_stack([zero, -one, zero, -y[:, 2]])])
    T = np.zeros((8, 4))
    T[:3, :2] = frame[:2].T
    T[3:6, 2:] = frame[:2].T
    block = Block(d=np.concatenate([y[:, 0], y[:, 1]]), sigma=np.concatenate([sigma, sigma]), J=J, T=T)
    return _vector(centroid, n), [block]


def _scaled(points: Array) -> tuple[Array, Array, float]:
    centre = points.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1))))
    if scale == 0:
        raise InputError(f"all {len(points)} points coincide; give points apart")
    return (points - centre) / scale, centre, scale


def _sphere(points: Array, sigma: Array, radius: float | None) -> tuple[Array, list[Block]]:
    x, centre, scale = _scaled(points)
    fixed = radius is not None
    start = start_sphere(x)
    if radius is not None:
        start = Shape(kind="sphere", point=start.point, frame=start.frame, radius=radius / scale)
    shape, _ = refine(start, x, sigma.min() / sigma, fixed_radius=fixed)
    require_determined(shape, x, fixed_radius=fixed)
    free = free_columns("sphere", fixed)
    T = np.zeros((8, 4))
    T[:3, :3] = np.eye(3)
    T[6, 3] = 1.0
    found = _unscaled(shape, centre, scale)
    block = Block(d=distances(found, points), sigma=sigma, J=derivatives(found, points)[:, free], T=T[:, free])
    return _vector(found.point, radius=found.radius), [block]


def _circle(points: Array, sigma: Array) -> tuple[Array, list[Block]]:
    plane, (height,) = _plane(points, sigma)
    x, centre, scale = _scaled(points - ((points - plane[:3]) @ plane[3:6])[:, None] * plane[3:6])
    shape, _ = refine(start_circle(x, frame_along(plane[3:6])), x, sigma.min() / sigma)
    require_determined(shape, x, fixed_radius=False)
    found = _unscaled(shape, centre, scale)
    T = np.zeros((8, 3))
    T[:3, :2] = found.frame[:2].T
    T[6, 2] = 1.0
    # The plane's height is that at the centroid; carried to the centre it takes the tilt along.
    T_height = height.T.copy()
    T_height[:3, 1:] -= np.outer(plane[3:6], (found.point - plane[:3]) @ found.frame[:2].T)
    return _vector(found.point, plane[3:6], found.radius), [
        Block(d=distances(found, points), sigma=sigma, J=derivatives(found, points), T=T),
        Block(d=height.d, sigma=sigma, J=height.J, T=T_height),
    ]


def _about_axis(kind: str, points: Array, sigma: Array, direction: npt.ArrayLike | None) -> tuple[Array, list[Block]]:
    x, centre, scale = _scaled(points)
    spread = np.linalg.svd(x, compute_uv=False)
    if spread[1] <= DEGENERATE * spread[0]:
        raise InputError(f"all {len(points)} points of a {kind} lie on a line; give points beside it")
    some = x[:: max(len(x) // START_POINTS, 1)]
    if direction is None:
        # The principal axes are added: long or short pieces have their axis along one of them.
        directions = np.vstack([half_sphere(START_DIRECTIONS), np.linalg.svd(some, full_matrices=False)[2]])
    else:
        directions = np.asarray(direction, dtype=np.float64).reshape(1, 3)
    weight = sigma.min() / sigma
    best, cost = None, np.inf
    for start in starts_about_axes(kind, some, directions, STARTS):
        rough, rough_cost = refine(start, some, weight[:: max(len(x) // START_POINTS, 1)])
        if rough_cost < cost:
            best, cost = rough, rough_cost
    if best is None:
        raise InputError(f"{len(points)} points do not determine a {kind}: no start value led to one")
    shape, _ = refine(best, x, weight)
    require_determined(shape, x, fixed_radius=False)
    found = _unscaled(shape, centre, scale)
    n, psi, radius = found.frame[2], found.psi, found.radius
    if kind == "cone" and not 1e-6 < abs(psi) < np.pi / 2:
        raise InputError(f"the cone's half angle is {np.degrees(psi):.2g} degrees; fit a cylinder or a plane")
    J = derivatives(found, points)
    if kind == "cone" and psi < 0:
        n, psi = -n, -psi
    elif kind == "cylinder":
        n = _sense(n)
    T = np.zeros((8, J.shape[1]))
    T[:3, :2] = found.frame[:2].T
    T[3:6, 2:4] = found.frame[:2].T * np.sign(n @ found.frame[2])
    T[6, 4] = 1.0
    if kind == "cone":
        T[7, 5] = np.sign(found.psi)
    block = Block(d=distances(found, points), sigma=sigma, J=J, T=T)
    return _vector(found.point, n, radius, psi if kind == "cone" else np.nan), [block]


def _unscaled(shape: Shape, centre: Array, scale: float) -> Shape:
    return Shape(
        kind=shape.kind,
        point=centre + scale * shape.point,
        frame=shape.frame,
        radius=scale * shape.radius,
        psi=shape.psi,
    )
