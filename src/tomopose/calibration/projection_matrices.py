"""From a calibration to the projection matrices of any scan.  Eq. (5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.model.problem import STILL_MM, STILL_RAD, travel
from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.propagation import field_of_view_points
from tomopose.calibration.uncertainty.trajectory import scatter_variance, shared_variance
from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import corrected_poses
from tomopose.manipulator.poses import PIVOT_TOLERANCE_MM, PoseSequence
from tomopose.units import Array
from tomopose.values import require_types

SCANNER_TOLERANCE = 1e-9


def _require_same_pivot(calibration: Calibration, poses: PoseSequence) -> None:
    if calibration.pivot is None or poses.pivot is None:
        return
    off = np.abs(np.asarray(poses.pivot) - calibration.pivot).max()
    if off > PIVOT_TOLERANCE_MM:
        raise InputError(
            f"the scan's pivot {np.asarray(poses.pivot)} mm is not the calibration's {calibration.pivot} mm (off by "
            f"{off:.6g} mm): a scan about another pivot would be wrong by (1 - R) times that; set the calibration's "
            "pivot or calibrate again"
        )


def _require_what_was_calibrated(calibration: Calibration, poses: PoseSequence) -> None:
    if calibration.arrangement != "turntable":
        return
    shifted, turned = travel(poses.T_MH.R, poses.T_MH.t)
    if turned > STILL_RAD or shifted > STILL_MM:
        raise InputError(
            "the calibration is one of a turning table alone, which says nothing of the manipulator: its mount is "
            "unknown; calibrate with poses that move before a scan that does"
        )


def require_same_scanner(calibration: Calibration, scanner: Scanner) -> None:
    """InputError, naming the parameter, where a scan's scanner is not the calibration's."""
    own = calibration.scanner
    freed = {p.name for p in calibration.parameters}
    # what was estimated with a prior is compared with the value that the prior was about
    given = {a.name: a.value for a in calibration.assumed if a.value is not None}
    for name in ("n_u", "n_v", *PARAMETER_UNITS):
        a, b = given.get(name, getattr(own, name)), getattr(scanner, name)
        if (name not in given and name in freed) or (name == "p_u" and "pitch_ratio" in freed):
            continue
        if b == getattr(own, name):
            continue
        if abs(a - b) > SCANNER_TOLERANCE * max(1.0, abs(a)):
            raise InputError(
                f"the scanner differs from the calibration's: {name} is {b:.9g}, not {a:.9g}; matrices hold only for "
                "the scanner that was calibrated"
            )


def _point_sigma(
    calibration: Calibration, commanded: PoseSequence, poses: PoseSequence, x_M: Array
) -> tuple[Array, Array]:
    """(n, m) px of points x_M (m, 3): in the single view, and the part that all views share.

    Both are what a volume sees: a rigid pose of the object, on which no measurement depends, is taken out.
    """
    shared = np.sqrt(np.maximum(np.mean(shared_variance(calibration, commanded, x_M), axis=2), 0.0))
    own = np.mean(scatter_variance(calibration, poses, x_M), axis=2)
    return np.sqrt(shared**2 + own), shared


@require_types
def projection_matrices(
    calibration: Calibration,
    poses: PoseSequence,
    *,
    binning: int = 1,
    scanner: Scanner | None = None,
    points: ArrayLike | None = None,
    home: RigidTransform | None = None,
) -> ProjectionMatrices:
    """The matrices of a scan, points of W (mm, object at home) to pixels.  Eq. (5).

    Parameters
    ----------
    calibration: as of `calibrate`; its identified manipulator errors are applied to the poses.
    poses:       the scan's poses and table angles.
    binning:     matrices for images averaged over binning x binning pixels.
    scanner:     if given, must be the calibration's, or InputError says where it differs.
    points:      (m, 3) mm in W where `points_sigma` is predicted; by default the corners and centre of the volume that
                 the field of view covers at home.
    home:        T_MH at which points of the object have their coordinates in W; None: the manipulator's zero.  A robot
                 whose zero lies far from the scanner has its object near the W origin in a pose of the scan, so give
                 that, such as `poses.T_MH[0]`.

    `points_sigma` of the result is for the single view, with the manipulator's scatter from pose to pose where it is
    known; `points_sigma_shared` is the calibration's part alone, which all views share.

    Raises
    ------
    InputError  another pivot or scanner than the calibration's.
    """
    _require_same_pivot(calibration, poses)
    _require_what_was_calibrated(calibration, poses)
    if scanner is not None:
        require_same_scanner(calibration, scanner)
    commanded = poses
    poses = corrected_poses(calibration.errors, poses)
    own = calibration.scanner
    alpha = poses.alpha
    T_0 = RigidTransform.identity(Frame.M, Frame.H) if home is None else home.require(Frame.M, Frame.H)
    to_W = own.T_TW(0.0) @ calibration.T_HT @ T_0
    P = eq5_matrices(own, T_HT=calibration.T_HT, T_MH=poses.T_MH, alpha=alpha, home=T_0)
    if points is not None:
        x_M = to_W.inv.apply(np.asarray(points, dtype=np.float64))
    elif (P[:, 2, 3] > 0).all():
        x_M = to_W.inv.apply(field_of_view_points(own))
    else:  # at this home the field of view holds another part of the world than in the scan
        first = own.T_TW(float(alpha[0])) @ calibration.T_HT @ poses.T_MH[0]
        x_M = first.inv.apply(field_of_view_points(own))
    sigma, shared = _point_sigma(calibration, commanded, poses, x_M)
    matrices = ProjectionMatrices(
        P=P,
        n_u=own.n_u,
        n_v=own.n_v,
        p_u=own.p_u,
        p_v=own.p_v,
        pose_id=poses.pose_id,
        points_sigma=sigma,
        points_sigma_shared=shared,
        scanner=own,
        in_front=to_W.apply(np.mean(list(calibration.balls.values()), axis=0)),
    )
    return matrices if binning == 1 else matrices.binned(binning)
