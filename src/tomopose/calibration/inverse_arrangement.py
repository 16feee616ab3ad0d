"""Calibration where source and detector move and the ball stands still; d_SD fixed, or one more number a view."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.calibration.kinematic import calibrate_kinematic, machine_of
from tomopose.calibration.residuals import SCANNER_COLUMNS, projection_blocks
from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import calibrate
from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.error_models import corrected_poses
from tomopose.manipulator.inverse import InverseManipulator, inverse_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array


def calibrate_inverse(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    manipulator: Any = None,
    model: str = "auto",
    d_SD_sigma: float = 0.0,
    **options: Any,
) -> Calibration:
    """Find the scanner's mount on the moved plate and the ball in the base.  Eq. (6) over the inverse chain.

    Parameters
    ----------
    scanner, observations: as in `calibrate`; d_SR is only the origin of W in the scanner's own frame.
    poses:        T_MH of the plate that carries source and detector; the table angle must be 0.
    manipulator, model: as in `calibrate`.
    d_SD_sigma:   mm, standard deviation of d_SD from view to view; 0: source and detector are fixed to one another.
    options:      free, fix, priors, robust of `calibrate`.

    Returns
    -------
    A calibration whose T_HT is the mount (moved plate -> T) and whose ball is given in the base.  Matrices of a scan:
    `projection_matrices(calibration, inverse_poses(scan))`; their points are points of the standing object.
    """
    if np.asarray(poses.alpha).any():
        raise InputError("the arrangement with a standing object has no rotary table; alpha must be 0 in every pose")
    if not (np.isfinite(d_SD_sigma) and d_SD_sigma >= 0):
        raise InputError(f"d_SD_sigma is {d_SD_sigma}; a standard deviation >= 0 in mm is needed")
    turned = inverse_poses(poses)
    rigid = calibrate(scanner, turned, observations, model="rigid", hypotheses=False, **options)
    machine = machine_of(manipulator)
    if machine is None and not d_SD_sigma and model in ("auto", "rigid"):
        return rigid
    return calibrate_kinematic(
        scanner, turned, observations, rigid=rigid,
        manipulator=None if machine is None else InverseManipulator(machine=machine),
        model="rigid" if machine is None and model == "auto" else model,
        view_sigma={"d_SD": d_SD_sigma} if d_SD_sigma else None,
    )


def view_distances(
    calibration: Calibration, poses: PoseSequence, observations: BallObservations, *, d_SD_sigma: float
) -> tuple[Array, Array]:
    """(d_SD, u) of each observed view, mm, (n,): its most probable value given the ball's place in that view.

    The ball moves along the line from the piercing point when d_SD changes, so a ball near it tells nothing and u stays
    d_SD_sigma.  poses: as given to `calibrate_inverse`; rows as in `observations`.
    """
    rows = inverse_poses(poses).select(poses.index_of(observations.pose_id))
    real = corrected_poses(calibration.manipulator, rows)
    centres = np.array([calibration.balls[int(i)] for i in np.asarray(rows.ball_id)])
    b = projection_blocks(calibration.scanner, T_HT=calibration.T_HT, T_MH=real.T_MH, t=centres, alpha=rows.alpha)
    g = b.J_scanner[:, :, SCANNER_COLUMNS.index("d_SD")]
    Cg = np.linalg.solve(observations.covariance, g[:, :, None])[..., 0]
    information = np.einsum("ni,ni->n", g, Cg) + 1 / d_SD_sigma**2
    change = np.einsum("ni,ni->n", Cg, observations.x_D - b.x_D) / information
    return calibration.scanner.d_SD + change, 1 / np.sqrt(information)
