"""Exact scans of balls: line integrals of spheres in closed form, paths of the paper, and measures of a volume's truth.

Shared by the tests and by benchmarks/reconstruction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import R_y, R_z
from tomopose.geometry.scanner import Scanner
from tomopose.volume import VoxelGrid


@dataclass(frozen=True, kw_only=True)
class Balls:
    """centres (m, 3) mm in W, radii (m,) mm, attenuation (m,) 1/mm."""

    centres: np.ndarray
    radii: np.ndarray
    mu: np.ndarray


def balls(grid: VoxelGrid, m: int = 11, radius: tuple[float, float] = (0.04, 0.07), seed: int = 1) -> Balls:
    """m balls apart from one another inside the grid's inscribed sphere; radii as shares of the grid's edge."""
    rng = np.random.default_rng(seed)
    edge = float(grid.spacing[0] * grid.n_xyz[0])
    centres: list[np.ndarray] = []
    radii: list[float] = []
    while len(centres) < m:
        c, r = rng.uniform(-0.42, 0.42, 3) * edge, rng.uniform(*radius) * edge
        near = np.hypot(c[0], c[1]) + r < 0.42 * edge and abs(c[2]) + r < 0.38 * edge
        if near and all(np.linalg.norm(c - d) > r + s + 0.03 * edge for d, s in zip(centres, radii, strict=True)):
            centres.append(c + grid.centre)
            radii.append(r)
    return Balls(centres=np.array(centres), radii=np.array(radii), mu=np.full(m, 1.0 / edge * 4))


def tilt_eq11(alpha: np.ndarray) -> np.ndarray:
    """Tilt, rad, of the paper's eq. (11): a triangle wave of 8 degrees and seven periods."""
    return 28 / 45 * np.abs((alpha + np.pi / 14) % (2 * np.pi / 7) - np.pi / 7) - 2 * np.pi / 45


def scan(
    grid: VoxelGrid,
    *,
    n: int,
    n_u: int,
    n_v: int | None = None,
    tilted: bool = True,
    arc: float = 2 * np.pi,
    aspect: float = 1.0,
    shift: tuple[float, float] = (0.3, -0.2),
    field: float | None = None,
) -> ProjectionMatrices:
    """Matrices of a setup like the paper's, at magnification 5.

    At the rotation axis a pixel is as wide as a voxel, as in the paper (0.4 mm / 5.3 = 75.5 um), unless `field` says
    that the detector is that many times the grid's edge wide.
    """
    edge = float(grid.spacing[0] * grid.n_xyz[0])
    p_u = float(grid.spacing[0]) * 5.0 if field is None else edge * 5.0 * field / n_u
    n_v = n_u if n_v is None else n_v
    scanner = Scanner(
        d_SD=1500.0,
        d_SR=300.0,
        p_u=p_u,
        p_v=p_u * aspect,
        u_0=(n_u - 1) / 2 + shift[0],
        v_0=(n_v - 1) / 2 + shift[1],
        n_u=n_u,
        n_v=n_v,
    )
    alpha = np.arange(n) * arc / n
    turn = R_z(alpha)
    if tilted:
        turn = R_y(tilt_eq11(alpha)) @ turn
    moved = np.zeros((n, 4, 4))
    moved[:, :3, :3], moved[:, 3, 3] = turn, 1.0
    P = scanner.P_S @ (scanner.T_WS.matrix @ moved)
    return ProjectionMatrices(
        P=P,
        n_u=n_u,
        n_v=n_v,
        p_u=scanner.p_u,
        p_v=scanner.p_v,
        pose_id=tuple(str(i) for i in range(n)),
        scanner=scanner,
    )


def line_integrals(matrices: ProjectionMatrices, objects: Balls, j: int, *, fine: int = 3) -> np.ndarray:
    """Image (n_v, n_u) of view j: chords of the balls times attenuation, averaged over fine x fine rays a pixel."""
    n_u, n_v = matrices.n_u, matrices.n_v
    P = matrices.P[j]
    M_inv = np.linalg.inv(P[:, :3])
    source = -M_inv @ P[:, 3]
    image = np.zeros((n_v, n_u))
    inner = (np.arange(fine) - (fine - 1) / 2) / fine
    for c, r, mu in zip(objects.centres, objects.radii, objects.mu, strict=True):
        h = P @ [*c, 1.0]
        u, v = h[:2] / h[2]
        reach = 1.2 * r / h[2] / np.linalg.norm(M_inv[:, :2], axis=0) + 2
        u_0, u_1 = max(0, int(u - reach[0])), min(n_u, int(u + reach[0]) + 2)
        v_0, v_1 = max(0, int(v - reach[1])), min(n_v, int(v + reach[1]) + 2)
        if u_0 >= u_1 or v_0 >= v_1:
            continue
        uu = (np.arange(u_0, u_1)[:, None] + inner).ravel()
        vv = (np.arange(v_0, v_1)[:, None] + inner).ravel()
        d = uu[None, :, None] * M_inv[:, 0] + vv[:, None, None] * M_inv[:, 1] + M_inv[:, 2]
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        off = c - source
        along = d @ off
        square = r**2 - (off @ off - along**2)
        chord = 2 * np.sqrt(np.maximum(square, 0))
        mean = chord.reshape(v_1 - v_0, fine, u_1 - u_0, fine).mean(axis=(1, 3))
        image[v_0:v_1, u_0:u_1] += mu * mean
    return image


def images_of(matrices: ProjectionMatrices, objects: Balls, *, fine: int = 3) -> np.ndarray:
    """(n, n_v, n_u) float32."""
    return np.stack([line_integrals(matrices, objects, j, fine=fine) for j in range(len(matrices))]).astype(np.float32)


def directions(n: int) -> np.ndarray:
    """n directions spread over the sphere (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    phi = np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], axis=1)


def trilinear(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The volume at fractional array indices (..., 3)."""
    import scipy.ndimage

    return scipy.ndimage.map_coordinates(values, np.moveaxis(at, -1, 0), order=1, mode="nearest")


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Of each ball: distance of fitted from true centre, and fitted minus true radius, in voxels; centroid_error: the
    same distance for the centre of mass; inner: value over true value in the middle; background: rms, over the true
    value, away from the balls.

    The two centres have different floors: on balls that are averaged exactly over each voxel (R = 10 to 18 voxels) the
    fit reads 0.0033 voxel on average, the centre of mass 0.0003.
    """

    centre_error: np.ndarray
    centroid_error: np.ndarray
    radius_error: np.ndarray
    inner: np.ndarray
    background: float


def centre_of_mass(values: np.ndarray, grid: VoxelGrid, c: np.ndarray, r: float) -> np.ndarray:
    """Centre of mass, mm from c, of what lies within 2.5 voxels of a ball's true surface or inside; the rim is soft."""
    voxel = float(grid.spacing[0])
    low = np.maximum(np.floor(grid.indices(c) - r / voxel - 4), 0).astype(int)
    high = np.minimum(low + int(2 * r / voxel) + 10, grid.shape)
    index = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1)
    off = grid.points(index) - c
    weight = np.clip((r + 3 * voxel - np.linalg.norm(off, axis=-1)) / voxel, 0, 1)
    weight *= values[tuple(np.s_[a:b] for a, b in zip(low, high, strict=True))]
    return (weight[..., None] * off).sum(axis=(0, 1, 2)) / weight.sum()


def compare(values: np.ndarray, grid: VoxelGrid, objects: Balls, *, rays: int = 3000) -> Truth:
    """Fit spheres to each ball's own 50 % surface, found along `rays` rays from its true centre.

    The level lies midway between the mean value one voxel thick 3 to 4 voxels inside and outside the true surface.
    """
    voxel = float(grid.spacing[0])
    n = directions(rays)
    centre_error, centroid_error, radius_error, inner = [], [], [], []
    for c, r, mu in zip(objects.centres, objects.radii, objects.mu, strict=True):
        t = np.arange(max(r - 4 * voxel, 0), r + 4 * voxel, voxel / 8)
        profile = trilinear(values, grid.indices(c + t[None, :, None] * n[:, None, :]))
        level = 0.5 * (profile[:, :8].mean() + profile[:, -8:].mean())
        below = profile < level
        first = np.maximum(below.argmax(axis=1), 1)
        row = np.arange(rays)
        high, low = profile[row, first - 1], profile[row, first]
        edge = t[first - 1] + (high - level) / (high - low) * voxel / 8
        points = edge[:, None] * n
        # |x - c|^2 = r^2 as a linear system for the offset and r
        A = np.hstack([2 * points, np.ones((rays, 1))])
        solution, *_ = np.linalg.lstsq(A, (points**2).sum(axis=1), rcond=None)
        offset = solution[:3]
        for _ in range(3):  # Gauss-Newton on distances
            d = points - offset
            length = np.linalg.norm(d, axis=1)
            J = np.hstack([-d / length[:, None], -np.ones((rays, 1))])
            radius = length.mean()
            step, *_ = np.linalg.lstsq(J, -(length - radius), rcond=None)
            offset = offset + step[:3]
        centroid_error.append(np.linalg.norm(centre_of_mass(values, grid, c, r)) / voxel)
        centre_error.append(np.linalg.norm(offset) / voxel)
        radius_error.append((np.linalg.norm(points - offset, axis=1).mean() - r) / voxel)
        core = trilinear(values, grid.indices(c + 0.5 * r * n))
        inner.append(core.mean() / mu)
    z, y, x = (np.arange(k) for k in grid.shape)
    points = grid.points(np.stack(np.meshgrid(z[::2], y[::2], x[::2], indexing="ij"), axis=-1))
    away = np.hypot(points[..., 0] - grid.centre[0], points[..., 1] - grid.centre[1]) < 0.45 * voxel * grid.shape[2]
    for c, r in zip(objects.centres, objects.radii, strict=True):
        away &= np.linalg.norm(points - c, axis=-1) > r + 3 * voxel
    background = float(np.sqrt((values[::2, ::2, ::2][away] ** 2).mean()) / objects.mu[0])
    return Truth(
        centre_error=np.array(centre_error),
        centroid_error=np.array(centroid_error),
        radius_error=np.array(radius_error),
        inner=np.array(inner),
        background=background,
    )
