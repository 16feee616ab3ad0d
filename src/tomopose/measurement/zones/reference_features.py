"""Reference features other than least squares: minimum zone, minimum circumscribed, maximum inscribed.

ISO 1101:2017 marks them C (minimax, Chebyshev), N and X; least squares is G.  They are also the associations of datums
in ISO 5459.  All points count, and a few of them, the contacts, determine the feature:

    minimum-zone            min over the feature of max |d_i|: plane, circle, sphere, cylinder, cone; of a line in space
                            the axis of the narrowest cylinder that holds all points
    minimum-circumscribed   the smallest circle, sphere or cylinder that holds all points
    maximum-inscribed       the largest one, near the least-squares one, that holds none

Only points at the rim of the cloud can be contacts.  A few hundred of them are solved for exactly, all points are held
against the solution, those beyond it join, and so on until no more join: then the solution is that of all points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.features.feature import Association, Feature
from tomopose.measurement.features.fits import LEAST_POINTS, feature_distances
from tomopose.measurement.features.shapes import Shape, frame_along
from tomopose.measurement.zones.distances import CHANGES, changed, changed_distances
from tomopose.measurement.zones.minimax import FEASIBLE, Minimax, minimise_greatest
from tomopose.units import Array

CELLS = 12
"""Cells a side into which the cloud is divided for the first candidates: two of each cell."""
JOIN = 60
"""Points that join at most in one round: the farthest beyond the solution."""
ROUNDS = 60
FAR = 10.0
"""Change, in sizes of the cloud, from which the points leave the feature unbounded."""
EXACT = 1e-12
"""Share of the cloud's size below which points lie on the feature within rounding, and it is that of any criterion."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cloud:
    """Points y (n, 3) in the frame of the least-squares feature, in units of their size."""

    base: Shape
    y: Array
    association: Association

    @property
    def keeps_radius(self) -> bool:
        """Whether the radius is a change of its own, and not the greatest distance itself."""
        return self.association == "minimum-zone" and self.base.kind != "line"

    @property
    def signs(self) -> tuple[float, ...]:
        if self.keeps_radius:
            return 1.0, -1.0
        return (-1.0,) if self.association == "maximum-inscribed" else (1.0,)

    @property
    def size(self) -> int:
        return CHANGES[self.base.kind] - (0 if self.keeps_radius or self.base.kind == "line" else 1)

    def functions(self, q: Array, rows: np.ndarray) -> tuple[Array, Array]:
        """The functions of some points: each sign of their distances, and the derivatives."""
        whole = np.zeros(CHANGES[self.base.kind])
        whole[: self.size] = q
        d, J = changed_distances(self.base, whole, self.y[rows])
        J = J[:, : self.size]
        return np.concatenate([s * d for s in self.signs]), np.concatenate([s * J for s in self.signs])


def associated(feature: Feature, association: Association) -> Feature:
    """The feature of another criterion through the points that a least-squares feature used, mm.

    `contacts` names the points that determine it.  Its covariance is nan: extreme points determine it, and the scatter
    of one surface does not say how uncertain they are.

    Raises InputError where the kind has no such feature, the points leave it unbounded (an inscribed circle of a short
    arc), or no certified minimum is found.
    """
    if association == feature.association:
        return feature
    if association == "least-squares":
        raise InputError(f"a {feature.association} {feature.kind} holds no least-squares one; fit its points again")
    kind = "sphere" if feature.kind == "calotte" else feature.kind
    if association != "minimum-zone" and kind not in ("circle", "sphere", "cylinder"):
        raise InputError(f"a {kind} has no {association} feature")
    rows = np.flatnonzero(feature.used)
    if len(rows) < LEAST_POINTS[kind]:
        raise InputError(f"{len(rows)} points; a {kind} needs at least {LEAST_POINTS[kind]}")
    cloud, scale = _cloud(feature, kind, rows, association)
    solution, contacts = _solved(cloud)
    spread = float(np.ptp(feature.residuals[rows]) if kind != "line" else feature.residuals[rows].max())
    if not solution.optimal and spread > EXACT * scale:
        raise InputError(
            f"the {association} {kind} of {len(rows)} points is not certified: gradient {solution.stationarity:.1e}, "
            f"curvature {solution.curvature:.1e}; the points do not determine it"
        )
    shape = changed(cloud.base, np.concatenate([solution.q, np.zeros(CHANGES[kind] - cloud.size)]))
    radius = shape.radius
    if association == "minimum-circumscribed":
        radius += solution.value
    elif association == "maximum-inscribed":
        radius -= solution.value
    vector = _vector(feature, kind, shape, radius, scale, rows)
    return replace(
        feature,
        vector=vector,
        covariance=np.full((8, 8), np.nan),
        residuals=feature_distances(kind, vector, feature.points),
        n_effective=float(len(contacts)),
        dof=0.0,
        association=association,
        contacts=tuple(int(i) for i in rows[contacts]),
    )


def _cloud(feature: Feature, kind: str, rows: np.ndarray, association: Association) -> tuple[_Cloud, float]:
    x = feature.points[rows]
    centre = feature.point
    frame = np.eye(3) if kind == "sphere" else frame_along(feature.direction)
    y = (x - centre) @ frame.T
    scale = float(np.sqrt(np.mean(np.sum((x - x.mean(axis=0)) ** 2, axis=1))))
    radius = float(feature.vector[6]) / scale if np.isfinite(feature.vector[6]) else 0.0
    if kind == "line":
        radius = max(float(np.hypot(y[:, 0], y[:, 1]).max()) / scale, 1e-9)
    psi = float(feature.vector[7]) if kind == "cone" else 0.0
    base = Shape(kind=kind, point=centre / scale, frame=frame, radius=radius, psi=psi)
    return _Cloud(base=base, y=y / scale, association=association), scale


def _solved(cloud: _Cloud) -> tuple[Minimax, np.ndarray]:
    """The certified solution over all points, and its contacts as indices of them."""
    everything = np.arange(len(cloud.y))
    q = np.zeros(cloud.size)
    chosen = _first_candidates(cloud)
    kind = cloud.base.kind
    for _ in range(ROUNDS):
        solution = minimise_greatest(lambda p, rows=chosen: cloud.functions(p, rows), q)  # type: ignore[misc]
        q = solution.q
        if not np.isfinite(q).all() or float(np.abs(q).max()) > FAR:
            raise InputError(
                f"{len(everything)} points leave the {cloud.association} {kind} unbounded; give points that cover more"
            )
        f = cloud.functions(q, everything)[0].reshape(len(cloud.signs), -1).max(axis=0)
        beyond = np.flatnonzero(f > solution.value + FEASIBLE)
        if not beyond.size:
            return solution, np.unique(chosen[np.array(solution.active) % len(chosen)])
        worst = beyond[np.argsort(-f[beyond], kind="stable")]
        chosen = np.union1d(chosen, np.concatenate([worst[: JOIN // 2], _one_a_cell(cloud, f, beyond)[: JOIN // 2]]))
    raise InputError(f"the {cloud.association} {kind} of {len(everything)} points was not found in {ROUNDS} rounds")


def _cells(cloud: _Cloud) -> np.ndarray:
    """(n,) number of the cell of each point: by direction and height about an axis, by place on a plane."""
    y = cloud.y
    if cloud.base.kind == "plane":
        one, other = y[:, 0], y[:, 1]
    else:
        one = np.arctan2(y[:, 1], y[:, 0])
        other = y[:, 2] / (np.linalg.norm(y, axis=1) + 1e-300) if cloud.base.kind == "sphere" else y[:, 2]
    number = np.zeros(len(y), dtype=np.intp)
    for values in (one, other):
        low, high = float(values.min()), float(values.max())
        share = (values - low) / (high - low) if high > low else np.zeros(len(values))
        number = number * CELLS + np.minimum((share * CELLS).astype(np.intp), CELLS - 1)
    return number


def _one_a_cell(cloud: _Cloud, f: Array, rows: np.ndarray) -> np.ndarray:
    """Of some points, the one with the greatest f in each cell, greatest first."""
    cell = _cells(cloud)[rows]
    order = np.lexsort((-f[rows], cell))
    first = order[np.flatnonzero(np.diff(cell[order], prepend=-1))]
    found = rows[first]
    return np.asarray(found[np.argsort(-f[found], kind="stable")])


def _first_candidates(cloud: _Cloud) -> np.ndarray:
    everything = np.arange(len(cloud.y))
    if len(everything) <= 2 * JOIN:
        return everything
    f = cloud.functions(np.zeros(cloud.size), everything)[0].reshape(len(cloud.signs), -1)
    return np.unique(np.concatenate([_one_a_cell(cloud, row, everything) for row in f]))


def _vector(feature: Feature, kind: str, shape: Shape, radius: float, scale: float, rows: np.ndarray) -> Array:
    """The feature's vector (8,), its point next to the points' centroid, its direction as before."""
    vector = np.array(feature.vector)
    point = scale * shape.point
    n = shape.frame[2]
    if kind == "sphere":
        vector[:3], vector[6] = point, scale * radius
        return vector
    n = n if n @ feature.direction > 0 else -n
    along = float((feature.points[rows].mean(axis=0) - point) @ n)
    if kind == "plane":
        middle = feature.points[rows].mean(axis=0)
        vector[:3], vector[3:6] = middle - along * n, n
        return vector
    if kind == "circle":
        vector[:3], vector[6] = point, scale * radius
        return vector
    vector[:3], vector[3:6] = point + along * n, n
    if kind == "line":
        return vector
    if kind == "cone":
        vector[6], vector[7] = scale * radius + along * np.tan(shape.psi), shape.psi
    else:
        vector[6] = scale * radius
    return vector
