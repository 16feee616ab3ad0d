r"""What a calibration is for: the reprojection error of a scan, as a quadratic form in the calibration's errors.

An error e of the tangent (w_HT, t_HT, t ..., freed parameters) moves the pixels of the object's points by J e.  An
object may lie anywhere: the part of J e that a rigid move of the object explains is no error of the scan, and is
projected out.  With A what remains of J, over all views and points,

    rms^2 = e^T M e,   M = A^T A / (views x points),   expected  tr(M C)  for a calibration with covariance C.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.model.ball_projection import projection_blocks
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.calibration.rigid.fit import tangent_names
from tomopose.errors import InputError
from tomopose.geometry.box import BOX_CORNERS
from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle
from tomopose.units import Array

OBJECT_MM = (15.0, 15.0, 30.0)


@dataclass(frozen=True, kw_only=True)
class ScanTarget:
    """M (m, m) in the coordinates `names`; px^2 per unit^2.  `rms(C)` is the predicted scan reprojection error, px."""

    M: Array
    names: tuple[str, ...]

    def rms(self, covariance: ArrayLike) -> float:
        return float(np.sqrt(max(np.trace(self.M @ np.asarray(covariance)), 0.0)))


def box_points(half: Sequence[float] = OBJECT_MM) -> Array:
    """Corners and centre (9, 3) of a box about the W origin, mm."""
    return np.concatenate([np.zeros((1, 3)), BOX_CORNERS * np.asarray(half, dtype=np.float64)])


def default_scan(T_HT: RigidTransform, views: int = 90) -> PoseSequence:
    """The paper's tilted scan, eqs. (10) and (11)."""
    return tilted_scan(views, eq11_triangle, R_HT=T_HT.R)


def scan_target(
    scanner: Scanner,
    *,
    T_HT: RigidTransform,
    scan: PoseSequence | None = None,
    points: ArrayLike | None = None,
    n_balls: int = 1,
    free: FreeParameters | None = None,
) -> ScanTarget:
    """The quadratic form of a scan.

    scan:   its poses (default: the paper's tilted scan, 90 views).
    points: (p, 3) mm of the object in W at home (default: a box of +-15, +-15, +-30 mm).
    n_balls, free: which coordinates the calibration has besides T_HT.
    """
    scan = default_scan(T_HT) if scan is None else scan
    x_W = box_points() if points is None else np.asarray(points, dtype=np.float64)
    if x_W.ndim != 2 or x_W.shape[1] != 3 or len(x_W) < 3:
        raise InputError(f"object points have shape {x_W.shape}; at least three points (p, 3) in mm are needed")
    names = (
        tangent_names(tuple(range(n_balls)), free)
        if free is not None
        else (
            *(f"w_HT_{c}" for c in "xyz"),
            *(f"t_HT_{c}" for c in "xyz"),
            *(f"t_{c}" if n_balls == 1 else f"t[{b}]_{c}" for b in range(n_balls) for c in "xyz"),
        )
    )
    # x_W at home = T_HT x_M, so the object's points sit at x_M in the moved plate; a rigid move of the object moves x_M
    x_M = T_HT.inv.apply(x_W)
    n, m = len(scan), len(names)
    f_0 = m - (0 if free is None else len(free))
    J = np.zeros((len(x_W), n, 2, m))
    G = np.zeros((len(x_W), n, 2, 6))
    for i, x in enumerate(x_M):
        b = projection_blocks(scanner, T_HT=T_HT, T_MH=scan.T_MH, t=x, alpha=scan.alpha)
        J[i, :, :, :6] = b.J_mount
        if free is not None:
            J[i, :, :, f_0:] = b.J_scanner[:, :, free.cols] * free.factor
        G[i, :, :, :3] = b.J_t
        G[i, :, :, 3:] = -b.J_t @ skew(x)
    Q, _ = np.linalg.qr(G.reshape(-1, 6))
    rows = J.reshape(-1, m)
    A = rows - Q @ (Q.T @ rows)
    return ScanTarget(M=A.T @ A / (n * len(x_W)), names=names)
