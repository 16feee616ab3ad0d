"""The multi-feature specimen (paper sec. 6.1, figs. 9 to 13): aluminium, 60 mm long, as a closed mesh.

Named in the paper are its length, cylindrical faces at both ends, six cuboids, calottes, a threaded hole, and
measurands (L1 to L6 between planes, L7 between calottes) of 4 to 12 mm.  All else is this project's own.  The
thread is a row of circular grooves.  "As made" moves each vertex along its normal by a smooth deviation of its
feature and leaves vertices on edges where they are, as the paper's reference mesh does.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.simulation.objects.mesh import TriangleMesh
from tomopose.simulation.objects.tessellate import manifold
from tomopose.units import Array

LENGTH = 60.0
FLANGE_RADIUS, FLANGE_LENGTH = 15.0, 12.0
CORE_RADIUS = 9.0
CUBOID_SIDE = 8.0
CUBOID_HEIGHTS = (4.0, 5.5, 7.0, 8.5, 10.0, 12.0)
"""Distance of each cuboid's outer plane from the core's flat beside it, mm: the nominal values of L1 to L6."""
CALOTTE_RADIUS, CALOTTE_DISTANCE = 3.0, 10.0
"""Radius of the calottes, and the distance L7 between the two of them, mm."""
BORES = ((10.0, 45.0, 2.0), (10.0, 135.0, 2.5), (10.0, 225.0, 1.5), (10.0, 315.0, 3.0), (5.5, 0.0, 1.0))
"""Bores of the upper flange: distance from the axis (mm), angle (deg), radius (mm)."""
THREAD_RADIUS, THREAD_PITCH, THREAD_DEPTH = 2.5, 0.8, 10.4
FLAT = 6.5
"""Distance of the core's six flats from the axis, mm."""
DEVIATION = 0.008
"""Standard deviation of the as-made form, mm."""
SHARP_DEG = 20.0
"""Vertices between faces that differ by more than this lie on an edge and keep their place."""


@dataclass(frozen=True, kw_only=True)
class Measurand:
    """A nominal length (mm) with the two planes' centres or calottes' centres that it joins, (3,) each."""

    name: str
    kind: str
    length: float
    a: Array
    b: Array


def measurands() -> tuple[Measurand, ...]:
    """L1 to L7 with their nominal values."""
    out = []
    for k, height in enumerate(CUBOID_HEIGHTS):
        angle = k * math.pi / 3
        e = np.array([math.cos(angle), math.sin(angle), 0.0])
        out.append(Measurand(name=f"L{k + 1}", kind="plane-plane", length=height, a=FLAT * e, b=(FLAT + height) * e))
    z = LENGTH / 2
    a, b = np.array([-CALOTTE_DISTANCE / 2, 0.0, -z]), np.array([CALOTTE_DISTANCE / 2, 0.0, -z])
    return (*out, Measurand(name="L7", kind="calotte-calotte", length=CALOTTE_DISTANCE, a=a, b=b))


@functools.lru_cache(maxsize=2)
def _nominal(edge: float, segments: int) -> TriangleMesh:
    M = manifold().Manifold

    def rod(radius: float, z_0: float, z_1: float, n: int = segments, top: float | None = None) -> Any:
        return M.cylinder(z_1 - z_0, radius, radius if top is None else top, n).translate([0.0, 0.0, z_0])

    z = LENGTH / 2
    core = rod(CORE_RADIUS, -z, z)
    for k in range(6):
        angle = k * 60.0
        # Flats along the core's middle, on which the cuboids rest.
        flat = M.cube([CORE_RADIUS, 2 * CORE_RADIUS, LENGTH - 2 * FLANGE_LENGTH], True)
        core -= flat.translate([FLAT + CORE_RADIUS / 2, 0.0, 0.0]).rotate([0.0, 0.0, angle])
    body = core + rod(FLANGE_RADIUS, -z, -z + FLANGE_LENGTH) + rod(FLANGE_RADIUS, z - FLANGE_LENGTH, z)
    for k, height in enumerate(CUBOID_HEIGHTS):
        # Cuboids alternate in height along the axis; each one's side leaves a strip of its flat to be probed.
        depth = height + 1.0
        cuboid = M.cube([depth, 0.6 * CUBOID_SIDE, CUBOID_SIDE], True)
        place = [FLAT - 1.0 + depth / 2, 0.0, 9.0 * (1 if k % 2 else -1)]
        body += cuboid.translate(place).rotate([0.0, 0.0, 60.0 * k])
    for distance, angle, radius in BORES:
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        body -= rod(radius, z - FLANGE_LENGTH - 1.0, z + 1.0, segments // 2).translate(
            [distance * c, distance * s, 0.0]
        )
    for x in (-CALOTTE_DISTANCE / 2, CALOTTE_DISTANCE / 2):
        body -= M.sphere(CALOTTE_RADIUS, segments).translate([x, 0.0, -z])
    thread = rod(THREAD_RADIUS, -z - 1.0, -z + THREAD_DEPTH, segments // 2)
    groove = 0.54 * THREAD_PITCH
    for k in range(int(THREAD_DEPTH / THREAD_PITCH) - 1):
        at = -z + 0.5 + k * THREAD_PITCH
        middle = at + THREAD_PITCH / 2
        thread += rod(THREAD_RADIUS - 0.01, at, middle, segments // 2, THREAD_RADIUS + groove)
        thread += rod(THREAD_RADIUS + groove, middle, at + THREAD_PITCH, segments // 2, THREAD_RADIUS - 0.01)
    body -= thread.translate([0.0, 8.0, 0.0])
    mesh = body.refine_to_length(edge).to_mesh64()
    return TriangleMesh(vertices=np.asarray(mesh.vert_properties)[:, :3], faces=np.asarray(mesh.tri_verts))


def specimen_mesh(*, deviations: bool = False, edge: float = 0.5, segments: int = 180, seed: int = 0) -> TriangleMesh:
    """The specimen, axis along z, origin at its middle.

    deviations: as made instead of nominal, drawn by `seed`.  edge: largest side of a triangle, mm.  segments: of a
        circle.
    """
    nominal = _nominal(edge, segments)
    return as_made(nominal, seed=seed) if deviations else nominal


def as_made(nominal: TriangleMesh, *, seed: int = 0, sigma: float = DEVIATION) -> TriangleMesh:
    """The mesh with smooth form deviations (sigma, mm) along its normals; vertices on edges stay.

    The form is a sum of 12 plane waves of 8 to 40 mm wavelength, so that neighbours move together.
    """
    v, f = nominal.vertices, nominal.faces
    a, b, c = (v[f[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    vertex_normal = np.zeros_like(v)
    for k in range(3):
        np.add.at(vertex_normal, f[:, k], normal)
    vertex_normal /= np.maximum(np.linalg.norm(vertex_normal, axis=1, keepdims=True), 1e-300)
    # A face that leans away from its vertex's mean normal marks an edge.
    agree = np.ones(len(v))
    for k in range(3):
        np.minimum.at(agree, f[:, k], np.einsum("ij,ij->i", unit, vertex_normal[f[:, k]]))
    rng = np.random.default_rng(np.random.SeedSequence([seed, 27]))
    n = 12
    direction = rng.standard_normal((n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wave = 2 * np.pi / rng.uniform(8.0, 40.0, n)
    form = (
        np.sin(v @ (direction * wave[:, None]).T + rng.uniform(0, 2 * np.pi, n)).sum(axis=1) * sigma * math.sqrt(2 / n)
    )
    form[agree < math.cos(math.radians(SHARP_DEG))] = 0.0
    return TriangleMesh(vertices=v + form[:, None] * vertex_normal, faces=f)
