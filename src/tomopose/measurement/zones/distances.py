"""Distances of points to a feature as smooth functions of small changes of it, with their derivatives.

Points y (n, 3) are in the feature's own frame: origin at its point, third axis along its direction.  The changes q are

    plane      c, a, b                 height along the axis, tilt
    circle     x_0, y_0, r
    sphere     x_0, y_0, z_0, r
    line       x_0, y_0, a, b
    cylinder   x_0, y_0, a, b, r
    cone       x_0, y_0, a, b, r, psi

with the axis through (x_0, y_0, 0) along (a, b, 1).  A tilt need not be small: the formulas hold for any a and b.  All
lengths are in one unit, in which the points' size is about 1.
"""

from __future__ import annotations

import numpy as np

from tomopose.measurement.features.shapes import Shape, frame_along
from tomopose.units import Array

CHANGES = {"plane": 3, "circle": 3, "sphere": 4, "line": 4, "cylinder": 5, "cone": 6}


def changed_distances(base: Shape, q: Array, y: Array) -> tuple[Array, Array]:
    """Signed distances (n,) of local points to the feature `base` changed by q, and their derivatives by q (n, k).

    A line has rho^2 / (2 rho_0), rho_0 the base's radius, since distances have no derivative on the line itself.
    """
    if base.kind == "plane":
        return _plane(q, y)
    if base.kind in ("circle", "sphere"):
        k = 2 if base.kind == "circle" else 3
        w = y[:, :k] - q[:k]
        rho = np.maximum(np.linalg.norm(w, axis=1), 1e-300)
        return rho - base.radius - q[k], np.column_stack([-w / rho[:, None], -np.ones(len(y))])
    along, across, turned = _about_axis(q, y)
    if base.kind == "line":
        J = np.column_stack([-across[:, :2], -along[:, None] * (across @ turned.T)])
        return np.sum(across**2, axis=1) / (2 * base.radius), J / base.radius
    rho = np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    e = across / rho[:, None]
    J_rho = np.column_stack([-e[:, :2], -along[:, None] * (e @ turned.T)])
    radius = base.radius + q[4]
    if base.kind == "cylinder":
        return rho - radius, np.column_stack([J_rho, -np.ones(len(y))])
    n = np.array([q[2], q[3], 1.0]) / np.sqrt(q[2] ** 2 + q[3] ** 2 + 1.0)
    w = across + along[:, None] * n
    J_along = np.column_stack([np.tile(-n[:2], (len(y), 1)), w @ turned.T])
    psi = base.psi + q[5]
    cos, sin = np.cos(psi), np.sin(psi)
    J = np.column_stack([cos * J_rho - sin * J_along, np.full(len(y), -cos), -(rho - radius) * sin - along * cos])
    return (rho - radius) * cos - along * sin, J


def _plane(q: Array, y: Array) -> tuple[Array, Array]:
    size = np.sqrt(q[1] ** 2 + q[2] ** 2 + 1.0)
    n = np.array([q[1], q[2], 1.0]) / size
    w = y - np.array([0.0, 0.0, q[0]])
    turned = (np.eye(3)[:2] - np.outer(n[:2], n)) / size
    return w @ n, np.column_stack([np.full(len(y), -n[2]), w @ turned.T])


def _about_axis(q: Array, y: Array) -> tuple[Array, Array, Array]:
    """Place along the axis (n,), offset from it (n, 3), and the derivatives (2, 3) of its direction by a and b."""
    size = np.sqrt(q[2] ** 2 + q[3] ** 2 + 1.0)
    n = np.array([q[2], q[3], 1.0]) / size
    w = y - np.array([q[0], q[1], 0.0])
    along = w @ n
    return along, w - along[:, None] * n, (np.eye(3)[:2] - np.outer(n[:2], n)) / size


def changed(base: Shape, q: Array) -> Shape:
    """The feature `base` after the changes q."""
    e = base.frame
    if base.kind in ("circle", "sphere"):
        k = CHANGES[base.kind] - 1
        return Shape(kind=base.kind, point=base.point + q[:k] @ e[:k], frame=e, radius=base.radius + float(q[k]))
    shift, a, b = (q[0] * e[2], q[1], q[2]) if base.kind == "plane" else (q[:2] @ e[:2], q[2], q[3])
    return Shape(
        kind=base.kind,
        point=base.point + shift,
        frame=frame_along(np.array([a, b, 1.0]) @ e),
        radius=base.radius + (float(q[4]) if len(q) > 4 else 0.0),
        psi=base.psi + (float(q[5]) if len(q) > 5 else 0.0),
    )
