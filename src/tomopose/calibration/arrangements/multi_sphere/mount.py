"""Where the standard sits on the plate and the manipulator in the scanner: what a pose table makes of the found poses.

    T_MW,j = T_TW(alpha_j) T_HT B_j X,     B_j the plate's pose in the table, X the standard on the plate

(hand-eye calibration; Park & Martin, IEEE Trans. Robot. Autom. 10 (1994) 717).  Nothing of it enters the matrices but
the home: points of W are those of the object while the plate is at its zero and the table at 0, as in eq. (5).  What is
left in each view is the manipulator's error there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import R_z, log_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array

TURNED = 1e-3
"""rad; rotations of the plate between views below this do not say how its axes lie."""
RANK = 1e-6
ROUNDS = 20


@dataclass(frozen=True, kw_only=True)
class Mount:
    """T_HT: manipulator base -> table.  X: standard on the plate (M of the standard -> plate).

    errors: (n, 6) by which the found poses differ from the table's: rotation vector, rad, and translation of the
    standard's middle, mm, along W.  determined: whether the plate's turns determine T_HT's rotation.
    """

    T_HT: RigidTransform
    X: RigidTransform
    errors: Array
    determined: bool


def find_mount(scanner: Scanner, poses: PoseSequence, T_MW: tuple[RigidTransform, ...], middle: Array) -> Mount:
    """The mount that brings the pose table nearest to the found poses M -> W; middle (3,): mm in M."""
    B_R, B_t = poses.T_MH.R, poses.T_MH.t
    A = [scanner.T_TW(float(a)).inv @ T for a, T in zip(poses.alpha, T_MW, strict=True)]
    A_R, A_t = np.array([T.R for T in A]), np.array([T.t for T in A])
    R_HT, determined = _rotation(A_R, B_R)
    R_X = _mean_rotation(np.swapaxes(B_R, 1, 2) @ R_HT.T @ A_R)
    for _ in range(ROUNDS if determined else 0):
        R_HT = _mean_rotation(A_R @ R_X.T @ np.swapaxes(B_R, 1, 2))
        R_X = _mean_rotation(np.swapaxes(B_R, 1, 2) @ R_HT.T @ A_R)
    # A_t = R_HT (B_R t_X + B_t) + t_HT, about the standard's middle, whose place the views know best
    seen = A_R @ middle + A_t
    rows = np.concatenate([R_HT @ B_R, np.broadcast_to(np.eye(3), B_R.shape)], axis=2).reshape(-1, 6)
    t, *_ = np.linalg.lstsq(rows, (seen - B_t @ R_HT.T).ravel(), rcond=RANK)
    T_HT = RigidTransform(R=R_HT, t=t[3:], source=Frame.H, target=Frame.T)
    X = RigidTransform(R=R_X, t=t[:3] - R_X @ middle, source=Frame.M, target=Frame.M)
    errors = []
    for alpha, T, B in zip(poses.alpha, T_MW, poses.T_MH, strict=True):
        table = scanner.T_TW(float(alpha)) @ T_HT @ B @ X
        errors.append(np.concatenate([log_rotation(T.R @ table.R.T), T.apply(middle) - table.apply(middle)]))
    return Mount(T_HT=T_HT, X=X, errors=np.array(errors), determined=determined)


def _rotation(A: Array, B: Array) -> tuple[Array, bool]:
    """R_HT from relative rotations, log(A_i A_j^T) = R_HT log(B_i B_j^T); R_z(pi), the paper's, where the plate turns
    about less than two axes."""
    a = log_rotation(A[1:] @ np.swapaxes(A[:-1], 1, 2))
    b = log_rotation(B[1:] @ np.swapaxes(B[:-1], 1, 2))
    spread = np.linalg.svd(b, compute_uv=False) if len(b) else np.zeros(3)
    if len(spread) < 2 or spread[1] < TURNED:
        return R_z(np.pi), False
    u, _, vt = np.linalg.svd(a.T @ b)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt), True


def _mean_rotation(R: Array) -> Array:
    """The rotation nearest to the mean of rotations (n, 3, 3)."""
    u, _, vt = np.linalg.svd(R.mean(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)
