"""A ball with a blurred edge in a volume: its surface, and the diameter of the sphere that fits it."""

import numpy as np

import tomopose as tp
from tomopose.measurement.features.fits import fit_sphere

grid = tp.VoxelGrid((60, 60, 60), 0.25)
x_W = grid.points(np.moveaxis(np.indices(grid.shape), 0, -1))  # mm, (x, y, z) of every voxel
r = np.linalg.norm(x_W - [0.1, -0.2, 0.05], axis=-1)
volume = tp.Volume((0.05 / (1 + np.exp((r - 5.0) / 0.12))).astype(np.float32), grid)

surface = tp.surface(volume)
sphere = fit_sphere(surface.points)
print(f"{len(surface.points)} points; radius {sphere.radius:.4f} mm, true 5 mm")
