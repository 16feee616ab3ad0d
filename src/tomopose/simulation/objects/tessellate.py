"""Shapes as closed triangle meshes, by manifold3d: for engines that know nothing but triangles."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.errors import EngineMissingError
from tomopose.geometry.frames import Frame
from tomopose.simulation.objects.mesh import INSTALL, TriangleMesh
from tomopose.simulation.objects.shapes import (
    BOX,
    CONE,
    CYLINDER,
    DIFFERENCE,
    HALF_SPACE,
    INTERSECTION,
    SPHERE,
    Joined,
    Primitive,
    Shape,
    Solid,
)

HUGE = 1.0e4
"""Side of the box that denotes a half-space, mm."""


def manifold() -> Any:
    """The package manifold3d; EngineMissingError where it is not installed."""
    try:
        import manifold3d
    except ImportError as error:
        raise EngineMissingError("this needs manifold3d, which is not installed", install_line=INSTALL) from error
    return manifold3d


def _primitive(q: Primitive, segments: int) -> Any:
    M = manifold()
    a, b, c = (*q.p, 0.0, 0.0, 0.0)[:3]
    if q.kind == SPHERE:
        # Corners of the inscribed polyhedron lie on the sphere; a little outside, the mean radius is the sphere's.
        made = M.Manifold.sphere(a * (1 + 0.6 * (np.pi / segments) ** 2), segments)
    elif q.kind in (CYLINDER, CONE):
        n = segments
        grow = np.sqrt(2 * np.pi / n / np.sin(2 * np.pi / n))
        low, high = (a, a) if q.kind == CYLINDER else (a - c * b, a + c * b)
        made = M.Manifold.cylinder(2 * b, max(low, 0) * grow, max(high, 0) * grow, n, True)
    elif q.kind == BOX:
        made = M.Manifold.cube([2 * a, 2 * b, 2 * c], True)
    elif q.kind == HALF_SPACE:
        made = M.Manifold.cube([HUGE, HUGE, HUGE], True).translate([0.0, 0.0, -HUGE / 2])
    else:
        circle = M.CrossSection.circle(b, segments).translate([a, 0.0])
        made = M.Manifold.revolve(circle, segments)
    return made.transform(np.column_stack([q.R, q.t]))


def to_manifold(shape: Shape, segments: int) -> Any:
    """The shape as a manifold3d body; circles have `segments` sides of the circle's own area."""
    if isinstance(shape, Primitive):
        return _primitive(shape, segments)
    assert isinstance(shape, Joined)
    a, b = to_manifold(shape.a, segments), to_manifold(shape.b, segments)
    if shape.op == DIFFERENCE:
        return a - b
    return a ^ b if shape.op == INTERSECTION else a + b


def tessellate(solids: tuple[Solid, ...], *, segments: int = 256) -> list[tuple[TriangleMesh, str, Frame]]:
    """(mesh, material, frame) of each solid, less what later solids of its frame displace."""
    bodies = [to_manifold(s.shape, segments) for s in solids]
    out = []
    for k, solid in enumerate(solids):
        body = bodies[k]
        for later, other in zip(bodies[k + 1 :], solids[k + 1 :], strict=True):
            if other.frame is solid.frame:
                body = body - later
        mesh = body.to_mesh64()
        if len(mesh.tri_verts):
            out.append(
                (
                    TriangleMesh(vertices=np.asarray(mesh.vert_properties)[:, :3], faces=np.asarray(mesh.tri_verts)),
                    solid.material,
                    solid.frame,
                )
            )
    return out
