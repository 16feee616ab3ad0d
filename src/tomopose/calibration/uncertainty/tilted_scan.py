"""What a calibration would do to a scan with tilts of 5 degrees: one figure for the verdict."""

from __future__ import annotations

import numpy as np

from tomopose.calibration.model.problem import Problem
from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.propagation import field_of_view_points, tilt_sigma
from tomopose.calibration.uncertainty.trajectory import trajectory_sigma
from tomopose.errors import OutOfReachError, TrajectoryError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import RigidErrors, TwinErrors
from tomopose.manipulator.poses import PoseSequence

TILT = np.radians(5.0)


def tilted_scan_sigma(calibration: Calibration, problem: Problem) -> float | None:
    """px, rms over the field of view: predicted standard uncertainty of the views of a scan with tilts of 5 degrees.

    With identified errors the tilts are about a pose of the calibration itself, which the machine can reach, and the
    object's rigid pose is taken out.  None for twin robots, whose scans have two tables, and where the machine cannot
    tilt so far.
    """
    if isinstance(calibration.errors, TwinErrors):
        return None
    if isinstance(calibration.errors, RigidErrors):
        return tilt_sigma(calibration)
    middle = int(np.argmin(np.linalg.norm(problem.t_MH - np.median(problem.t_MH, axis=0), axis=1)))
    at = RigidTransform(R=problem.R_MH[middle], t=problem.t_MH[middle], source=Frame.M, target=Frame.H)
    w = TILT * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    T_MH = RigidTransform(R=exp_rotation(w) @ at.R, t=np.tile(at.t, (7, 1)), source=Frame.M, target=Frame.H)
    poses = PoseSequence(T_MH=T_MH, pose_id=tuple("abcdefg"))
    to_W = calibration.scanner.T_TW(0.0) @ calibration.T_HT
    points = to_W.apply((to_W @ at).inv.apply(field_of_view_points(calibration.scanner)))
    try:
        sigma = trajectory_sigma(calibration, poses, points)
    except (TrajectoryError, OutOfReachError):
        return None
    return float(np.sqrt(np.mean(sigma**2)))
