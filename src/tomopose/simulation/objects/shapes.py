"""Solids: six primitives, joined by constructive solid geometry, filled with a material, fixed to a frame.

A shape is written once, in its own coordinates, and moved by `placed`.  Shapes combine with `|` (union), `&`
(intersection) and `-` (difference).  Later solids of a list displace earlier ones where they overlap, as a ball
does that is pressed into a tube.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.frames import Frame
from tomopose.units import Array
from tomopose.values import value

SPHERE, CYLINDER, CONE, BOX, TORUS, HALF_SPACE = range(6)
UNION, INTERSECTION, DIFFERENCE = -1, -2, -3


def _positive(what: str, **values: float) -> None:
    for name, given in values.items():
        if not (math.isfinite(given) and given > 0):
            raise InputError(f"{what}: {name} is {given} mm; a positive length is needed")


class Shape:
    """Anything that can be joined; see the subclasses."""

    def __or__(self, other: Shape) -> Shape:
        return Joined(op=UNION, a=self, b=other)

    def __and__(self, other: Shape) -> Shape:
        return Joined(op=INTERSECTION, a=self, b=other)

    def __sub__(self, other: Shape) -> Shape:
        return Joined(op=DIFFERENCE, a=self, b=other)

    def placed(self, *, R: ArrayLike | None = None, t: ArrayLike = (0.0, 0.0, 0.0)) -> Shape:
        """The shape after x -> R x + t (mm)."""
        R = np.eye(3) if R is None else np.asarray(R, dtype=np.float64)
        t = np.asarray(t, dtype=np.float64)
        if R.shape != (3, 3) or t.shape != (3,):
            raise ShapeError(f"a placement needs R (3, 3) and t (3,); got {R.shape} and {t.shape}")
        return self._placed(R, t)

    def along(self, axis: ArrayLike, *, t: ArrayLike = (0.0, 0.0, 0.0)) -> Shape:
        """The shape with its z axis turned to `axis` (3,) by the shortest rotation, then moved by t (mm)."""
        return self.placed(R=rotation_to(axis), t=t)

    def _placed(self, R: Array, t: Array) -> Shape:
        raise NotImplementedError

    def primitives(self) -> list[Primitive]:
        raise NotImplementedError

    def bound(self) -> tuple[Array, float]:
        """(centre, radius), mm, of a sphere that holds the shape; the radius is inf where there is no limit."""
        raise NotImplementedError

    def corners(self) -> Array:
        """Points (k, 3), mm, whose convex hull holds the shape."""
        raise NotImplementedError


def rotation_to(axis: ArrayLike) -> Array:
    """The shortest rotation (3, 3) that takes e_z to the direction `axis`."""
    a = np.asarray(axis, dtype=np.float64)
    length = np.linalg.norm(a)
    if a.shape != (3,) or not length > 0:
        raise InputError(f"axis is {axis!r}; a vector of three numbers that is not zero is needed")
    x, y, z = a / length
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)
    return np.array([[1 - x * x * k, -x * y * k, x], [-x * y * k, 1 - y * y * k, y], [-x, -y, z]])


@value
class Primitive(Shape):
    """One primitive: kind, its lengths `p` (mm), half the sides of its box, and its place: x = R x_local + t."""

    kind: int
    p: tuple[float, ...]
    radius: float
    half: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    R: Array = field(default_factory=lambda: np.eye(3))
    t: Array = field(default_factory=lambda: np.zeros(3))

    def _placed(self, R: Array, t: Array) -> Primitive:
        return Primitive(kind=self.kind, p=self.p, radius=self.radius, half=self.half, R=R @ self.R, t=R @ self.t + t)

    def primitives(self) -> list[Primitive]:
        return [self]

    def bound(self) -> tuple[Array, float]:
        return self.t, self.radius

    def corners(self) -> Array:
        return (BOX_CORNERS * self.half) @ self.R.T + self.t


@dataclass(frozen=True, kw_only=True)
class Joined(Shape):
    """Two shapes and the operation between them."""

    op: int
    a: Shape
    b: Shape

    def _placed(self, R: Array, t: Array) -> Joined:
        return Joined(op=self.op, a=self.a.placed(R=R, t=t), b=self.b.placed(R=R, t=t))

    def primitives(self) -> list[Primitive]:
        return self.a.primitives() + self.b.primitives()

    def bound(self) -> tuple[Array, float]:
        a, b = self.a.bound(), self.b.bound()
        if self.op == DIFFERENCE:
            return a
        if self.op == INTERSECTION:
            return a if a[1] <= b[1] else b
        return _enclosing(a, b)

    def corners(self) -> Array:
        if self.op == DIFFERENCE:
            return self.a.corners()
        if self.op == INTERSECTION:
            return min(self.a, self.b, key=lambda s: s.bound()[1]).corners()
        return np.concatenate([self.a.corners(), self.b.corners()])


def _enclosing(a: tuple[Array, float], b: tuple[Array, float]) -> tuple[Array, float]:
    if math.isinf(a[1]) or math.isinf(b[1]):
        return a[0], math.inf
    distance = float(np.linalg.norm(b[0] - a[0]))
    if distance + b[1] <= a[1]:
        return a
    if distance + a[1] <= b[1]:
        return b
    radius = (distance + a[1] + b[1]) / 2
    return a[0] + (b[0] - a[0]) * ((radius - a[1]) / distance), radius


def sphere(radius: float) -> Shape:
    """A ball of that radius (mm) about the origin."""
    _positive("sphere", radius=radius)
    return Primitive(kind=SPHERE, p=(radius,), radius=radius, half=(radius, radius, radius))


def cylinder(radius: float, z_0: float, z_1: float) -> Shape:
    """A cylinder about z from z_0 to z_1, mm."""
    _positive("cylinder", radius=radius, length=z_1 - z_0)
    h = (z_1 - z_0) / 2
    return Primitive(
        kind=CYLINDER,
        p=(radius, h),
        radius=math.hypot(radius, h),
        half=(radius, radius, h),
        t=np.array([0.0, 0.0, (z_0 + z_1) / 2]),
    )


def cone(radius_0: float, radius_1: float, z_0: float, z_1: float) -> Shape:
    """A truncated cone about z, radius_0 at z_0 and radius_1 at z_1, mm; one radius may be 0."""
    if radius_0 == radius_1:
        return cylinder(radius_0, z_0, z_1)
    if not (min(radius_0, radius_1) >= 0 and math.isfinite(radius_0 + radius_1)):
        raise InputError(f"cone: radii are {radius_0} and {radius_1} mm; neither may be negative")
    _positive("cone", length=z_1 - z_0)
    h = (z_1 - z_0) / 2
    p = ((radius_0 + radius_1) / 2, h, (radius_1 - radius_0) / (2 * h))
    widest = max(radius_0, radius_1)
    return Primitive(
        kind=CONE, p=p, radius=math.hypot(widest, h), half=(widest, widest, h), t=np.array([0.0, 0.0, (z_0 + z_1) / 2])
    )


def box(size_x: float, size_y: float, size_z: float) -> Shape:
    """A box of those side lengths (mm) about the origin."""
    _positive("box", size_x=size_x, size_y=size_y, size_z=size_z)
    h = (size_x / 2, size_y / 2, size_z / 2)
    return Primitive(kind=BOX, p=h, radius=math.sqrt(sum(x * x for x in h)), half=h)


def torus(ring_radius: float, tube_radius: float) -> Shape:
    """A ring about z: a circle of tube_radius whose centre runs around a circle of ring_radius, mm."""
    _positive("torus", ring_radius=ring_radius, tube_radius=tube_radius)
    if tube_radius >= ring_radius:
        raise InputError(
            f"torus: tube radius {tube_radius:g} mm is not smaller than the ring radius {ring_radius:g} mm"
        )
    reach = ring_radius + tube_radius
    return Primitive(kind=TORUS, p=(ring_radius, tube_radius), radius=reach, half=(reach, reach, tube_radius))


def half_space() -> Shape:
    """All points with z <= 0; only useful to cut others."""
    return Primitive(kind=HALF_SPACE, p=(), radius=math.inf)


def union(shapes: Sequence[Shape]) -> Shape:
    """The union of one or more shapes, joined as a balanced tree."""
    if not shapes:
        raise InputError("a union needs at least one shape")
    if len(shapes) == 1:
        return shapes[0]
    middle = len(shapes) // 2
    return union(shapes[:middle]) | union(shapes[middle:])


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A shape (mm) filled with a material (a name that the material table knows) and fixed to a frame: M, H, T or W."""

    shape: Shape
    material: str
    frame: Frame = Frame.M
    name: str = ""

    def __post_init__(self) -> None:
        if self.frame not in (Frame.M, Frame.H, Frame.T, Frame.W):
            raise InputError(f"solid {self.name!r} is fixed to frame {self.frame.name}; M, H, T or W is needed")
        if not math.isfinite(self.shape.bound()[1]):
            raise InputError(f"solid {self.name!r} reaches to infinity; cut it with a finite shape (intersection)")
