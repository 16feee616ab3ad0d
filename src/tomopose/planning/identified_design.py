"""Poses that determine what a scan needs of the manipulator's errors: the kinematic side of planning.

Of many candidate poses those are taken, one by one, that lower the predicted trajectory error of the scan most:
with Sigma the covariance so far, J and C a candidate's rows and B = J_scan^T J_scan what the scan asks for, a candidate
lowers the sum of variances by tr((C + J Sigma J^T)^-1 J Sigma B Sigma J^T), exactly (I-optimal design, greedy).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.identified.map_estimate import KinematicProblem, State, linearise
from tomopose.calibration.model.ball_projection import projection_blocks, whiteners
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import pair
from tomopose.errors import InputError
from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel
from tomopose.observations import BallObservations
from tomopose.units import Array

VAGUE_MOUNT_RAD, VAGUE_MM = 1.0, 1000.0
"""Prior of mount and balls, which only makes the first steps well posed."""
MARGIN_PX = 20.0


@dataclass(frozen=True, kw_only=True)
class KinematicPlan:
    """poses: the chosen ones, in the candidates' order.  Predicted rms of the scan's error at the object's points, px:
    trusted: if the poses are calibrated and then trusted; identified: if the errors are identified from them;
    but_scale: what is left of it beside the scale of the object; history: `identified` after each chosen pose (n,)."""

    poses: PoseSequence
    trusted: float
    identified: float
    but_scale: float
    history: Array


def plan_kinematic(
    scanner: Scanner,
    machine: ErrorModel,
    *,
    T_HT: RigidTransform,
    balls: ArrayLike,
    candidates: PoseSequence,
    scan: PoseSequence,
    points: ArrayLike,
    n: int,
    sigma_px: float = 0.015,
    margin_px: float = MARGIN_PX,
) -> KinematicPlan:
    """Choose n of the candidate poses (with table angles) for the sake of a scan.

    T_HT, balls (3,) or (nb, 3): rough values suffice.  points (k, 3): of the object in M, mm.  sigma_px: of each
    coordinate of a detected centre.  Candidates whose ball leaves the detector (less margin_px) are passed over.
    Raises InputError where fewer than n candidates are in view.
    """
    centres = np.atleast_2d(np.asarray(balls, dtype=np.float64))
    problem, state = _virtual(scanner, machine, T_HT, centres, candidates, sigma_px)
    at = linearise(problem, state)
    x = problem.data.x_D - at.r
    size = np.array([scanner.n_u, scanner.n_v])
    usable = np.asarray(((x > margin_px) & (x < size - 1 - margin_px)).all(axis=1))
    if usable.sum() < n:
        raise InputError(f"only {usable.sum()} of {len(candidates)} candidates keep the ball in view; {n} are asked")
    J = whiteners(at.C) @ at.J
    J_scan = scan_jacobian(scanner, machine, T_HT, scan, np.asarray(points, dtype=np.float64), len(problem.tangent))
    B = J_scan.T @ J_scan
    count = len(J_scan) / 2
    vague = np.concatenate([np.full(3, VAGUE_MOUNT_RAD), np.full(3 + centres.size, VAGUE_MM)])
    Sigma = np.diag(np.concatenate([vague, machine.sigma]) ** 2)
    chosen: list[int] = []
    history = []
    for _ in range(n):
        JS = J @ Sigma
        V = np.eye(2) + JS @ np.swapaxes(J, 1, 2)
        gain = np.einsum("nij,nji->n", np.linalg.inv(V), JS @ B @ np.swapaxes(JS, 1, 2))
        gain[~usable] = -np.inf
        k = int(np.argmax(gain))
        chosen.append(k)
        usable = usable & (np.arange(len(usable)) != k)
        Sigma = Sigma - JS[k].T @ np.linalg.solve(V[k], JS[k])
        Sigma = (Sigma + Sigma.T) / 2
        history.append(float(np.sqrt(max(np.sum(B * Sigma), 0.0) / count)))
    rows = np.sort(chosen)
    scale = scale_direction(scanner, T_HT, machine, scan, np.asarray(points, dtype=np.float64))
    along: Array = scale @ J_scan
    return KinematicPlan(
        poses=candidates.select(rows),
        trusted=trusted_error(J[rows], J_scan, machine.sigma),
        identified=history[-1],
        but_scale=float(np.sqrt(max(history[-1] ** 2 - float(along @ Sigma @ along) / count, 0.0))),
        history=np.array(history),
    )


def trusted_error(J: Array, J_scan: Array, sigma: Array) -> float:
    """Predicted rms, px, of a scan's error where the machine has errors of size sigma and the poses are trusted.

    J (n, 2, m) whitened rows of the calibration, J_scan (rows, m); the last columns belong to the errors.
    """
    A = J.reshape(-1, J.shape[2])
    k = A.shape[1] - len(sigma)
    taken_up = np.linalg.lstsq(A[:, :k], A[:, k:], rcond=None)[0]
    left = (J_scan[:, k:] - J_scan[:, :k] @ taken_up) * sigma
    return float(np.sqrt(np.sum(left**2) / (len(J_scan) / 2)))


def scan_jacobian(
    scanner: Scanner, machine: ErrorModel, T_HT: RigidTransform, scan: PoseSequence, points: Array, m: int
) -> Array:
    """(rows, m): how the scan's pixels answer to (w_HT, t_HT, balls, errors), the object's rigid pose removed.

    The machine is at zero errors; m is the number of unknowns, errors last.
    """
    real = machine.real_poses(scan, np.zeros(len(machine.names)))
    J = np.zeros((len(points), len(scan), 2, m))
    for i, x_M in enumerate(points):
        b = projection_blocks(scanner, T_HT=T_HT, T_MH=real.T_MH, t=x_M, alpha=scan.alpha)
        J_pose = np.concatenate([-b.G_H @ skew(b.x_H - real.t), b.G_H], axis=2)
        J[i, :, :, :6] = b.J_mount
        J[i, :, :, m - len(machine.names) :] = J_pose @ real.J
    Q = _object_moves(scanner, T_HT, machine, scan, points)[:, :6]
    flat = J.reshape(-1, m)
    return np.asarray(flat - Q @ (Q.T @ flat))


def scale_direction(
    scanner: Scanner, T_HT: RigidTransform, machine: ErrorModel, scan: PoseSequence, points: Array
) -> Array:
    """(rows,) unit vector: how the scan's pixels answer to the scale of the object, its rigid pose removed."""
    return _object_moves(scanner, T_HT, machine, scan, points)[:, 6]


def _object_moves(
    scanner: Scanner, T_HT: RigidTransform, machine: ErrorModel, scan: PoseSequence, points: Array
) -> Array:
    """(rows, 7) orthonormal: the pixels' answers to the rigid pose (6) and then to the scale of the object."""
    real = machine.real_poses(scan, np.zeros(len(machine.names)))
    parts = []
    for x_M in points:
        b = projection_blocks(scanner, T_HT=T_HT, T_MH=real.T_MH, t=x_M, alpha=scan.alpha)
        grow = b.J_t @ (x_M - points.mean(axis=0))[:, None]
        parts.append(np.concatenate([-b.J_t @ skew(x_M), b.J_t, grow], axis=2))
    G = np.stack(parts).reshape(-1, 7)
    Q, _ = np.linalg.qr(G / np.linalg.norm(G, axis=0))
    return np.asarray(Q)


def _virtual(
    scanner: Scanner, machine: ErrorModel, T_HT: RigidTransform, balls: Array, poses: PoseSequence, sigma_px: float
) -> tuple[KinematicProblem, State]:
    """The problem that the candidates would pose, with arbitrary centres."""
    ids = np.unique(poses.ball_id)
    if len(ids) != len(balls):
        raise InputError(f"the candidates name {len(ids)} balls, but {len(balls)} centres are given")
    observations = BallObservations.from_sigma(np.zeros((len(poses), 2)), sigma_px, pose_id=poses.pose_id)
    data = pair(replace(scanner, sigma={}), poses, observations)
    problem = KinematicProblem(
        data=data, poses=poses, free=free_parameters(data.scanners), model=machine, repeatability=machine.repeatability
    )
    return problem, State(T_HT=T_HT, balls=balls, delta=np.zeros(0), p=np.zeros(len(machine.names)))
