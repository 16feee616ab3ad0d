r"""What SART makes of a set of views, step by step: the volume of the part, and its noise through transposed steps.

Where `sart_response` puts filters in the place of SART, this takes its steps themselves (Andersen and Kak 1984),

    x <- x + w B_j (p_j - A_j x) / L_j

on the grid of the box: A_j Joseph's projector, B_j the bilinear look-up, L_j = A_j 1.  Grey levels are linear in the
line integrals, so that a sum c . x of them is g . p, with g from the same steps backwards,

    g_j <- g_j + w B_j^T y / L_j,      y <- y - w A_j^T B_j^T y / L_j,      y = c at first,

and its variance is sum g^2 (1 / (N_0 tau) + (r / (N_0 tau))^2).  Nothing is approximated but the panel, taken
in blocks; each sum takes about as long as a reconstruction.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from tomopose.engines.cpu import CpuEngine, processors
from tomopose.engines.geometry import per_length
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.scanner import Scanner
from tomopose.kernel_cache import njit
from tomopose.measurement.surface.splines import spline_coefficients, spline_value
from tomopose.planning.part.part import Part
from tomopose.planning.part.sart_response import RELAXATION, Blocks, blocks
from tomopose.planning.part.settings import PartSettings
from tomopose.trajectory.view_order import view_order
from tomopose.units import Array
from tomopose.volume import VoxelGrid


@dataclass(frozen=True, kw_only=True, eq=False)
class SartSteps:
    """Views of a part with their variance of line integrals (n, n_v, n_u), in blocks of the panel; the grid, and the
    splines' coefficients [z, y, x], 1/mm, of the volume that they make of the part."""

    matrices: ProjectionMatrices
    variance: Array
    box: VoxelGrid
    coefficients: np.ndarray
    sweeps: int

    @property
    def voxel(self) -> float:
        """mm."""
        return float(self.box.spacing[0])

    def at(self, x: Array) -> Array:
        """(m,) grey levels, 1/mm, at points x (m, 3), mm, of the part at home, as a measurement looks them up."""
        out = np.empty(len(x))
        _values(self.coefficients, self._index(x), out)
        return out

    def _index(self, x: Array) -> Array:
        """(m, 3) places in the grid, at least two voxels inside."""
        return np.asarray(np.clip(self.box.indices(x), 1.0, np.array(self.box.shape) - 2.001))

    def covariance(self, x: Array, weights: csr_array) -> Array:
        """(f, f) of the sums weights (f, m) of grey levels at x (m, 3), from the noise of the views."""
        index, per_mm = self._index(x), relaxed_per_length(CpuEngine(self.matrices, self.box))

        def on_pixels(f: int) -> Array:
            row, c = weights[[f]], np.zeros(self.box.shape)
            _on_voxels(row.indices, row.data, index, c)
            # the splines' filter is its own transpose but for its mirrored ends
            return weights_on_pixels(self.matrices, self.box, spline_coefficients(c), self.sweeps, per_mm).ravel()

        with ThreadPoolExecutor(processors()) as pool:
            g = np.stack(list(pool.map(on_pixels, range(weights.shape[0]))))
        g *= np.sqrt(self.variance).ravel()
        covariance: Array = g @ g.T
        return covariance


def sart_steps(part: Part, scanner: Scanner, P: Array, settings: PartSettings) -> SartSteps:
    """Of views with matrices P (n, 3, 4), part at home -> pixels."""
    found, matrices, box = planned_scan(part, scanner, P, settings)
    engine = CpuEngine(matrices, box)
    values = sart(engine, relaxed_per_length(engine), -np.log(found.tau), settings.sweeps)
    return SartSteps(
        matrices=matrices,
        variance=found.variance,
        box=box,
        coefficients=spline_coefficients(values),
        sweeps=settings.sweeps,
    )


def planned_scan(
    part: Part, scanner: Scanner, P: Array, settings: PartSettings
) -> tuple[Blocks, ProjectionMatrices, VoxelGrid]:
    """(expected images, their matrices, the reconstructed box) of views with matrices P (n, 3, 4), part at home ->
    pixels; voxels of a block's size at the part."""
    half = np.ptp(part.mesh.points, axis=0) / 2 + settings.room
    found = blocks(part, scanner, P, settings, corners=part.centre + half * BOX_CORNERS)
    n_v, n_u = found.tau.shape[1:]
    names = tuple(str(j) for j in range(len(P)))
    matrices = ProjectionMatrices(
        P=found.P, n_u=n_u, n_v=n_v, p_u=scanner.p_u * found.size, p_v=scanner.p_v * found.size, pose_id=names
    )
    n = np.maximum(np.ceil(2 * half / found.voxel), 4).astype(int)
    return found, matrices, VoxelGrid((int(n[2]), int(n[1]), int(n[0])), found.voxel, part.centre)


def relaxed_per_length(engine: CpuEngine) -> Array:
    """(n, n_v, n_u) w / L; 0 where the ray has too little of the grid."""
    L = engine.lengths(range(len(engine.matrices))).astype(np.float64)
    return np.asarray(RELAXATION * per_length(L, engine.grid))


def sart(engine: CpuEngine, per_mm: Array, p: Array, sweeps: int) -> np.ndarray:
    """[z, y, x] 1/mm, that SART makes of line integrals p (n, n_v, n_u); per_mm: as of `relaxed_per_length`."""
    state = engine.empty()
    for _ in range(sweeps):
        for j in (int(j) for j in view_order(len(p))):
            residual = (p[j] - engine.forward(state, [j])[0]) * per_mm[j]
            engine.back(residual[None].astype(np.float32), [j], into=state, weight="mean")
    return engine.values(state)


def weights_on_pixels(matrices: ProjectionMatrices, box: VoxelGrid, c: np.ndarray, sweeps: int, per_mm: Array) -> Array:
    """(n, n_v, n_u): of the sum c [z, y, x] of the voxels that SART makes, on the line integrals; per_mm: as of
    `relaxed_per_length`."""
    engine, n = CpuEngine(matrices, box, threads=1), len(matrices.P)
    y = np.ascontiguousarray(c.T, dtype=np.float64)
    g = np.zeros((n, matrices.n_v, matrices.n_u))
    for _ in range(sweeps):
        for j in (int(j) for j in view_order(n)[::-1]):
            image = np.zeros(g.shape[1:])
            _transposed_look_up(matrices.P[j], box.origin, box.spacing, y, image)
            image *= per_mm[j]
            g[j] += image
            y -= engine.values(engine.transpose(image[None].astype(np.float32), [j])).T
    return g


@njit(cache=True, nogil=True)
def _values(c: np.ndarray, index: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(index)):
        out[i] = spline_value(c, index[i, 0], index[i, 1], index[i, 2])


@njit(cache=True, nogil=True)
def _basis(t: float) -> tuple[float, float, float, float]:
    """Cubic B-spline weights of the voxels -1, 0, 1, 2 at the fraction t."""
    s = 1 - t
    return s**3 / 6, (4 - 6 * t * t + 3 * t**3) / 6, (4 - 6 * s * s + 3 * s**3) / 6, t**3 / 6


@njit(cache=True, nogil=True)
def _on_voxels(column: np.ndarray, weight: np.ndarray, index: np.ndarray, c: np.ndarray) -> None:
    """Add to c [z, y, x] the transpose of the splines' values at index[column], times weights."""
    for h in range(len(column)):
        z, y, x = index[column[h]]
        a, b, d = math.floor(z), math.floor(y), math.floor(x)
        w_z, w_y, w_x = _basis(z - a), _basis(y - b), _basis(x - d)
        for i in range(4):
            for j in range(4):
                for k in range(4):
                    c[a - 1 + i, b - 1 + j, d - 1 + k] += weight[h] * w_z[i] * w_y[j] * w_x[k]


@njit(cache=True, nogil=True)
def _look_up(P: np.ndarray, x: np.ndarray, shape: tuple[int, int]) -> tuple[int, int, float, float]:
    """(row, column, fractions beyond) of the look-up of a point; row -1 where the view does not see it.

    The rim is replicated by one pixel, as the engine does.
    """
    n_v, n_u = shape
    w = P[2, 0] * x[0] + P[2, 1] * x[1] + P[2, 2] * x[2] + P[2, 3]
    u = (P[0, 0] * x[0] + P[0, 1] * x[1] + P[0, 2] * x[2] + P[0, 3]) / w
    v = (P[1, 0] * x[0] + P[1, 1] * x[1] + P[1, 2] * x[2] + P[1, 3]) / w
    if u <= -1 or v <= -1 or u >= n_u or v >= n_v:
        return -1, -1, 0.0, 0.0
    u, v = min(max(u, 0.0), n_u - 1.0), min(max(v, 0.0), n_v - 1.0)
    row, column = min(int(v), n_v - 2), min(int(u), n_u - 2)
    return row, column, v - row, u - column


@njit(cache=True, nogil=True)
def _transposed_look_up(
    P: np.ndarray, origin: np.ndarray, spacing: np.ndarray, y: np.ndarray, image: np.ndarray
) -> None:
    """Add to image (n_v, n_u) the transpose of looking it up at the voxels of y [x, y, z]."""
    x = np.empty(3)
    for i in range(y.shape[0]):
        for j in range(y.shape[1]):
            for k in range(y.shape[2]):
                if y[i, j, k] == 0.0:
                    continue
                x[0], x[1], x[2] = origin[0] + spacing[0] * i, origin[1] + spacing[1] * j, origin[2] + spacing[2] * k
                row, column, t, s = _look_up(P, x, image.shape)
                if row < 0:
                    continue
                image[row, column] += y[i, j, k] * (1 - t) * (1 - s)
                image[row, column + 1] += y[i, j, k] * (1 - t) * s
                image[row + 1, column] += y[i, j, k] * t * (1 - s)
                image[row + 1, column + 1] += y[i, j, k] * t * s
