"""Volumes in closed form: shapes blurred by a Gaussian, exact at every voxel centre."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from tomopose.volume import Volume, VoxelGrid


def blurred_ball(distance, radius, sigma):
    """A ball of grey 1 convolved with a 3-D Gaussian, at `distance` from its centre: the radial integral is closed."""
    r = np.maximum(distance, 1e-9)
    root = np.sqrt(2.0) * sigma
    step = 0.5 * (erf((radius - r) / root) + erf((radius + r) / root))
    lobe = sigma / (np.sqrt(2 * np.pi) * r)
    return step - lobe * (np.exp(-0.5 * ((r - radius) / sigma) ** 2) - np.exp(-0.5 * ((r + radius) / sigma) ** 2))


def balls_volume(grid, centres, radii, sigma, grey=None):
    """float64 values [z, y, x] of blurred balls, mm; each ball is filled in only where it is not zero."""
    values = np.zeros(grid.shape)
    grey = np.ones(len(centres)) if grey is None else grey
    z, y, x = (grid.origin[2 - a] + grid.spacing[2 - a] * np.arange(grid.shape[a]) for a in range(3))
    for c, r, g in zip(centres, radii, grey, strict=True):
        reach = r + 7 * sigma
        k, j, i = (np.flatnonzero(np.abs(axis - c[2 - a]) <= reach) for a, axis in enumerate((z, y, x)))
        d = np.sqrt((z[k, None, None] - c[2]) ** 2 + (y[None, j, None] - c[1]) ** 2 + (x[None, None, i] - c[0]) ** 2)
        values[np.ix_(k, j, i)] += g * blurred_ball(d, r, sigma)
    return values


def balls_on_a_lattice(rng, grid, per_axis, radius_voxel):
    """per_axis^3 centres, mm, on a lattice with random sub-voxel places."""
    v = grid.spacing
    size = np.array(grid.n_xyz)
    places = [(np.arange(per_axis) + 0.5) * size[a] / per_axis - 0.5 for a in range(3)]
    index = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid.origin + v * (index + rng.uniform(-0.5, 0.5, index.shape))


def as_volume(values, grid):
    return Volume(values=values.astype(np.float32), grid=grid)


def grid_of(n, spacing=0.1482, centre=(3.0, -2.0, 5.0)):
    return VoxelGrid(shape=(n, n, n), spacing=np.broadcast_to(spacing, (3,)), centre=np.array(centre))
