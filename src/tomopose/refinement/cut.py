"""Objects that reach beyond the grid: which faces they cross, and the rays that meet what lies beyond."""

from __future__ import annotations

import numpy as np

from tomopose.refinement.measured import Measured
from tomopose.units import Array

MATTER = 0.15
"""Share of the volume's dense values (99.9 %) from which a voxel of the outermost layers counts as matter."""
CROSSED = 0.05
"""Share of a face's voxels that are matter from which the object crosses it: noise and streaks fill less."""
FACES = ("-x", "+x", "-y", "+y", "-z", "+z")


def crossed_faces(volume: np.ndarray) -> tuple[str, ...]:
    """Faces of the grid through which the object [z, y, x] leaves it."""
    dense = float(np.quantile(volume, 0.999))
    if dense <= 0:
        return ()
    faces = []
    for axis, name in ((2, "x"), (1, "y"), (0, "z")):
        layers = np.moveaxis(volume, axis, 0)
        for sign, outer in (("-", layers[:2]), ("+", layers[-2:])):
            if float(np.mean(outer.mean(axis=0) > MATTER * dense)) > CROSSED:
                faces.append(sign + name)
    return tuple(sorted(faces, key=FACES.index))


def rays_through(data: Measured, faces: tuple[str, ...]) -> Array:
    """bool (n, N): rays that enter or leave the grid through one of the faces."""
    m, grid = data.matrices, data.grid
    low, high = grid.corners.min(axis=0), grid.corners.max(axis=0)
    u, v = np.meshgrid(np.arange(m.n_u), np.arange(m.n_v), indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    result = np.zeros(data.p.shape, dtype=bool)
    for j, P in enumerate(m.P):
        M_inv = np.linalg.inv(P[:, :3])
        s, d = -M_inv @ P[:, 3], (M_inv @ pixels).T
        d = np.where(np.abs(d) < 1e-12, 1e-12, d)
        t_low, t_high = (low - s) / d, (high - s) / d
        near, far = np.minimum(t_low, t_high), np.maximum(t_low, t_high)
        enter, leave = near.argmax(axis=1), far.argmin(axis=1)
        meets = near.max(axis=1) < far.min(axis=1)
        for face in faces:
            axis, up = "xyz".index(face[1]), face[0] == "+"
            inwards = (d[:, axis] < 0) == up
            result[j] |= meets & (((enter == axis) & inwards) | ((leave == axis) & ~inwards))
    return result
