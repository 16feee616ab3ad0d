"""Calibration of twin robots: source and detector each on a robot of its own, the ball stands still."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.calibration.kinematic_fit import ModelFit, fit_model
from tomopose.calibration.kinematic_result import calibration_of
from tomopose.calibration.kinematic_solve import KinematicProblem, State, linearise
from tomopose.calibration.model_choice import better, judge
from tomopose.calibration.parameters import free_parameters
from tomopose.calibration.problem import pair
from tomopose.calibration.propagate import field_of_view_points
from tomopose.calibration.result import Calibration
from tomopose.calibration.twin_projection import twin_view_matrices
from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import machine_from_block
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.twin import TwinRobots, twin_from_document
from tomopose.observations import BallObservations
from tomopose.units import Array

MODELS = ("auto", "rigid", "kinematic")


def calibrate_twin(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    twin: TwinRobots,
    mount: RigidTransform,
    balls: Mapping[int, Any],
    model: str = "auto",
    robust: bool = True,
) -> Calibration:
    """Find the detector's mount, the balls, how the bases stand to each other, the focal spot, and the robots' errors.

    Parameters
    ----------
    scanner:      the panel and a nominal focal spot before it: d_SD, u_0, v_0; d_SR is only the origin of W.
    poses:        T_MH of the detector's flange in its base; table angles must be 0.
    observations: as in `calibrate`.
    twin:         both robots, with the poses of the source's.
    mount:        H (detector's flange) -> T, and balls: ball_id -> (3,) mm in the detector robot's base: starts, from
                  the drawing.
    model:        "rigid": both robots are trusted and only the setup is unknown; "kinematic": their errors too; "auto":
                  what evidence and held-out poses say.

    Returns a calibration whose ball stands in the detector robot's base, M; matrices by `twin_matrices`.
    Raises InputError, NotConvergedError as `calibrate`.
    """
    if model not in MODELS:
        raise InputError(f"unknown model {model!r}; known are {', '.join(MODELS)}")
    if np.asarray(poses.alpha).any():
        raise InputError("the arrangement with a standing object has no rotary table; alpha must be 0 in every pose")
    turned = inverse_poses(poses)
    data = pair(scanner, turned, observations)
    missing = [i for i in data.ball_ids if i not in balls]
    if missing:
        raise InputError(f"a start is needed for every ball; ball {missing[0]} has none")
    rows = turned.select(data.index)
    fits: dict[str, ModelFit] = {}
    start = State(
        T_HT=mount.require(Frame.H, Frame.T), balls=np.array([np.asarray(balls[i], float) for i in data.ball_ids]),
        delta=np.zeros(0), p=np.zeros(0),
    )
    for name, machines in (("rigid", twin.trusted()), ("kinematic", twin)):
        if name == "kinematic" and model == "rigid":
            continue
        setup = start.p if len(start.p) else np.zeros(9)
        errors = np.zeros(len(machines.names) - len(setup))
        problem = KinematicProblem(
            data=data, poses=rows, free=free_parameters((scanner,), fix=tuple(scanner.sigma)), model=machines,
            repeatability=machines.repeatability,
        )
        begin = State(T_HT=start.T_HT, balls=start.balls, delta=start.delta, p=np.concatenate([errors, setup]))
        fits[name] = fit_model(problem, begin, robust=robust and name == "kinematic")
        start = fits[name].estimate.state
    judged = {name: judge(name, fit) for name, fit in fits.items()}
    chosen = model
    if model == "auto":
        chosen = "kinematic" if better(judged["kinematic"], judged["rigid"]) else "rigid"
    return calibration_of(None, fits, judged, chosen, model, data.pose_id, ())


def _twin_of(calibration: Calibration, source_poses: PoseSequence) -> tuple[TwinRobots, Array]:
    block = calibration.manipulator
    if block.get("kind") != "twin":
        raise InputError("this calibration is not one of twin robots; use projection_matrices")
    twin = twin_from_document(block["nominal"], source_poses, machine_from_block, "calibration: manipulator")
    return twin, np.asarray(block["values"], dtype=np.float64)


def twin_matrices(
    calibration: Calibration, poses: PoseSequence, source_poses: PoseSequence, *, points: Any = None
) -> ProjectionMatrices:
    """The matrices of a scan by twin robots: points of W, as it stands in the first view, to pixels.

    poses, source_poses: flanges of detector and source in their own bases, paired by pose_id.  points (m, 3) of W where
    `points_sigma` is predicted, the object's rigid pose removed; by default the field of view of the first view.
    """
    twin, p = _twin_of(calibration, source_poses)
    turned = inverse_poses(poses)
    scanner = calibration.scanner
    real = twin.real_poses(turned, p)
    home = scanner.T_TW(0.0) @ calibration.T_HT @ real.T_MH[0]
    P = twin_view_matrices(scanner, twin, T_HT=calibration.T_HT, poses=turned, p=p)
    x_W = field_of_view_points(scanner) if points is None else np.asarray(points, dtype=np.float64)
    sigma, shared = _sigma(calibration, twin, p, turned, home.inv.apply(x_W))
    return ProjectionMatrices(
        P=P @ home.inv.matrix, n_u=scanner.n_u, n_v=scanner.n_v, p_u=scanner.p_u, p_v=scanner.p_v,
        pose_id=poses.pose_id, points_sigma=sigma, points_sigma_shared=shared,
        in_front=home.apply(np.mean(list(calibration.balls.values()), axis=0)),
    )


def view_geometry(
    calibration: Calibration, poses: PoseSequence, source_poses: PoseSequence
) -> tuple[Array, Array, Array]:
    """(d_SD (n,) mm, u_0 (n,) px, v_0 (n,) px): where the focal spot stands before the panel in each view."""
    twin, p = _twin_of(calibration, source_poses)
    P = twin_view_matrices(calibration.scanner, twin, T_HT=calibration.T_HT, poses=inverse_poses(poses), p=p)
    own = ProjectionMatrices(
        P=P, n_u=calibration.scanner.n_u, n_v=calibration.scanner.n_v, p_u=calibration.scanner.p_u,
        p_v=calibration.scanner.p_v, pose_id=poses.pose_id, in_front=calibration.t,
    ).decompose()
    return own.d_SD, own.u_0, own.v_0


def _sigma(
    calibration: Calibration, twin: TwinRobots, p: Array, poses: PoseSequence, x_M: Array
) -> tuple[Array, Array]:
    """(n, m) px each: standard uncertainty of points x_M (m, 3) in the single view, and the part that views share."""
    J, J_t, C = [], [], []
    k = 6 + 3 * len(calibration.balls)
    keep = np.r_[0:6, k : len(calibration.tangent)]
    none = BallObservations.from_sigma(np.zeros((len(poses), 2)), 1e-6, pose_id=poses.pose_id)
    scanner = calibration.scanner
    data = pair(scanner, poses, none)
    problem = KinematicProblem(
        data=data, poses=poses, free=free_parameters((scanner,), fix=tuple(scanner.sigma)), model=twin,
        repeatability=twin.repeatability,
    )
    for x in x_M:
        state = State(T_HT=calibration.T_HT, balls=np.tile(x, (len(data.ball_ids), 1)), delta=np.zeros(0), p=p)
        at = linearise(problem, state)
        own = 6 + 3 * len(data.ball_ids)
        J.append(np.concatenate([at.J[:, :, :6], at.J[:, :, own:]], axis=2))
        by_point = at.J[:, :, 6:own].reshape(len(poses), 2, -1, 3).sum(axis=2)
        J_t.append(np.concatenate([-by_point @ skew(x - x_M.mean(axis=0)), by_point], axis=2))
        C.append(np.einsum("nii->ni", at.C))
    flat, moves = np.stack(J).reshape(-1, len(keep)), np.stack(J_t).reshape(-1, 6)
    Q, _ = np.linalg.qr(moves / np.linalg.norm(moves, axis=0))
    flat = flat - Q @ (Q.T @ flat)
    shared = np.einsum("ra,ab,rb->r", flat, calibration.covariance[np.ix_(keep, keep)], flat)
    shared = shared.reshape(len(x_M), len(poses), 2).mean(axis=2).T
    return np.sqrt(np.maximum(shared + np.stack(C).mean(axis=2).T, 0.0)), np.sqrt(np.maximum(shared, 0.0))
