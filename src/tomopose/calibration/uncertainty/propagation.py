"""A calibration's covariance carried on: to pixels of a scan, to micrometres at the object, to lengths between points.

Eq. (5) written for a point of W at home: x_H = R_HT^T (x_W - t_HT), x_H,j = R_j x_H + s t_j, x_T = R_HT x_H,j + t_HT.
Both the way in (home^-1) and the way out depend on T_HT, so a change w of R_HT turns the *differences* only:
dx_T = (1 - A) dt + w x (R_HT x_H,j) - A (w x (x_W - t_HT)), A = R_HT R_j R_HT^T.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, projection_blocks
from tomopose.calibration.model.parameters import base_name
from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.trajectory import plate_points, scan_jacobian
from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.object_pose import pixels, point_jacobian
from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import correction
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array

TILT = np.radians(5.0)
_ACTS = (*SCANNER_COLUMNS, "pitch_ratio")


def field_of_view_points(scanner: Scanner, share: float = 0.8) -> Array:
    """(9, 3) mm in W: centre and corners of the box that `share` of the field of view holds at every table angle."""
    M = scanner.magnification
    u = (np.array([0.0, scanner.n_u - 1.0]) - scanner.u_0) * scanner.p_u / M
    v = (np.array([0.0, scanner.n_v - 1.0]) - scanner.v_0) * scanner.p_v / M
    # a square inscribed in the circle that every table angle keeps in view
    half = share * min(np.abs(u)) / np.sqrt(2.0)
    # an axis outside the detector (offset window) still has a field: take the far side then
    if u[0] * u[1] >= 0:
        half = share * max(np.abs(u)) / np.sqrt(2.0)
    z = share * v
    corners = np.array([[x, y, h] for x in (-half, half) for y in (-half, half) for h in z])
    return np.concatenate([[[0.0, 0.0, z.mean()]], corners])


def matrix_point_jacobian(calibration: Calibration, poses: PoseSequence, x_W: Array) -> Array:
    """(n, m, 2, c): derivatives of the pixels of points x_W (m, 3), under eq. (5), by the coordinates of `tangent`."""
    names, scanner = calibration.tangent, calibration.scanner
    R, t_HT = calibration.T_HT.R, calibration.T_HT.t
    x_W = np.asarray(x_W, dtype=np.float64)
    n, m = len(poses), len(x_W)
    home = (x_W - scanner.T_TW(0.0).t) @ scanner.T_TW(0.0).R  # x_T at home
    x_M = (home - t_HT) @ R
    T = poses.T_MH
    result = np.zeros((n, m, 2, len(names)))
    free = [(j, base_name(name)) for j, name in enumerate(names) if base_name(name) in _ACTS]
    A = R @ T.R @ R.T
    for i in range(m):
        b = projection_blocks(scanner, T_HT=calibration.T_HT, T_MH=T, t=x_M[i], alpha=poses.alpha)
        G = b.J_t_HT
        x_out = b.x_H @ R.T
        result[:, i, :, :3] = -G @ skew(x_out) + G @ A @ skew(home[i] - t_HT)
        result[:, i, :, 3:6] = G @ (np.eye(3) - A)
        for j, name in free:
            column, factor = ("p_u", scanner.p_v) if name == "pitch_ratio" else (name, 1.0)
            result[:, i, :, j] = b.J_scanner[:, :, SCANNER_COLUMNS.index(column)] * factor
    return result


def matrix_point_sigma(calibration: Calibration, poses: PoseSequence, x_W: ArrayLike) -> Array:
    """(n, m) px: predicted standard uncertainty (root of the mean of the two variances) of points x_W (m, 3) in W."""
    J = matrix_point_jacobian(calibration, poses, np.asarray(x_W, dtype=np.float64))
    V = np.einsum("nmic,cd,nmid->nmi", J, calibration.covariance, J)
    result: Array = np.sqrt(np.maximum(V.mean(axis=2), 0.0))
    return result


def tilt_sigma(calibration: Calibration, tilt: float = TILT) -> float:
    """px: predicted standard uncertainty over the field of view (rms) of a scan tilted by `tilt` rad, table still."""
    w = tilt * np.concatenate([np.eye(3), -np.eye(3)])
    T_MH = RigidTransform(R=exp_rotation(w), t=np.zeros((6, 3)), source=Frame.M, target=Frame.H)
    poses = PoseSequence(T_MH=T_MH, pose_id=tuple("abcdef"))
    sigma = matrix_point_sigma(calibration, poses, field_of_view_points(calibration.scanner))
    return float(np.sqrt(np.mean(sigma**2)))


def apparent_displacement(calibration: Calibration, poses: PoseSequence, x_W: ArrayLike) -> Array:
    """(m, 3, c) mm: where points x_W (m, 3) come to lie in a reconstruction, by the calibration's errors.

    A point is reconstructed where its images under the wrong matrices fit best: G dx = -J e in the least squares over
    all views, G the derivative of the pixels by the point and J by the calibration.
    """
    x = np.asarray(x_W, dtype=np.float64)
    J = matrix_point_jacobian(calibration, poses, x)
    P = eq5_matrices(calibration.scanner, T_HT=calibration.T_HT, T_MH=poses.T_MH, alpha=poses.alpha)
    h = np.einsum("nij,mj->nmi", P[:, :, :3], x) + P[:, None, :, 3]
    G = (P[:, None, :2, :3] - (h[..., :2] / h[..., 2:])[..., None] * P[:, None, 2:, :3]) / h[..., 2:, None]
    N = np.einsum("nmia,nmib->mab", G, G)
    return -np.linalg.solve(N, np.einsum("nmia,nmic->mac", G, J))


def object_sigma(calibration: Calibration, poses: PoseSequence, x_W: ArrayLike) -> Array:
    """(m, 3) mm: standard uncertainty of each coordinate of points x_W (m, 3) in a reconstruction of this scan."""
    B = apparent_displacement(calibration, poses, x_W)
    result: Array = np.sqrt(np.einsum("mac,cd,mad->ma", B, calibration.covariance, B))
    return result


def scan_displacement(calibration: Calibration, poses: PoseSequence, x_W: ArrayLike) -> tuple[Array, Array]:
    """(B (m, 3, c) mm, C (c, c)): where points x_W (m, 3) come to lie, by everything that was estimated or assumed.

    As `apparent_displacement`, for every model, with what no ball shows beside the calibration's coordinates; the rigid
    pose of the object is taken out, so that lengths between the points are right and their places are not stated.
    """
    x = np.asarray(x_W, dtype=np.float64)
    J, C = scan_jacobian(calibration, poses, plate_points(calibration, x))
    T_MH = correction(calibration.errors, poses).poses.T_MH
    P = eq5_matrices(calibration.scanner, T_HT=calibration.T_HT, T_MH=T_MH, alpha=poses.alpha)
    if not np.isfinite(pixels(P, x)).all():
        raise InputError("points of the part have no image in some views; are these the scan's poses?")
    G = point_jacobian(P, x)
    N = np.einsum("nmia,nmib->mab", G, G)
    return -np.linalg.solve(N, np.einsum("nmia,nmic->mac", G, J, optimize=True)), C


def length_sigma(calibration: Calibration, poses: PoseSequence, x_a: ArrayLike, x_b: ArrayLike) -> Array:
    """(m,) mm: standard uncertainty, from the calibration and all that it assumed, of the lengths between points x_a
    and x_b (m, 3) of W in a reconstruction of this scan."""
    a, b = np.atleast_2d(np.asarray(x_a, dtype=np.float64)), np.atleast_2d(np.asarray(x_b, dtype=np.float64))
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    B, C = scan_displacement(calibration, poses, np.concatenate([a, b]))
    g = np.einsum("ma,mac->mc", along, B[len(a) :] - B[: len(a)])
    sigma: Array = np.sqrt(np.einsum("mc,cd,md->m", g, C, g))
    return sigma
