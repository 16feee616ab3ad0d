"""From a calibration to the projection matrices of any scan.  Eq. (5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.model.problem import STILL_MM, STILL_RAD, travel
from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.propagation import field_of_view_points
from tomopose.calibration.uncertainty.trajectory import scan_jacobian, scatter_variance
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import corrected_poses
from tomopose.manipulator.poses import PIVOT_TOLERANCE_MM, PoseSequence
from tomopose.units import Array
from tomopose.values import require_types

SCANNER_TOLERANCE = 1e-9


def _require_same_pivot(calibrated: Array | None, scanned: Array | None) -> None:
    if calibrated is None or scanned is None:
        return
    off = np.abs(np.asarray(scanned) - calibrated).max()
    if off > PIVOT_TOLERANCE_MM:
        raise InputError(
            f"the scan's pivot {np.asarray(scanned)} mm is not the calibration's {calibrated} mm (off by "
            f"{off:.6g} mm): a scan about another pivot would be wrong by (1 - R) times that; set the calibration's "
            "pivot or calibrate again"
        )


def _require_what_was_calibrated(arrangement: str, poses: PoseSequence) -> None:
    if arrangement != "turntable":
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
    _require_same_pivot(calibration.pivot, poses.pivot)
    _require_what_was_calibrated(calibration.arrangement, poses)
    if scanner is not None:
        require_same_scanner(calibration, scanner)
    own, real = calibration.scanner, corrected_poses(calibration.errors, poses)
    P = eq5_matrices(own, T_HT=calibration.T_HT, T_MH=real.T_MH, alpha=poses.alpha, home=home)
    # the plate in W at home, by which the points of the object are known
    T_HW = own.T_TW(0.0).matrix @ calibration.T_HT.matrix
    T_MW = T_HW if home is None else T_HW @ home.matrix
    x_W = field_of_view_points(own) if points is None else np.asarray(points, dtype=np.float64)
    seen_at = T_MW
    if points is None and not (P[:, 2, 3] > 0).all():
        # at this home the field of view holds another part of the world than in the scan
        seen_at = own.T_TW(float(poses.alpha[0])).matrix @ calibration.T_HT.matrix @ real.T_MH[0].matrix
    x_M = (x_W - seen_at[:3, 3]) @ seen_at[:3, :3]
    J, C = scan_jacobian(calibration, poses, x_M)
    # both are what a volume sees: a rigid pose of the object, on which no measurement depends, is taken out
    shared = np.maximum(np.mean(np.einsum("nmic,cd,nmid->nmi", J, C, J, optimize=True), axis=2), 0.0)
    scatter = np.mean(scatter_variance(calibration, real, x_M), axis=2)
    ball = np.mean(list(calibration.balls.values()), axis=0)
    matrices = ProjectionMatrices(
        P=P,
        n_u=own.n_u,
        n_v=own.n_v,
        p_u=own.p_u,
        p_v=own.p_v,
        pose_id=poses.pose_id,
        points_sigma=np.sqrt(shared + scatter),
        points_sigma_shared=np.sqrt(shared),
        scanner=own,
        in_front=T_MW[:3, :3] @ ball + T_MW[:3, 3],
    )
    return matrices if binning == 1 else matrices.binned(binning)
