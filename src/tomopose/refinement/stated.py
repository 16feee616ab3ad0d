"""The prior of the views' motions, from what the settings, the calibration or the matrices state."""

from __future__ import annotations

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.trajectory import plate_points, scan_jacobian, scatter_variance
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.manipulator.poses import PoseSequence
from tomopose.refinement.joint_fit.motions import pixel_jacobian
from tomopose.refinement.prior import Prior, scatter, with_shared_errors
from tomopose.refinement.settings import DEFAULT_SIGMA_PX, RefineSettings
from tomopose.units import Array
from tomopose.volume import VoxelGrid


def radius_of(grid: VoxelGrid) -> float:
    """Half the longest side of the grid, mm: the lever of a turn."""
    return float(max(grid.spacing * np.array(grid.n_xyz)) / 2)


def points_of(grid: VoxelGrid) -> Array:
    """(9, 3) mm in W: the middle of the grid and the corners of the box of 0.8 of its size."""
    centre = np.asarray(grid.centre)
    return np.concatenate([centre[None], centre + 0.8 * (grid.corners - centre) / np.sqrt(2)])


def prior_of(
    matrices: ProjectionMatrices,
    grid: VoxelGrid,
    s: RefineSettings,
    calibration: Calibration | None,
    poses: PoseSequence | None = None,
) -> tuple[Prior, float]:
    """The prior of the views' motions, and the scatter from view to view in it, px (rms).

    The scatter is what the settings, the calibration with the scan's poses, the matrices, the calibration's residual or
    the documented default say, in this order.  With a calibration and poses its covariance joins, correlated over all
    views: what the ball knows of the slow errors, which images half a turn apart cannot tell.
    """
    n, centre = len(matrices), np.asarray(grid.centre)
    own = None if calibration is None or poses is None else scatter_px(calibration, poses, matrices, grid)
    if s.sigma_px is not None:
        px = np.full(n, s.sigma_px)
    elif own is not None and np.all(own > 0):
        px = own
    elif matrices.points_sigma is not None and np.all(matrices.points_sigma > 0):
        px = np.sqrt(np.mean(matrices.points_sigma**2, axis=1))
    elif calibration is not None and calibration.d_rms > 0:
        px = np.full(n, calibration.d_rms * np.sqrt(np.mean(pixel_ratio(calibration, matrices) ** 2)))
    else:
        px = np.full(n, DEFAULT_SIGMA_PX)
    K = pixel_jacobian(matrices.P, centre[None], centre)[:, 0, :, :3]  # px per mm
    mm = px / np.sqrt(np.einsum("nic,nic->n", K, K) / 2)
    prior = scatter(mm, mm / radius_of(grid))
    if calibration is not None and poses is not None:
        prior = with_shared_errors(prior, *shared_motions(calibration, poses, matrices, grid))
    return prior, float(np.sqrt(np.mean(px**2)))


def pixel_ratio(calibration: Calibration, matrices: ProjectionMatrices) -> Array:
    """(2,): u and v in pixels of the matrices for one pixel of the calibration's scanner, below 1 for binned images."""
    scanner = calibration.scanner
    return np.array([scanner.p_u / matrices.p_u, scanner.p_v / matrices.p_v])


def scatter_px(calibration: Calibration, poses: PoseSequence, matrices: ProjectionMatrices, grid: VoxelGrid) -> Array:
    """(n,) px per coordinate: the manipulator's scatter from view to view, by the calibration; 0 where it has none."""
    variance = scatter_variance(calibration, poses, plate_points(calibration, points_of(grid)))
    return np.asarray(np.sqrt(np.mean(variance * pixel_ratio(calibration, matrices) ** 2, (1, 2))))


def shared_motions(
    calibration: Calibration, poses: PoseSequence, matrices: ProjectionMatrices, grid: VoxelGrid
) -> tuple[Array, Array]:
    """L (n, 6, c): each view's motion by each error that the calibration may have, and C (c, c), their covariance."""
    points = points_of(grid)
    J, C = scan_jacobian(calibration, poses, plate_points(calibration, points))
    J = J * pixel_ratio(calibration, matrices)[:, None]
    K = pixel_jacobian(matrices.P, points, np.asarray(grid.centre)).reshape(len(matrices), -1, 6)
    scale = np.linalg.norm(K, axis=1, keepdims=True)
    pulled = np.linalg.pinv(K / scale) @ J.reshape(len(matrices), K.shape[1], -1)
    return pulled / scale.transpose(0, 2, 1), C
