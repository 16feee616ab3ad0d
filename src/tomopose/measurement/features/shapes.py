"""Orthogonal distances of points to curved shapes with their derivatives, and the Gauss-Newton step that fits them.

Each shape is worked in its own frame: origin at its point, third axis along its direction.  There the derivatives are
those of Shakarji, J. Res. NIST 103 (1998) 633: x_0, y_0 shift the axis, a, b tilt it to (a, b, 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tomopose.errors import InputError
from tomopose.least_squares import Status, least_squares
from tomopose.units import Array

MAX_STEPS = 200
STEP_TOLERANCE = 1e-15
DEGENERATE = 1e-7
"""Ratio of the least to the greatest singular value of the scaled derivatives below which points fix no shape."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """kind; point (3,); frame (3, 3), rows e_1, e_2, direction; radius; half angle.  Any unit of length."""

    kind: str
    point: Array
    frame: Array
    radius: float = 0.0
    psi: float = 0.0


def frame_along(direction: Array) -> Array:
    """Right-handed rows e_1, e_2, direction / |direction|."""
    n = np.asarray(direction, dtype=np.float64)
    n = n / np.linalg.norm(n)
    helper = np.eye(3)[int(np.argmin(np.abs(n)))]
    e_1 = np.cross(helper, n)
    e_1 /= np.linalg.norm(e_1)
    return np.stack([e_1, np.cross(n, e_1), n])


def distances(shape: Shape, points: Array) -> Array:
    """(n,) signed orthogonal distances, positive outside."""
    y = (points - shape.point) @ shape.frame.T
    if shape.kind == "sphere":
        result: Array = np.linalg.norm(y, axis=1) - shape.radius
        return result
    rho = np.hypot(y[:, 0], y[:, 1])
    if shape.kind == "cone":
        found: Array = (rho - shape.radius) * np.cos(shape.psi) - y[:, 2] * np.sin(shape.psi)
        return found
    return rho - shape.radius


def derivatives(shape: Shape, points: Array) -> Array:
    """(n, p): sphere x y z r; circle x_0 y_0 r (in its plane); cylinder x_0 y_0 a b r; cone x_0 y_0 a b r psi."""
    y = (points - shape.point) @ shape.frame.T
    if shape.kind == "sphere":
        return np.column_stack([-y / np.linalg.norm(y, axis=1)[:, None], -np.ones(len(y))])
    rho = np.maximum(np.hypot(y[:, 0], y[:, 1]), 1e-300)
    c, s = y[:, 0] / rho, y[:, 1] / rho
    if shape.kind == "circle":
        return np.column_stack([-c, -s, -np.ones(len(y))])
    if shape.kind == "cylinder":
        return np.column_stack([-c, -s, -c * y[:, 2], -s * y[:, 2], -np.ones(len(y))])
    cos, sin = np.cos(shape.psi), np.sin(shape.psi)
    tilt = -cos * y[:, 2] - sin * rho
    return np.column_stack(
        [-c * cos, -s * cos, c * tilt, s * tilt, np.full(len(y), -cos), -(rho - shape.radius) * sin - y[:, 2] * cos]
    )


def moved(shape: Shape, step: Array) -> Shape:
    """The shape after a step in the parameters of `derivatives`."""
    e_1, e_2, n = shape.frame
    if shape.kind == "sphere":
        return Shape(kind="sphere", point=shape.point + step[:3], frame=shape.frame, radius=shape.radius + step[3])
    point = shape.point + step[0] * e_1 + step[1] * e_2
    if shape.kind == "circle":
        return Shape(kind="circle", point=point, frame=shape.frame, radius=shape.radius + step[2])
    frame = frame_along(n + step[2] * e_1 + step[3] * e_2)
    psi = shape.psi + step[5] if shape.kind == "cone" else 0.0
    return Shape(kind=shape.kind, point=point, frame=frame, radius=shape.radius + step[4], psi=psi)


def slid(shape: Shape) -> Shape:
    """The same cylinder or cone with its point where the axis is nearest to the origin."""
    if shape.kind not in ("cylinder", "cone"):
        return shape
    along = -float(shape.point @ shape.frame[2])
    return Shape(
        kind=shape.kind,
        point=shape.point + along * shape.frame[2],
        frame=shape.frame,
        radius=shape.radius + along * np.tan(shape.psi),
        psi=shape.psi,
    )


def free_columns(kind: str, fixed_radius: bool) -> Array:
    """Indices of the derivatives' columns that are free."""
    n = {"sphere": 4, "circle": 3, "cylinder": 5, "cone": 6}[kind]
    radius = {"sphere": 3, "circle": 2, "cylinder": 4, "cone": 4}[kind]
    return np.array([k for k in range(n) if not (fixed_radius and k == radius)])


def refine(start: Shape, points: Array, weight: Array, *, fixed_radius: bool = False) -> tuple[Shape, float]:
    """Least squares of weight times distance by Levenberg-Marquardt from `start`; the shape and its sum of squares.

    points are centred and scaled to about one; weight (n,).
    """
    free = free_columns(start.kind, fixed_radius)
    size = free[-1] + 1 if not fixed_radius else len(free) + 1

    def rows(shape: Shape) -> tuple[Array, Array]:
        return -weight * distances(shape, points), weight[:, None] * derivatives(shape, points)[:, free]

    def after(shape: Shape, step: Array) -> Shape:
        full = np.zeros(size)
        full[free] = step
        return slid(moved(shape, full))

    found = least_squares(rows, after, slid(start), steps=MAX_STEPS, tolerance=STEP_TOLERANCE)
    return found.state, np.inf if found.status is Status.SINGULAR else found.cost


def require_determined(shape: Shape, points: Array, *, fixed_radius: bool) -> None:
    """InputError where the points do not fix the shape (all on a line, in one plane, on too short an arc)."""
    J = derivatives(shape, points)[:, free_columns(shape.kind, fixed_radius)]
    scale = np.linalg.norm(J, axis=0)
    values = np.linalg.svd(J / np.where(scale > 0, scale, 1.0), compute_uv=False)
    if values[-1] < DEGENERATE * values[0]:
        raise InputError(
            f"{len(points)} points do not determine a {shape.kind}: the least singular value is "
            f"{values[-1] / values[0]:.1e} of the greatest; give points that cover more of it"
        )


# -- start values ----------------------------------------------------------------------------------------------------


def half_sphere(n: int) -> Array:
    """(n, 3) unit vectors spread evenly over a half sphere (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    z = 1.0 - k / n
    angle = k * np.pi * (1.0 + np.sqrt(5.0))
    rho = np.sqrt(1.0 - z**2)
    return np.column_stack([rho * np.cos(angle), rho * np.sin(angle), z])


def start_sphere(points: Array) -> Shape:
    """Algebraic sphere: |x|^2 = 2 c.x + k."""
    A = np.column_stack([2 * points, np.ones(len(points))])
    c = np.linalg.lstsq(A, np.sum(points**2, axis=1), rcond=None)[0]
    return Shape(kind="sphere", point=c[:3], frame=np.eye(3), radius=float(np.sqrt(max(c[3] + c[:3] @ c[:3], 1e-12))))


def start_circle(points: Array, frame: Array) -> Shape:
    """Algebraic circle in the plane of `frame`'s first two rows through the origin."""
    y = points @ frame.T
    A = np.column_stack([2 * y[:, :2], np.ones(len(y))])
    c = np.linalg.lstsq(A, np.sum(y[:, :2] ** 2, axis=1), rcond=None)[0]
    r = float(np.sqrt(max(c[2] + c[:2] @ c[:2], 1e-12)))
    return Shape(kind="circle", point=c[:2] @ frame[:2], frame=frame, radius=r)


def starts_about_axes(kind: str, points: Array, directions: Array, keep: int) -> Sequence[Shape]:
    """The `keep` best algebraic cylinders or cones about the given directions, best first.

    About a known axis a cone is linear: x^2 + y^2 = 2 x_0 x + 2 y_0 y + k^2 z^2 + 2 r k z + c; a cylinder has k = 0.
    """
    found: list[tuple[float, int, Shape]] = []
    for index, direction in enumerate(directions):
        frame = frame_along(direction)
        y = points @ frame.T
        columns = [2 * y[:, 0], 2 * y[:, 1], np.ones(len(y))]
        if kind == "cone":
            columns += [y[:, 2], y[:, 2] ** 2]
        A = np.column_stack(columns)
        q = np.sum(y[:, :2] ** 2, axis=1)
        c = np.linalg.lstsq(A, q, rcond=None)[0]
        r = float(np.sqrt(max(c[2] + c[:2] @ c[:2], 1e-12)))
        psi = 0.0
        if kind == "cone":
            slope = float(np.sqrt(max(c[4], 1e-4)))
            psi = float(np.arctan(slope))
            if c[3] < 0:
                frame = np.stack([frame[1], frame[0], -frame[2]])
                c = np.array([c[1], c[0], *c[2:]])
        shape = Shape(kind=kind, point=c[:2] @ frame[:2], frame=frame, radius=r, psi=psi)
        d = distances(shape, points)
        found.append((float(d @ d), index, shape))
    return [shape for _, _, shape in sorted(found, key=lambda item: item[:2])[:keep]]
