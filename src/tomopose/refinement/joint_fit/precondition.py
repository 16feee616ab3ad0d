r"""An approximate inverse of A'WA + lambda, by which conjugate gradients see all spatial frequencies alike.

Back-projecting a projection sums, over the views, what the object is along the beam: in frequency space view j passes a
slab of thickness 1/L about the plane across its beam e_j (L: size of the object).  The mean over the views,

    H(k) = mean_j 1 / (1 + (2 L k . e_j)^2),

is 1/|k| for a full turn and is taken for any path as it is.  Its scale c is measured with one random volume.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from tomopose.geometry.projection import ProjectionMatrices
from tomopose.trajectory.completeness import source_path
from tomopose.units import Floats
from tomopose.volume import VoxelGrid


def passed_frequencies(matrices: ProjectionMatrices, grid: VoxelGrid) -> Floats:
    """H(k) [x, y, z], in the layout of scipy.fft.rfftn: how much of a frequency the views see."""
    beams = np.asarray(grid.centre) - source_path(matrices.P)
    beams /= np.linalg.norm(beams, axis=1)[:, None]
    spacing, (n_x, n_y, n_z) = np.broadcast_to(grid.spacing, 3), grid.n_xyz
    size = float(min(spacing * np.array(grid.n_xyz)))
    k_x = (np.fft.fftfreq(n_x, spacing[0]) * 2 * size).astype(np.float32)[:, None, None]
    k_y = (np.fft.fftfreq(n_y, spacing[1]) * 2 * size).astype(np.float32)[None, :, None]
    k_z = (np.fft.rfftfreq(n_z, spacing[2]) * 2 * size).astype(np.float32)[None, None, :]
    H = np.zeros((n_x, n_y, n_z // 2 + 1), dtype=np.float32)
    for e in beams.astype(np.float32):
        H += 1 / (1 + (k_x * e[0] + k_y * e[1] + k_z * e[2]) ** 2)
    return np.asarray(H / np.float32(len(beams)))


@dataclass(frozen=True, kw_only=True)
class Preconditioner:
    """z = F^-1 1/(c H + lambda) F r over the voxels that may move.

    inverse: 1/(c H + lambda), as `passed_frequencies`.  free: bool, as the engine's state.
    """

    inverse: Floats
    free: np.ndarray

    @classmethod
    def of(cls, H: Floats, free: np.ndarray, probe: np.ndarray, energy: float, ridge: float) -> Preconditioner:
        """probe: a random volume over the free voxels; energy: probe' A'WA probe, which sets the scale c."""
        inner = probe[1:-2, 1:-2, 1:-2]
        power = np.abs(scipy.fft.rfftn(inner)) ** 2
        twice = np.full(H.shape[2], 2.0)  # frequencies that rfftn leaves out because they repeat
        twice[0] = 1.0
        if inner.shape[2] % 2 == 0:
            twice[-1] = 1.0
        passed = float(np.einsum("xyz,xyz,z->", power, H, twice)) / inner.size
        return cls(inverse=(1 / (energy / max(passed, 1e-30) * H + ridge)).astype(np.float32), free=free)

    def __call__(self, residual: np.ndarray) -> np.ndarray:
        z = np.zeros_like(residual)
        inner = residual[1:-2, 1:-2, 1:-2]
        z[1:-2, 1:-2, 1:-2] = scipy.fft.irfftn(scipy.fft.rfftn(inner) * self.inverse, s=inner.shape)
        return np.where(self.free, z, np.float32(0))
