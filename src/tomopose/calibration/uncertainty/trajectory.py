"""How far a scan's projections are off, once the pose of the object, which no measurement depends on, is removed.

The figure of merit of a trajectory: project points of the object with the estimated and with the true chain, let the
object take the rigid pose that explains most of the difference, and take the rms of what remains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, projection_blocks
from tomopose.calibration.model.unseen import unseen_columns
from tomopose.calibration.result import Calibration
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.rotations import skew
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


def trajectory_jacobian(calibration: Calibration, poses: PoseSequence, points: ArrayLike) -> tuple[Array, Array]:
    """How the scan's pixels answer to what was estimated, with the object's rigid pose removed.

    Returns J (n, m, 2, c): derivatives, px, of points (m, 3) of W at home by the coordinates of `calibration.tangent`,
    after the rigid pose of the object that undoes most of each; and J_pose (n, m, 2, 6) by (w, t) of the plate, rad and
    mm, in H.  `poses` are the commanded ones; identified errors of the manipulator are applied here.
    """
    columns, J_pose = _columns(calibration, poses, plate_points(calibration, points))
    return columns[..., : len(calibration.tangent)], J_pose


def plate_points(calibration: Calibration, points: ArrayLike) -> Array:
    """(m, 3) mm in M: points of W at home."""
    x = np.asarray(points, dtype=np.float64)
    return np.asarray((calibration.scanner.T_TW(0.0).inv.apply(x) - calibration.T_HT.t) @ calibration.T_HT.R)


def scan_jacobian(calibration: Calibration, poses: PoseSequence, x_M: Array) -> tuple[Array, Array]:
    """(J (n, m, 2, c), C (c, c)): how the pixels of points x_M (m, 3) of the plate answer to what was estimated and to
    what no ball shows, with the object's rigid pose removed, and the covariance of both."""
    J, _ = _columns(calibration, poses, x_M)
    unseen = calibration.unseen
    if unseen is None:
        return J, calibration.covariance
    m = len(calibration.tangent)
    # the estimate is off by K q, the scan by q itself
    more = np.einsum("nmic,cq->nmiq", J[..., :m], unseen.gain) - J[..., m:]
    C = np.zeros((m + len(unseen.names),) * 2)
    C[:m, :m] = calibration.covariance
    C[m:, m:] = np.diag(unseen.sigma**2)
    return np.concatenate([J[..., :m], more], axis=3), C


def _columns(calibration: Calibration, poses: PoseSequence, x_M: Array) -> tuple[Array, Array]:
    """(n, m, 2, c) px by `calibration.tangent` and what is unseen, the object's rigid pose removed; (n, m, 2, 6) px by
    the plate's pose."""
    scanner, names, unseen = calibration.scanner, calibration.tangent, calibration.unseen
    fixed = correction(calibration.errors, poses)
    T_MH = fixed.poses.T_MH
    n, m, c = len(poses), len(x_M), len(names)
    J = np.zeros((n, m, 2, c + (0 if unseen is None else len(unseen.names))))
    freed = [(j, name.split("[")[0]) for j, name in enumerate(names)]
    errors = [names.index(name) for name in fixed.names]
    alpha = poses.alpha
    # every pose with every point, poses first: one projection of all of them
    pose = np.repeat(np.arange(n), m)
    x = np.tile(x_M, (n, 1))
    b = projection_blocks(scanner, T_HT=calibration.T_HT, T_MH=T_MH[pose], t=x, alpha=alpha[pose])
    J_pose = np.concatenate([-b.G_H @ skew(b.x_H - T_MH.t[pose]), b.G_H], axis=2).reshape(n, m, 2, 6)
    rigid_pose = np.concatenate([-b.J_t @ skew(x), b.J_t], axis=2)
    J[..., :6] = b.J_mount.reshape(n, m, 2, 6)
    if errors:
        J[..., errors] = J_pose @ fixed.J[:, None]
    for j, name in freed:
        if name in SCANNER_COLUMNS or name == "pitch_ratio":
            column, factor = ("p_u", scanner.p_v) if name == "pitch_ratio" else (name, 1.0)
            J[..., j] = (b.J_scanner[:, :, SCANNER_COLUMNS.index(column)] * factor).reshape(n, m, 2)
    if unseen is not None:
        of_q = unseen_columns(
            unseen.names,
            b,
            T_HT=calibration.T_HT,
            origin=T_MH.t[pose],
            alpha=alpha[pose],
            about_H=calibration.inverse,
        )
        J[..., c:] = of_q.reshape(n, m, 2, -1)
    G = rigid_pose.reshape(-1, 6)
    # two points, or points in a line, leave a turn about it without effect: that is no direction to take out
    U, size, _ = np.linalg.svd(G / np.maximum(np.linalg.norm(G, axis=0), 1e-300), full_matrices=False)
    Q = U[:, size > RANK * size[0]]
    flat = J.reshape(-1, J.shape[3])
    flat = flat - Q @ (Q.T @ flat)
    return flat.reshape(J.shape), J_pose


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
            J = np.concatenate([-b.G_H @ skew(lever), b.G_H], axis=2)
            V[:, i] = (J**2) @ variance
            for column, sigma in views.items():
                V[:, i] += (sigma * b.J_scanner[:, :, column]) ** 2
    return V


def shared_variance(calibration: Calibration, poses: PoseSequence, x_M: Array) -> Array:
    """(n, m, 2) px^2 of points x_M (m, 3) of the plate: the part that all views of a scan share, the object's rigid
    pose removed."""
    J, C = scan_jacobian(calibration, poses, x_M)
    return np.asarray(np.einsum("nmic,cd,nmid->nmi", J, C, J, optimize=True))


def trajectory_sigma(
    calibration: Calibration, poses: PoseSequence, points: ArrayLike, *, scatter: bool = False
) -> Array:
    """(n, m, 2) px: standard uncertainty of points (m, 3) of W at home in a scan, the object's rigid pose removed.

    scatter: add the manipulator's scatter from pose to pose, for the single view; else the part that views share.
    """
    x_M = plate_points(calibration, points)
    V = shared_variance(calibration, poses, x_M)
    if scatter:
        V = V + scatter_variance(calibration, correction(calibration.errors, poses).poses, x_M)
    return np.sqrt(np.maximum(V, 0.0))
