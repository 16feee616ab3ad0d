"""The samples of the CTSimU 2D tests, built from what the toolbox's documentation and evaluation say of them.

The STL files themselves are not in the toolbox. Lengths in mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose import Scanner
from tomopose.exports.ctsimu_scenario import from_ctsimu, sample_pose
from tomopose.exports.panel import Given
from tomopose.geometry.frames import Frame
from tomopose.simulation.objects.mesh import TriangleMesh
from tomopose.simulation.objects.shapes import Shape, Solid, box, cylinder, half_space, sphere, union
from tomopose.simulation.objects.tessellate import tessellate
from tomopose.simulation.scene.ctsimu import STAGE_TO_M

WIRES = (0.8, 0.63, 0.5, 0.4, 0.32, 0.25, 0.2, 0.16, 0.13, 0.1, 0.08, 0.063, 0.05)
"""Diameters of the duplex wires and their gaps, as the toolbox evaluates them (ISO 19232-5)."""
ALUMINIUM = (41.0, 35.89, 30.79, 25.68, 20.58, 15.47, 10.36, 5.26, 0.15)
"""Steps 1 to 9 of the spherical wedge, as documented."""
IRON = tuple(10.0 - 1.2475 * k for k in range(9))
"""Steps of the iron wedge, which are not documented: equal steps from 10 to 0.02 mm give the toolbox's Monte Carlo
reference at 100 keV (10.00, 8.75, 7.50, 6.26, 5.01, 3.76, 2.51, 1.27, 0.02 mm by the law of attenuation)."""
STEP = 1000 / 11
"""Height of a step in the image, px."""
HOLES = ((-160, -140), *((y, z) for z in (205, 0, -205) for y in (205, 0, -205)))
"""Centres (y, z) of the holes' shadows on the panel before scanner and foil are turned, mm; the first hole is large."""
HOLE_RADII = (20.0, 10.0)
"""Radii of the shadows of the large and of a small hole, mm."""
EDGE_ANGLE = math.radians(3)
LEFT, RIGHT = 440.0, 575.0
"""Sides of the wedges in the image, px: the tests look at x = 450 to 565, and a narrow wedge is imaged faster."""


def meshed(shape: Shape, segments: int = 256) -> TriangleMesh:
    return tessellate((Solid(shape=shape, material="W"),), segments=segments)[0][0]


def hole_foil(content: Mapping[str, Any]) -> TriangleMesh:
    """2D-HS-1: a foil of 10 um, 10 mm in front of the source and parallel to the turned panel, in the file's own axes.

    The scenario turns the sample by deviations; the file's content is turned back by them, so that only a reader
    that applies them puts the foil where the test expects it.
    """
    g = from_ctsimu(content, Given()).decompose()
    depth, distance = 10.005, float(g.d_SD[0])
    holes = [
        cylinder(0.5 if k == 0 else 0.25, -1.0, 1.0).placed(t=[-y * depth / distance, z * depth / distance, 0.0])
        for k, (y, z) in enumerate(HOLES)
    ]
    foil = meshed(box(13.0, 13.0, 0.01) - union(holes))
    U, V = g.U[0] / np.linalg.norm(g.U[0]), g.V[0] / np.linalg.norm(g.V[0])
    _, axes = sample_pose(content["samples"][0]["position"], "sample")
    placed = np.column_stack([U, V, np.cross(U, V)])
    return foil.placed(R=(STAGE_TO_M @ axes).T @ placed)


def drawn_holes(scanner: Scanner) -> np.ndarray:
    """2D-HS-1 without a simulator: share of each pixel (rows from the top, columns) inside circles at `HOLES`.

    Lengths count from the panel's centre, x to the right (-y of the world), y down (-z).
    """
    x = (np.arange(scanner.n_u) + 0.5 - scanner.n_u / 2) * scanner.p_u
    y = (np.arange(scanner.n_v) + 0.5 - scanner.n_v / 2) * scanner.p_v
    share = np.zeros(scanner.shape)
    for k, (y_W, z_W) in enumerate(HOLES):
        distance = np.hypot(x[None] + y_W, y[:, None] + z_W)
        share += np.clip(0.5 + (HOLE_RADII[min(k, 1)] - distance) / scanner.p_u, 0.0, 1.0)
    return share


def duplex_wires() -> TriangleMesh:
    """2D-DW-1: 13 pairs of wires, thickest first along the toolbox's line profile, in the stage's axes.

    The profile runs through the image point (1126, 496) of 2000 x 1000 pixels of 0.05 mm, turned by 3 degrees.
    """
    across = np.array([0.0, -math.cos(EDGE_ANGLE), -math.sin(EDGE_ANGLE)])
    along = np.array([0.0, math.sin(EDGE_ANGLE), -math.cos(EDGE_ANGLE)])
    middle = np.array([0.0, -(1126 - 1000) * 0.05, -(496 - 500) * 0.05]) * 0.9986
    gap = (46.0 - 3 * sum(WIRES)) / (len(WIRES) - 1)
    at, wires = -23.0, []
    for d in WIRES:
        for offset in (0.5 * d, 2.5 * d):
            centre = middle + (at + offset) * across
            wires.append(cylinder(d / 2, -7.5, 7.5).along(along, t=centre))
        at += 3 * d + gap
    return meshed(union(wires), segments=64)


def half_plane_edge(angle: float = EDGE_ANGLE, turned_top: float | None = None) -> TriangleMesh:
    """2D-WE-1 and 2D-WE-2: a plate of 10 um with its upper right corner at the origin, in the stage's axes.

    Its right edge leans by `angle` from the vertical, its top edge by `turned_top` from the horizontal; with 3 degrees
    for both its box has the centre (2.5, -2.36898) that the scenarios give.
    """
    t, top = math.tan(angle), math.tan(angle if turned_top is None else turned_top)
    corners = [(0.0, 0.0), (5 * t, -5.0), (5.0, -5.0), (5.0, 5 * top)]
    return prism(np.array(corners), 0.01)


def prism(corners: np.ndarray, thickness: float) -> TriangleMesh:
    """A convex polygon (n, 2) in the plane of v and w, `thickness` thick along u about 0."""
    n = len(corners)
    faces = [(0, k, k + 1) for k in range(1, n - 1)]
    front = np.column_stack([np.full(n, thickness / 2), corners])
    back = np.column_stack([np.full(n, -thickness / 2), corners])
    sides = [f for k in range(n) for f in ((k, n + k, (k + 1) % n), ((k + 1) % n, n + k, n + (k + 1) % n))]
    tri = np.array([*faces, *[(n + a, n + c, n + b) for a, b, c in faces], *sides])
    mesh = TriangleMesh(vertices=np.vstack([front, back]), faces=tri)
    if mesh.volume < 0:
        mesh = TriangleMesh(vertices=mesh.vertices, faces=tri[:, ::-1])
    return mesh.require_closed()


class StepWedge:
    """2D-SW-1, 2 and 3: shells about the source, cut along planes through it, so that every ray of a step meets the
    same thickness. Image points are (x, y) from the upper left corner, px."""

    def __init__(self, scanner: Scanner, radius: float = 600.0) -> None:
        self.scanner, self.radius = scanner, radius
        self.source = np.array([scanner.d_SR, 0.0, 0.0])

    def ray(self, x: float, y: float) -> np.ndarray:
        s = self.scanner
        u, v = x - 0.5, s.n_v - 0.5 - y
        return np.array([-s.d_SD, (u - s.u_0) * s.p_u, (v - s.v_0) * s.p_v])

    def side(self, a: tuple[float, float], b: tuple[float, float], inside: tuple[float, float]) -> Shape:
        """All points on the inner side of the plane through the source and the image points a and b."""
        normal = np.cross(self.ray(*a), self.ray(*b))
        normal *= -np.sign(normal @ self.ray(*inside))
        return half_space().along(normal, t=self.source)

    def step(
        self,
        k: int,
        left: float | tuple[float, float],
        right: float | tuple[float, float],
        steps: tuple[float, ...] = ALUMINIUM,
    ) -> Shape:
        """Step k (from 1) between x = left and right; a pair gives x at the step's upper and lower end."""
        y_0, y_1 = (10 - k) * STEP, (11 - k) * STEP
        edges = [(x, x) if isinstance(x, (int, float)) else x for x in (left, right)]
        middle = (sum(edges[0]) + sum(edges[1])) / 4, (y_0 + y_1) / 2
        # A box about the step keeps its outline in front of the source.
        thickness = steps[k - 1]
        centre = self.ray(*middle)
        centre *= (self.radius + thickness / 2) / np.linalg.norm(centre)
        shape = box(thickness + 400.0, 700.0, 120.0).placed(t=self.source + centre)
        for x_0, x_1 in edges:
            shape = shape & self.side((x_0, y_0), (x_1, y_1), middle)
        for y in (y_0, y_1):
            shape = shape & self.side((0.0, y), (1000.0, y), middle)
        outer, inner = (sphere(r).placed(t=self.source) for r in (self.radius + thickness, self.radius))
        return shape & (outer - inner)

    def whole(self, material: str) -> tuple[Solid, ...]:
        steps = {"Al": ALUMINIUM, "Fe": IRON}[material]
        return tuple(
            Solid(shape=self.step(k, LEFT, RIGHT, steps), material=material, frame=Frame.W) for k in range(1, 10)
        )

    def halves(self, left: str, right: str) -> tuple[Solid, ...]:
        """2D-SW-3: a left piece with a straight edge at x = 500; a right piece that leaves a gap above, touches in the
        middle and displaces the left piece below."""
        first = [Solid(shape=self.step(k, LEFT, 500.0), material=left, frame=Frame.W) for k in range(1, 10)]

        def bevel(y: float) -> float:
            if y < 4 * STEP:
                return 500.0 + 5.0 * (4 * STEP - y) / (3 * STEP)
            return 500.0 - 10.0 * max(y - 7 * STEP, 0.0) / (3 * STEP)

        second = [
            Solid(
                shape=self.step(k, (bevel((10 - k) * STEP), bevel((11 - k) * STEP)), RIGHT),
                material=right,
                frame=Frame.W,
            )
            for k in range(1, 10)
        ]
        return (*first, *second)
