"""Calibration where source and detector move and the ball does not move; d_SD fixed, or one more number a view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tomopose.calibration.checks.conventions.alternatives import ALTERNATIVES_OF_MOVING_SCANNER
from tomopose.calibration.identified.calibrate import calibrate_kinematic, machine_of
from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, projection_blocks
from tomopose.calibration.result import Calibration, ViewDistances
from tomopose.calibration.rigid.contradiction import as_stated
from tomopose.calibration.solve import freed_names
from tomopose.calibration.trusted_poses import rigid_calibration
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.error_models import corrected_poses
from tomopose.manipulator.inverse import InverseManipulator, inverse_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel
from tomopose.observations import BallObservations
from tomopose.units import Array
from tomopose.values import require_types


@require_types
def calibrate_inverse(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    manipulator: ErrorModel | str | Path | Mapping[str, object] | None = None,
    model: str = "auto",
    d_SD_sigma: float = 0.0,
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    free: str | Sequence[str] = "auto",
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    robust: bool = True,
) -> Calibration:
    """Find the scanner's mount on the moved plate and the ball in the base.  Eq. (6) over the inverse chain.

    Parameters
    ----------
    scanner, observations: as in `calibrate`; d_SR is only the origin of W in the scanner's own frame.
    poses:        T_MH of the plate that carries source and detector; the table angle must be 0.
    manipulator, model, distances: as in `calibrate`.
    d_SD_sigma:   mm, standard deviation of d_SD from view to view; 0: source and detector are fixed to one another.
                  The result's `views` then holds the distance of every view.
    free, fix, priors, robust: as in `calibrate`.

    Returns
    -------
    A calibration whose T_HT is the mount (moved plate -> T) and whose ball is given in the base.  Matrices of a scan:
    `projection_matrices(calibration, inverse_poses(scan))`; their points are points of the fixed object.

    Raises
    ------
    As `calibrate`; NotObservableError for what says only where W begins.
    """
    free, auto = freed_names(free)
    _require_determinable(poses, model, d_SD_sigma, free)
    machine = machine_of(manipulator)
    if distances and (model == "rigid" or (model == "auto" and machine is None)):
        raise InputError("distances between balls serve models with the manipulator's errors; give its geometry")
    turned = inverse_poses(poses)
    try:
        found, freed = rigid_calibration(
            scanner,
            turned,
            observations,
            hypotheses=ALTERNATIVES_OF_MOVING_SCANNER,
            arrangement="moving-scanner",
            free=free,
            auto=auto,
            maker=None if machine is None else machine.repeatability,
            fix=fix,
            priors=priors,
            robust=robust,
        )
    except NotConvergedError as error:
        if isinstance(error.calibration, Calibration):
            error.calibration = replace(error.calibration, arrangement="moving-scanner")
        raise
    if found.verdict == "rejected":
        return found
    if machine is not None or d_SD_sigma or model not in ("auto", "rigid"):
        found = calibrate_kinematic(
            scanner,
            turned,
            observations,
            rigid=found,
            manipulator=None if machine is None else InverseManipulator(machine=machine),
            model="rigid" if machine is None and model == "auto" else model,
            free=as_stated(freed, found.contradicted),
            auto=auto,
            distances=distances,
            inverse=True,
            view_sigma={"d_SD": d_SD_sigma} if d_SD_sigma else None,
        )
    if not d_SD_sigma:
        return found
    seen = observations.select(np.isin(observations.pose_id, found.pose_id))
    d_SD, u = view_distances(found, poses, seen, d_SD_sigma=d_SD_sigma)
    views = ViewDistances(sigma=d_SD_sigma, pose_id=tuple(seen.pose_id), d_SD=d_SD, u=u)
    return replace(found, views=views)


def _require_determinable(poses: PoseSequence, model: str, d_SD_sigma: float, free: Sequence[str]) -> None:
    """InputError or NotObservableError for what this arrangement does not have or cannot determine."""
    if np.asarray(poses.alpha).any():
        raise InputError("the arrangement with a fixed object has no rotary table; alpha must be 0 in every pose")
    if not (np.isfinite(d_SD_sigma) and d_SD_sigma >= 0):
        raise InputError(f"d_SD_sigma is {d_SD_sigma}; a standard deviation >= 0 in mm is needed")
    if d_SD_sigma and model == "slack":
        raise InputError(
            "a d_SD that differs from view to view cannot be distinguished from poses that scatter (model slack)"
        )
    for name in free:
        if name == "d_SR" or name.startswith("axis"):
            raise NotObservableError(
                f"{name} says only where W begins on a scanner that moves as a whole; no image depends on it beside "
                "the mount",
                direction=name,
            )


def view_distances(
    calibration: Calibration, poses: PoseSequence, observations: BallObservations, *, d_SD_sigma: float
) -> tuple[Array, Array]:
    """(d_SD, u) of each observed view, mm, (n,): its most probable value given the ball's place in that view.

    The ball moves along the line from the piercing point when d_SD changes, so a ball near it holds no information and
    u stays d_SD_sigma.  poses: as given to `calibrate_inverse`; rows as in `observations`.
    """
    rows = inverse_poses(poses).select(poses.index_of(observations.pose_id))
    real = corrected_poses(calibration.errors, rows)
    centres = np.array([calibration.balls[int(i)] for i in np.asarray(rows.ball_id)])
    b = projection_blocks(calibration.scanner, T_HT=calibration.T_HT, T_MH=real.T_MH, t=centres, alpha=rows.alpha)
    g = b.J_scanner[:, :, SCANNER_COLUMNS.index("d_SD")]
    Cg = np.linalg.solve(observations.covariance, g[:, :, None])[..., 0]
    information = np.einsum("ni,ni->n", g, Cg) + 1 / d_SD_sigma**2
    change = np.einsum("ni,ni->n", Cg, observations.x_D - b.x_D) / information
    return calibration.scanner.d_SD + change, 1 / np.sqrt(information)
