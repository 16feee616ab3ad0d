"""How far a scan's projections are off, once the pose of the object, which no measurement depends on, is removed.

The figure of merit of a trajectory: project points of the object with the estimated and with the true chain, let the
object take the rigid pose that explains most of the difference, and take the rms of what remains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, projection_blocks
from tomopose.calibration.model.unseen import unseen_columns
from tomopose.calibration.result import SCANNER_MOVES, Calibration
from tomopose.geometry.box import BOX_CORNERS
from tomopose.manipulator.error_models import correction
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array

RANK = 1e-9
"""Singular values of a rigid pose's columns, relative to the largest, that still move a point."""


def object_points(half: tuple[float, float, float] = (15.0, 15.0, 30.0)) -> Array:
    """The corners (8, 3) of a box about the origin, mm."""
    return BOX_CORNERS * half


def rms_px(d: Array) -> float:
    """Root mean square distance, px, of differences (..., 2)."""
    return float(np.sqrt(np.mean(np.sum(d**2, axis=-1))))


def plate_points(calibration: Calibration, points: ArrayLike) -> Array:
    """(m, 3) mm in M: points of W at home."""
    x = np.asarray(points, dtype=np.float64)
    return np.asarray((calibration.scanner.T_TW(0.0).inv.apply(x) - calibration.T_HT.t) @ calibration.T_HT.R)


def scan_jacobian(calibration: Calibration, poses: PoseSequence, x_M: Array) -> tuple[Array, Array]:
    """How the pixels of points x_M (m, 3) of the plate answer to what was estimated and to what no ball shows.

    Returns J (n, m, 2, c), px by the coordinates of `calibration.tangent` and of `calibration.unseen`, after the rigid
    pose of the object that undoes most of each; and C (c, c), the covariance of both.  `poses` are the commanded ones;
    identified errors of the manipulator are applied here.
    """
    scanner, names, unseen = calibration.scanner, calibration.tangent, calibration.unseen
    fixed = correction(calibration.errors, poses)
    T_MH = fixed.poses.T_MH
    n, m, c = len(poses), len(x_M), len(names)
    # every pose with every point, poses first: one projection of all of them
    pose = np.repeat(np.arange(n), m)
    x, alpha, origin = np.tile(x_M, (n, 1)), poses.alpha[pose], T_MH.t[pose]
    b = projection_blocks(scanner, T_HT=calibration.T_HT, T_MH=T_MH[pose], t=x, alpha=alpha)
    J = np.zeros((n * m, 2, c + (0 if unseen is None else len(unseen.names))))
    J[..., :3], J[..., 3:6] = b.J_w_HT, b.J_t_HT
    for j, name in enumerate(names):
        column, factor = ("p_u", scanner.p_v) if name == "pitch_ratio" else (name.split("[")[0], 1.0)
        if column in SCANNER_COLUMNS:
            J[..., j] = b.J_scanner[:, :, SCANNER_COLUMNS.index(column)] * factor
    if fixed.names:
        by_pose = np.concatenate([np.cross((b.x_H - origin)[:, None], b.G_H), b.G_H], axis=2)
        J[..., [names.index(name) for name in fixed.names]] = by_pose @ fixed.J[pose]
    if unseen is not None:
        about_H = calibration.arrangement in SCANNER_MOVES
        J[..., c:] = unseen_columns(unseen.names, b, T_HT=calibration.T_HT, origin=origin, alpha=alpha, about_H=about_H)
    # two points, or points in a line, leave a turn about it without effect: that is no direction to take out
    rigid = np.concatenate([np.cross(x[:, None], b.J_t), b.J_t], axis=2).reshape(-1, 6)
    rigid = rigid / np.maximum(np.linalg.norm(rigid, axis=0), 1e-300)
    flat = J.reshape(-1, J.shape[2])
    J = (flat - rigid @ (np.linalg.pinv(rigid, rcond=RANK) @ flat)).reshape(n, m, 2, -1)
    if unseen is None:
        return J, calibration.covariance
    # the estimate is off by K q, the scan by q itself
    J[..., c:] = J[..., :c] @ unseen.gain - J[..., c:]
    return J, block_diag(calibration.covariance, np.diag(unseen.sigma**2))


def scatter_variance(calibration: Calibration, poses: PoseSequence, x_M: Array) -> Array:
    """(n, m, 2) px^2: what the plate's scatter from pose to pose adds to points x_M (m, 3) of the object, and that of
    scanner parameters from view to view.

    poses: the plate's real poses (corrected).
    """
    scatter, T_MH = calibration.errors.scatter, poses.T_MH
    variance = np.zeros(6) if scatter is None else scatter.variance
    views = {} if calibration.views is None else {SCANNER_COLUMNS.index("d_SD"): calibration.views.sigma}
    V = np.zeros((len(poses), len(x_M), 2))
    if variance.any() or views:
        about_H = scatter is not None and scatter.about_H
        for i, x in enumerate(np.asarray(x_M, dtype=np.float64)):
            b = projection_blocks(calibration.scanner, T_HT=calibration.T_HT, T_MH=T_MH, t=x, alpha=poses.alpha)
            lever = b.x_H if about_H else b.x_H - T_MH.t
            J = np.concatenate([np.cross(lever[:, None], b.G_H), b.G_H], axis=2)
            V[:, i] = (J**2) @ variance
            for column, sigma in views.items():
                V[:, i] += (sigma * b.J_scanner[:, :, column]) ** 2
    return V


def trajectory_sigma(
    calibration: Calibration, poses: PoseSequence, points: ArrayLike, *, scatter: bool = False
) -> Array:
    """(n, m, 2) px: standard uncertainty of points (m, 3) of W at home in a scan, the object's rigid pose removed.

    scatter: add the manipulator's scatter from pose to pose, for the single view; else the part that views share.
    """
    x_M = plate_points(calibration, points)
    J, C = scan_jacobian(calibration, poses, x_M)
    V: Array = np.einsum("nmic,cd,nmid->nmi", J, C, J, optimize=True)
    if scatter:
        V = V + scatter_variance(calibration, correction(calibration.errors, poses).poses, x_M)
    return np.asarray(np.sqrt(np.maximum(V, 0.0)))
