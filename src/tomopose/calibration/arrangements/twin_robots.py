"""Calibration of twin robots: source and detector each on a robot of its own, the ball does not move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.identified.calibrate import known_bars
from tomopose.calibration.identified.fit import ModelFit, fit_model
from tomopose.calibration.identified.map_estimate import KinematicProblem, State, linearise
from tomopose.calibration.identified.model_selection import better, judged
from tomopose.calibration.identified.result import calibration_of
from tomopose.calibration.identified.scale_bars import require_balls_not_swapped
from tomopose.calibration.identified.scatter import with_posterior_scatter
from tomopose.calibration.model.assumed import Assumed, assumed_for, scatter_assumed, with_assumed
from tomopose.calibration.model.parameters import MATTERS, UNITS, FreeParameters, free_parameters, unit_of
from tomopose.calibration.model.problem import pair
from tomopose.calibration.model.twin_projection import balls_from_rays, twin_view_matrices
from tomopose.calibration.projection_matrices import require_same_scanner
from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import freed_names
from tomopose.calibration.uncertainty.propagation import field_of_view_points
from tomopose.errors import InputError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import TwinErrors, outside_notes
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.twin import TwinRobots
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.units import Array
from tomopose.values import require_types

MODELS = ("auto", "rigid", "kinematic")
PANEL = ("p_u", "p_v", "pitch_ratio")
"""Scanner parameters that twin robots can determine."""


def panel_parameters(
    scanner: Scanner, *, free: Sequence[str] = (), fix: Sequence[str] = (), priors: Mapping[str, float] | None = None
) -> FreeParameters:
    """The freed parameters, which may be the pixel pitches alone.

    Standard deviations that scanner.json gives others are without effect: d_SD, u_0 and v_0 only name a focal spot
    before the panel, from which the true one deviates, and a turn of the panel is one of its mount.
    Raises NotObservableError for a parameter that no image depends on beside the mount.
    """
    for name in (*free, *(priors or {})):
        if name not in UNITS or name in PANEL:
            continue
        if name == "translation_scale":
            why = "has no meaning for two robots; the tolerances of their links are in their files"
        elif name == "d_SR" or name.startswith("axis"):
            why = "says only where W begins, and no image depends on it"
        else:
            why = "is taken up exactly by the mount of the panel on its flange"
        raise NotObservableError(f"twin robots: {name} {why}; it cannot be freed", direction=name)
    held = [n for n in scanner.sigma if n not in PANEL]
    return free_parameters((scanner,), free=free, fix=(*fix, *held), priors=priors)


@require_types
def calibrate_twin(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    twin: TwinRobots,
    mount: RigidTransform,
    balls: Mapping[int, ArrayLike] | None = None,
    model: str = "auto",
    free: str | Sequence[str] = "auto",
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    robust: bool = True,
) -> Calibration:
    """Find the detector's mount, the balls, the pose of the bases relative to each other, the focal spot, and the
    robots' errors.

    Parameters
    ----------
    scanner:      the panel and a nominal focal spot before it: d_SD, u_0, v_0; d_SR is only the origin of W.
    poses:        T_MH of the detector's flange in its base; table angles must be 0.
    observations: as in `calibrate`.
    twin:         both robots, with the poses of the source's.
    mount:        H (detector's flange) -> T: start, from the drawing.
    balls:        ball_id -> (3,) mm in the detector robot's base: starts; None: where the rays meet best.
    model:        "rigid": both robots are trusted and only the setup is unknown; "kinematic": their errors too; "auto":
                  what evidence and held-out poses say.
    free, fix, priors, distances: as in `calibrate`; only p_u, p_v and pitch_ratio can be freed.

    Returns a calibration whose ball is in the detector robot's base, M; matrices by `twin_matrices`.
    Raises InputError, NotConvergedError as `calibrate`; NotObservableError for a freed parameter that cannot be
    determined.
    """
    if model not in MODELS:
        raise InputError(f"unknown model {model!r}; known are {', '.join(MODELS)}")
    free, auto = freed_names(free)
    trusted, start, assumed = trusted_problem(
        scanner, poses, observations, twin=twin, mount=mount, balls=balls, free=free, fix=fix, priors=priors
    )
    trusted = replace(trusted, bars=known_bars(distances, trusted.data))
    data = trusted.data
    fits: dict[str, ModelFit] = {}
    for name, machines in (("rigid", twin.trusted()), ("kinematic", twin)):
        if name == "kinematic" and model == "rigid":
            continue
        problem = replace(trusted, model=machines, repeatability=machines.repeatability)
        begin = replace(start, p=np.concatenate([np.zeros(len(machines.names) - 9), start.p]))
        fits[name] = fit_model(problem, begin, robust=robust and name == "kinematic", widen=auto)
        start = fits[name].estimate.state
    found = {name: judged(name, fit) for name, fit in fits.items()}
    chosen = model
    if model == "auto":
        chosen = "kinematic" if better(found["kinematic"], found["rigid"]) else "rigid"
    fit = max(fits.values(), key=lambda f: f.estimate.log_evidence)
    require_balls_not_swapped(fit, fit.estimate.problem if fit.keep.all() else problem)
    _require_panel_known(fits[chosen])
    fits[chosen] = with_posterior_scatter(fits[chosen])
    return calibration_of(
        fits,
        found,
        chosen,
        asked=model,
        everything=data,
        arrangement="twin",
        magnification_at_ball=_magnification_at_balls(fits[chosen]),
        view_matrices=_view_matrices(fits[chosen]),
        assumed=(*assumed, *scatter_assumed(twin.repeatability.t_mm, twin.repeatability.w_rad, "option")),
        source_poses=twin.source_poses.select(twin.source_poses.index_of(data.pose_id)),
        provenance=provenance(arguments={"model": model}),
    )


def trusted_problem(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    twin: TwinRobots,
    mount: RigidTransform,
    balls: Mapping[int, ArrayLike] | None = None,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
) -> tuple[KinematicProblem, State, tuple[Assumed, ...]]:
    """(problem with both robots trusted, its start, what was assumed of the scanner); arguments as `calibrate_twin`."""
    if np.asarray(poses.alpha).any():
        raise InputError("the arrangement with a fixed object has no rotary table; alpha must be 0 in every pose")
    others = [name for name in PARAMETER_UNITS if name not in PANEL]
    assumed = assumed_for(scanner, free=free, fix=fix, priors=dict(priors or {}), no_effect=others)
    freed = panel_parameters(with_assumed(scanner, assumed), free=free, fix=fix, priors=priors)
    turned = inverse_poses(poses)
    data = pair(scanner, turned, observations)
    _require_both_tables(data.pose_id, twin.source_poses)
    rows = turned.select(data.index)
    T_HT = mount.require(Frame.H, Frame.T)
    trusted = twin.trusted()
    if balls is None:
        P = twin_view_matrices(scanner, trusted, T_HT=T_HT, poses=rows, p=np.zeros(len(trusted.names)))
        places = balls_from_rays(P, data.x_D, data.ball, len(data.ball_ids))
    else:
        missing = [i for i in data.ball_ids if i not in balls]
        if missing:
            raise InputError(f"a start is needed for every ball; ball {missing[0]} has none")
        places = np.array([np.asarray(balls[i], float) for i in data.ball_ids])
    problem = KinematicProblem(data=data, poses=rows, free=freed, model=trusted, repeatability=trusted.repeatability)
    start = State(T_HT=T_HT, balls=places, delta=np.zeros(len(freed)), p=np.zeros(len(trusted.names)))
    return problem, start, assumed


def _view_matrices(fit: ModelFit) -> Array:
    """(n, 3, 4): from the balls' frame to pixels, of the views used."""
    e = fit.estimate
    twin = e.problem.model
    if not isinstance(twin, TwinRobots):
        raise TypeError(f"a fit of twin robots is needed; its model is {type(twin).__name__}")
    return twin_view_matrices(e.problem.data.scanner, twin, T_HT=e.state.T_HT, poses=e.problem.poses, p=e.state.p)


def _magnification_at_balls(fit: ModelFit) -> float:
    """Mean over the views of d_SD over the ball's distance from the focal spot, along the panel's normal."""
    e = fit.estimate
    data, scanner = e.problem.data, e.problem.data.scanner
    own = ProjectionMatrices(
        P=_view_matrices(fit),
        n_u=scanner.n_u,
        n_v=scanner.n_v,
        p_u=scanner.p_u,
        p_v=scanner.p_v,
        pose_id=data.pose_id,
        in_front=e.state.balls.mean(axis=0),
    )
    x = e.state.balls[data.ball]
    depth = np.einsum("nj,nj->n", own.P[:, 2, :3], x) + own.P[:, 2, 3]
    return float(np.mean(own.decompose().d_SD / depth))


def _require_both_tables(pose_id: Sequence[str], source_poses: PoseSequence) -> None:
    known = set(source_poses.pose_id)
    missing = [i for i in pose_id if i not in known]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(pose_id)} views have no row in the source robot's table, the first is "
            f"{missing[0]!r}; that table holds {len(known)} poses, and rows of the two pair by pose_id"
        )


def _require_panel_known(fit: ModelFit) -> None:
    """NotObservableError where a freed pitch stays less certain than what matters to a scan."""
    e = fit.estimate
    u = np.sqrt(np.diag(e.covariance))[6 + e.state.balls.size :]
    for name, sigma, own in zip(e.problem.free.names, e.problem.free.sigma, u, strict=False):
        if np.isinf(sigma) and own > MATTERS[name]:
            raise NotObservableError(
                f"twin robots: these poses determine {name} only to {own:.2g} {unit_of(name)}, worse than the "
                f"{MATTERS[name]:g} that matter; hold it, or give it a prior standard deviation in scanner.json",
                direction=name,
            )


def _twin_of(calibration: Calibration, source_poses: PoseSequence) -> tuple[TwinRobots, Array]:
    if not isinstance(calibration.errors, TwinErrors):
        raise InputError("this calibration is not one of twin robots; use projection_matrices")
    return calibration.errors.robots(source_poses), calibration.errors.values


@require_types
def twin_matrices(
    calibration: Calibration,
    poses: PoseSequence,
    source_poses: PoseSequence,
    *,
    points: ArrayLike | None = None,
    binning: int = 1,
    scanner: Scanner | None = None,
) -> ProjectionMatrices:
    """The matrices of a scan by twin robots: points of W, as it is in the first view, to pixels.

    poses, source_poses: flanges of detector and source in their own bases, paired by pose_id.  points (m, 3) of W where
    `points_sigma` is predicted, the object's rigid pose removed; by default the field of view of the first view.
    binning, scanner: as of `projection_matrices`.
    """
    if np.asarray(poses.alpha).any():
        raise InputError("the arrangement with a fixed object has no rotary table; alpha must be 0 in every pose")
    if scanner is not None:
        require_same_scanner(calibration, scanner)
    _require_both_tables(poses.pose_id, source_poses)
    twin, p = _twin_of(calibration, source_poses)
    turned = inverse_poses(poses)
    own = calibration.scanner
    real = twin.real_poses(turned, p)
    home = own.T_TW(0.0) @ calibration.T_HT @ real.T_MH[0]
    P = twin_view_matrices(own, twin, T_HT=calibration.T_HT, poses=turned, p=p)
    x_W = field_of_view_points(own) if points is None else np.asarray(points, dtype=np.float64)
    sigma, shared = _sigma(calibration, twin, p, turned, home.inv.apply(x_W))
    matrices = ProjectionMatrices(
        P=P @ home.inv.matrix,
        n_u=own.n_u,
        n_v=own.n_v,
        p_u=own.p_u,
        p_v=own.p_v,
        pose_id=poses.pose_id,
        points_sigma=sigma,
        points_sigma_shared=shared,
        in_front=home.apply(np.mean(list(calibration.balls.values()), axis=0)),
    )
    return matrices if binning == 1 else matrices.binned(binning)


def twin_notes(calibration: Calibration, poses: PoseSequence, source_poses: PoseSequence) -> tuple[str, ...]:
    """Sentences on poses of a scan that lie outside the calibrated range of either robot."""
    errors, turned = calibration.errors, inverse_poses(poses)
    if not isinstance(errors, TwinErrors):
        raise InputError("this calibration is not one of twin robots; it has one pose table")
    return (
        *outside_notes(errors.range.outside(turned), poses, "the detector robot's"),
        *outside_notes(errors.source_range.outside(source_poses), source_poses, "the source robot's"),
    )


def view_geometry(
    calibration: Calibration, poses: PoseSequence, source_poses: PoseSequence
) -> tuple[Array, Array, Array]:
    """(d_SD (n,) mm, u_0 (n,) px, v_0 (n,) px): where the focal spot is relative to the panel in each view."""
    twin, p = _twin_of(calibration, source_poses)
    P = twin_view_matrices(calibration.scanner, twin, T_HT=calibration.T_HT, poses=inverse_poses(poses), p=p)
    own = ProjectionMatrices(
        P=P,
        n_u=calibration.scanner.n_u,
        n_v=calibration.scanner.n_v,
        p_u=calibration.scanner.p_u,
        p_v=calibration.scanner.p_v,
        pose_id=poses.pose_id,
        in_front=calibration.t,
    ).decompose()
    return own.d_SD, own.u_0, own.v_0


def _sigma(
    calibration: Calibration, twin: TwinRobots, p: Array, poses: PoseSequence, x_M: Array
) -> tuple[Array, Array]:
    """(n, m) px each: standard uncertainty of points x_M (m, 3) in the single view, and the part that views share."""
    J, J_t, C = [], [], []
    names = [n for n in calibration.tangent if n in PANEL]
    k = 6 + 3 * len(calibration.balls)
    keep = np.r_[0:6, k : len(calibration.tangent)]
    none = BallObservations.from_sigma(np.zeros((len(poses), 2)), 1e-6, pose_id=poses.pose_id)
    scanner = calibration.scanner
    data = pair(scanner, poses, none)
    problem = KinematicProblem(
        data=data,
        poses=poses,
        free=panel_parameters(scanner, free=names),
        model=twin,
        repeatability=twin.repeatability,
    )
    for x in x_M:
        state = State(T_HT=calibration.T_HT, balls=np.tile(x, (len(data.ball_ids), 1)), delta=np.zeros(len(names)), p=p)
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
