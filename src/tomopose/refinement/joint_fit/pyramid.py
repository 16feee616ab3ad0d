"""Levels of images and grid, coarse to fine, each as smooth as its voxels can hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.ndimage

from tomopose.geometry.object_pose import point_jacobian
from tomopose.refinement.joint_fit.measured import Measured
from tomopose.units import Array, Floats
from tomopose.volume import VoxelGrid

SHARPEST = 0.6
"""Standard deviation, in voxels, of the finest edge that a grid is asked to hold.  Joseph's sums of sharper ones depend
on the angle to the grid, four times a turn, and the poses take that up where the object is nearly symmetric: a step
cylinder's turn about its axis."""
PIXEL_VARIANCE = 1 / 12
"""Variance of a pixel's own width, px^2: it smooths already."""


def level_of(data: Measured, factor: int) -> Measured:
    """The images and the grid of a level, as smooth as its voxels can hold."""
    return smoothed(binned(data, factor))


def smoothed(data: Measured) -> Measured:
    """Images smoothed to `SHARPEST`.  Held-out pixels that the smoothing mixes with others judge no longer."""
    m, grid = data.matrices, data.grid
    voxel_px = px_per_mm(data) * float(np.max(grid.spacing))
    blur = np.sqrt(np.maximum((SHARPEST * voxel_px) ** 2 - PIXEL_VARIANCE, 0.0))
    if not np.any(blur > 0.1):
        return data
    data = replace(data, blur=(float(blur[0]), float(blur[1])))
    judge = data.judge.reshape(-1, m.n_u, m.n_v)
    inside = scipy.ndimage.minimum_filter(judge > 0, size=(1, 3, 3), mode="nearest")
    return replace(data, p=data.smooth(data.p), judge=np.where(inside, judge, 0).reshape(data.judge.shape))


def px_per_mm(data: Measured) -> Array:
    """(2,) pixels along u and v for a millimetre across the beam, at the middle of the grid."""
    G = point_jacobian(data.matrices.P, np.asarray(data.grid.centre)[None])[:, 0]
    return np.asarray(np.median(np.linalg.norm(G, axis=2), axis=0))


def binned(data: Measured, factor: int) -> Measured:
    """Images averaged over factor x factor pixels, and a grid of voxels as much larger over the same box."""
    if factor == 1:
        return data
    m, n = data.matrices, len(data.p)
    small, shape = m.binned(factor), (n, m.n_u // factor, factor, m.n_v // factor, factor)

    def blocks(flat: Floats) -> Floats:
        images = flat.reshape(n, m.n_u, m.n_v)[:, : shape[1] * factor, : shape[3] * factor]
        return np.asarray(images.reshape(shape))

    weight, judge, p = blocks(data.weight), blocks(data.judge), blocks(data.p)
    total = weight + judge
    mass = total.sum(axis=(2, 4))
    mean = (total * p).sum(axis=(2, 4)) / np.where(mass > 0, mass, 1)
    # a coarse pixel that holds a held-out one judges; the sum of weights is that of a mean
    apart = (judge > 0).any(axis=(2, 4))
    cells = tuple(-(-k // factor) for k in data.grid.shape)
    grid = VoxelGrid(shape=cells, spacing=data.grid.spacing * factor, centre=data.grid.centre)  # type: ignore[arg-type]
    return Measured(
        p=mean.astype(np.float32).reshape(n, -1),
        weight=np.where(apart, 0, mass).astype(np.float32).reshape(n, -1),
        judge=np.where(apart, mass, 0).astype(np.float32).reshape(n, -1),
        matrices=small,
        grid=grid,
    )


def finer(values: np.ndarray, coarse: VoxelGrid, fine: VoxelGrid) -> np.ndarray:
    """A volume [z, y, x] of a coarse grid on a finer one about the same middle, by trilinear interpolation."""
    at = np.meshgrid(
        *(
            ((np.arange(n) - (n - 1) / 2) * small / large + (m - 1) / 2)
            for n, m, small, large in zip(
                fine.shape, coarse.shape, fine.spacing[::-1], coarse.spacing[::-1], strict=True
            )
        ),
        indexing="ij",
    )
    return np.asarray(scipy.ndimage.map_coordinates(values, at, order=1, mode="nearest"), dtype=np.float32)
