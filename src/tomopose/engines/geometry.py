"""Projection matrices as the kernels need them: from voxel indices (ix, iy, iz) to pixels, and back along rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.errors import OutOfViewError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.units import Array
from tomopose.volume import VoxelGrid


@dataclass(frozen=True, kw_only=True)
class IndexGeometry:
    """The views of a scan in voxel indices.

    P:       (n, 3, 4): pixel of the voxel index (ix, iy, iz, 1); w is the depth in mm.
    source:  (n, 3): the source as a voxel index.
    M_inv:   (n, 3, 3): the ray of pixel (u, v) runs along M_inv (u, v, 1), away from the source.
    """

    P: Array
    source: Array
    M_inv: Array


def index_geometry(matrices: ProjectionMatrices, grid: VoxelGrid) -> IndexGeometry:
    """P and its rays with the grid folded in, so that kernels know neither spacing nor origin."""
    P = np.ascontiguousarray(matrices.P @ grid.index_to_W)
    M_inv = np.linalg.inv(P[:, :, :3])
    return IndexGeometry(P=P, source=-(M_inv @ P[:, :, 3:])[..., 0], M_inv=np.ascontiguousarray(M_inv))


SHORTEST_RAY = 2.0
"""Rays that cross less than this many voxels of the grid have no say: their residual would be divided by almost 0."""


def per_length(lengths: np.ndarray, grid: VoxelGrid) -> np.ndarray:
    """1/mm: 1 over the lengths of rays in the grid, 0 where a ray is too short, for SART."""
    with np.errstate(divide="ignore"):
        return np.where(lengths > SHORTEST_RAY * float(grid.spacing.min()), 1 / lengths, 0)


def require_usable(matrices: ProjectionMatrices, grid: VoxelGrid) -> None:
    """OutOfViewError where the grid reaches behind the source or the panel, or no view sees any of it."""
    corners = np.hstack([grid.corners, np.ones((8, 1))])
    h = matrices.P @ corners.T
    depth = h[:, 2]
    behind = np.flatnonzero((depth <= 0).any(axis=1))
    if behind.size:
        raise OutOfViewError(
            f"the volume reaches behind the source in {behind.size} views (first: view {behind[0]}, depth "
            f"{depth[behind[0]].min():.4g} mm); make the volume smaller or check the unit of the voxel size",
            indices=behind.tolist(),
        )
    u, v = h[:, 0] / depth, h[:, 1] / depth
    outside = (
        (u.max(axis=1) < 0)
        | (u.min(axis=1) > matrices.n_u - 1)
        | (v.max(axis=1) < 0)
        | (v.min(axis=1) > matrices.n_v - 1)
    )
    missed = np.flatnonzero(outside)
    if missed.size:
        first = missed[0]
        raise OutOfViewError(
            f"the volume lies outside the field of view in {missed.size} of {len(matrices)} views (first: view "
            f"{first}, where it would fall on u {u[first].min():.0f} to {u[first].max():.0f}, v {v[first].min():.0f} "
            f"to {v[first].max():.0f} of {matrices.n_u} x {matrices.n_v} pixels); move or enlarge the grid, or check "
            "the matrices",
            indices=missed.tolist(),
        )


def truncated_views(matrices: ProjectionMatrices, grid: VoxelGrid) -> np.ndarray:
    """Indices of views in which part of the grid's box falls beside the detector."""
    h = matrices.P @ np.hstack([grid.corners, np.ones((8, 1))]).T
    u, v = h[:, 0] / h[:, 2], h[:, 1] / h[:, 2]
    beside = (u < 0) | (u > matrices.n_u - 1) | (v < 0) | (v > matrices.n_v - 1)
    return np.flatnonzero(beside.any(axis=1))
