r"""Maximum a posteriori estimate of mount, balls, scanner and manipulator errors together.

For pose k the model predicts x_D,k(theta) with theta = (T_HT, t of each ball, freed scanner parameters, manipulator
errors p).  Minimised is

    sum_k r_k^T C_k^-1 r_k  +  sum_i p_i^2 / sigma_i^2  +  sum_bars (|t_a - t_b| - L)^2 / u_L^2

with C_k the covariance of the observation plus that of the plate's scatter seen through the projection,
C_k = C_obs,k + f J_pose diag(repeatability) J_pose^T.  The priors sigma_i make the problem well posed: shifts and
turns of all base joints (or all platform joints) together cannot be distinguished from T_HT (or t), and stay where the
prior puts them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from tomopose.calibration.model.ball_projection import (
    SCANNER_COLUMNS,
    ProjectionBlocks,
    projection_blocks,
    whiteners,
)
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import (
    FreeParameters,
    ImpossibleScannerError,
    adjusted_scanners,
    translation_scale,
)
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.twin_projection import twin_blocks
from tomopose.calibration.rigid.fit import tangent_names
from tomopose.errors import NotConvergedError, TrajectoryError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.geometry.transforms import RigidTransform
from tomopose.least_squares import Status, least_squares, promised
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, Repeatability
from tomopose.manipulator.twin import TwinRobots
from tomopose.units import Array

STEPS = 150
"""Trials at the most; three gross errors among 189 poses of a hexapod take 70 of them."""
STEP_TOLERANCE, VALLEY_TOLERANCE = 1e-4, 1e-4
"""A step that moves the residuals by less than the first, rms in standard deviations, ends it; where a valley
is flat, a promised gain in chi2 below the second for each equation is enough (0.2 standard deviations at most)."""
EXACT = 1e-10
"""mm and rad: standard deviation of a mount that is known by definition."""


@dataclass(frozen=True, kw_only=True)
class KinematicProblem:
    """What was measured, and what may be wrong.

    data:        observed centres, paired with poses.  poses: the commanded poses of its rows (T_MH, alpha, q).
    model:       error model of the manipulator, or None for a machine without errors.
    free:        freed scanner parameters with their priors.
    bars:        (ball id, ball id) -> (distance, its standard uncertainty), mm.
    view_sigma:  scanner parameter -> standard deviation of its scatter from view to view (a C-arm's d_SD, say).
    repeatability, scatter:  of the plate from pose to pose, and the factor f on its variance.
    inverse:     the table holds inverse poses: the plate is H, and turns about the origin of H.
    weight:      (n,) factor on the inverse covariances of the rows, or None.
    mount_known: T_HT stays where it starts, by definition.
    """

    data: Problem
    poses: PoseSequence
    free: FreeParameters
    model: ErrorModel | None = None
    bars: Mapping[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    view_sigma: Mapping[str, float] = field(default_factory=dict)
    repeatability: Repeatability = field(default_factory=Repeatability)
    scatter: float = 1.0
    inverse: bool = False
    weight: Array | None = None
    mount_known: bool = False

    @property
    def tangent(self) -> tuple[str, ...]:
        """Names of the coordinates of theta, in order, as `Calibration.tangent` has them."""
        return (*tangent_names(self.data.ball_ids, self.free), *(() if self.model is None else self.model.names))

    @property
    def prior_sigma(self) -> Array:
        """Prior standard deviation of each coordinate of theta; inf where there is no limit."""
        flat = np.full(6 + 3 * len(self.data.ball_ids), np.inf)
        flat[:6] = EXACT if self.mount_known else np.inf
        return np.concatenate([flat, self.free.sigma, np.zeros(0) if self.model is None else self.model.sigma])

    def rows(self, index: Any) -> KinematicProblem:
        """The same problem with those rows only; every ball must keep a row."""
        weight = None if self.weight is None else self.weight[index]
        return replace(self, data=self.data.select(index), poses=self.poses.select(index), weight=weight)


@dataclass(frozen=True, kw_only=True)
class State:
    """A point theta: mount, balls (nb, 3), deviations delta (f,) of the freed parameters, manipulator errors p (m,)."""

    T_HT: RigidTransform
    balls: Array
    delta: Array
    p: Array

    def moved(self, step: Array) -> State:
        cut = np.cumsum([3, 3, self.balls.size, self.delta.size])
        w, t, balls, delta, p = np.split(step, cut)
        R = exp_rotation(w) @ self.T_HT.R
        return State(
            T_HT=RigidTransform(R=R, t=self.T_HT.t + t, source=Frame.H, target=Frame.T),
            balls=self.balls + balls.reshape(-1, 3),
            delta=self.delta + delta,
            p=self.p + p,
        )


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """Residuals r (n, 2) observed minus calculated, px; J (n, 2, m) of the prediction; C (n, 2, 2) px^2, with scatter;
    J_pose (n, 2, 6) by the plate's own motion (w, t), which scatters."""

    r: Array
    J: Array
    C: Array
    J_pose: Array


@dataclass(frozen=True, kw_only=True)
class MapEstimate:
    """The optimum: state, linearisation there, covariance (m, m), chi2 with priors, dof = equations - parameters
    (+ priors), log_evidence (Laplace; comparable between models of the same observations)."""

    problem: KinematicProblem
    state: State
    at: Linearised
    covariance: Array
    chi2: float
    dof: int
    log_evidence: float


def linearise(problem: KinematicProblem, state: State) -> Linearised:
    """The prediction and its derivatives at theta."""
    if isinstance(problem.model, TwinRobots):
        return _linearise_twin(problem, problem.model, state)
    data, poses, free = problem.data, problem.poses, problem.free
    n, nb = len(poses), len(data.ball_ids)
    T_MH, J_errors = _executed(problem, state)
    scale = translation_scale(free, state.delta)
    blocks = _blocks(problem, state, T_MH)
    J_pose = np.concatenate([-blocks.G_H @ skew(blocks.x_H - scale * T_MH.t), scale * blocks.G_H], axis=2)
    J_balls = np.zeros((n, 2, nb, 3))
    J_balls[np.arange(n), :, data.ball] = blocks.J_t
    mine = (free.col_run[None, :] < 0) | (free.col_run[None, :] == data.run[:, None])
    J_free = blocks.J_scanner[:, :, free.cols] * free.factor * mine[:, None, :]
    J = np.concatenate([blocks.J_mount, J_balls.reshape(n, 2, 3 * nb), J_free, J_pose @ J_errors], axis=2)
    J_plate = J_pose
    if problem.inverse:
        J_plate = np.concatenate([-blocks.G_H @ skew(blocks.x_H), blocks.G_H], axis=2)
    C = data.covariance + problem.scatter * (J_plate * problem.repeatability.variance) @ np.swapaxes(J_plate, 1, 2)
    for name, sigma in problem.view_sigma.items():
        g = blocks.J_scanner[:, :, SCANNER_COLUMNS.index(name)] * sigma
        C = C + g[:, :, None] * g[:, None, :]
    if problem.weight is not None:
        C = C / problem.weight[:, None, None]
    return Linearised(r=data.x_D - blocks.x_D, J=J, C=C, J_pose=J_plate)


def _executed(problem: KinematicProblem, state: State) -> tuple[RigidTransform, Array]:
    """(T_MH of the real plate, its derivative (n, 6, m) by the manipulator's errors)."""
    if problem.model is None:
        return problem.poses.T_MH, np.zeros((len(problem.poses), 6, 0))
    real = problem.model.real_poses(problem.poses, state.p)
    return real.T_MH, real.J


def _blocks(problem: KinematicProblem, state: State, T_MH: RigidTransform) -> ProjectionBlocks:
    data, free = problem.data, problem.free
    return projection_blocks(
        adjusted_scanners(data.scanners, free, state.delta),
        T_HT=state.T_HT,
        T_MH=T_MH,
        t=state.balls[data.ball],
        alpha=data.alpha,
        translation_scale=translation_scale(free, state.delta),
        run=data.run,
    )


def blocks_of(problem: KinematicProblem, state: State) -> ProjectionBlocks:
    """Projected centres and derivatives at theta, as the tests of single effects look at them.

    Of twin robots x_H and G_H are those of the panel's flange, with which the focal spot does not move.
    """
    twin = problem.model
    if not isinstance(twin, TwinRobots):
        return _blocks(problem, state, _executed(problem, state)[0])
    (scanner,) = adjusted_scanners(problem.data.scanners, problem.free, state.delta)
    t = state.balls[problem.data.ball]
    b = twin_blocks(scanner, twin, T_HT=state.T_HT, poses=problem.poses, p=state.p, t=t)
    real = twin.real_poses(problem.poses, state.p)
    return ProjectionBlocks(
        x_D=b.x_D,
        J_w_HT=b.J_mount[:, :, :3],
        J_t_HT=b.J_mount[:, :, 3:],
        J_t=b.J_t,
        J_scanner=b.J_scanner,
        x_H=np.einsum("nij,nj->ni", real.R, t) + real.t,
        t=t,
        R_MH=real.R,
        G_H=b.J_plate[:, :, 3:],
    )


def _linearise_twin(problem: KinematicProblem, twin: TwinRobots, state: State) -> Linearised:
    """The same for twin robots, whose source moves against the panel; of the scanner only the pitches may be free."""
    data, free = problem.data, problem.free
    n, nb = len(problem.poses), len(data.ball_ids)
    (scanner,) = adjusted_scanners(data.scanners, free, state.delta)
    b = twin_blocks(scanner, twin, T_HT=state.T_HT, poses=problem.poses, p=state.p, t=state.balls[data.ball])
    J_balls = np.zeros((n, 2, nb, 3))
    J_balls[np.arange(n), :, data.ball] = b.J_t
    scatter = (b.J_plate * problem.repeatability.variance) @ np.swapaxes(b.J_plate, 1, 2) + b.C_source
    C = data.covariance + problem.scatter * scatter
    if problem.weight is not None:
        C = C / problem.weight[:, None, None]
    J_free = b.J_scanner[:, :, free.cols] * free.factor
    J = np.concatenate([b.J_mount, J_balls.reshape(n, 2, 3 * nb), J_free, b.J_p], axis=2)
    return Linearised(r=data.x_D - b.x_D, J=J, C=C, J_pose=b.J_plate)


def _bar_rows(problem: KinematicProblem, state: State) -> tuple[Array, Array]:
    """Weighted residuals (nbar,) and rows (nbar, m) of the known distances between balls."""
    ids = problem.data.ball_ids
    r, rows = [], []
    for (a, b), (length, u) in problem.bars.items():
        i, j = ids.index(a), ids.index(b)
        d = state.balls[i] - state.balls[j]
        distance = float(np.linalg.norm(d))
        row = np.zeros(len(problem.tangent))
        row[6 + 3 * i : 9 + 3 * i], row[6 + 3 * j : 9 + 3 * j] = d / distance / u, -d / distance / u
        rows.append(row)
        r.append((length - distance) / u)
    return np.array(r), np.reshape(rows, (len(r), len(problem.tangent)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Point:
    """A state, its linearisation (r not finite where no machine or scanner has such errors), the whiteners in use."""

    state: State
    at: Linearised
    W: Array


def _weighted(problem: KinematicProblem, state: State, at: Linearised, W: Array) -> tuple[Array, Array]:
    """All residuals and rows in standard deviations: observations whitened by W (n, 2, 2), bars, priors."""
    m = at.J.shape[2]
    r_bar, J_bar = _bar_rows(problem, state)
    sigma = problem.prior_sigma
    held = np.flatnonzero(np.isfinite(sigma))
    value = np.concatenate([np.zeros(6 + state.balls.size), state.delta, state.p])
    J_prior = np.zeros((len(held), m))
    J_prior[np.arange(len(held)), held] = 1 / sigma[held]
    r = np.concatenate([(W @ at.r[:, :, None])[..., 0].ravel(), r_bar, -(value / sigma)[held]])
    return r, np.concatenate([(W @ at.J).reshape(-1, m), J_bar, J_prior])


def solve_map(problem: KinematicProblem, start: State, *, steps: int = STEPS, unfinished: bool = False) -> MapEstimate:
    """Least squares from `start`, the weights renewed after every step; at most `steps` of them are tried.

    unfinished: where no optimum is reached, the state that was; otherwise NotConvergedError.
    """

    def rows(point: _Point) -> tuple[Array, Array]:
        return _weighted(problem, point.state, point.at, point.W)

    def moved(point: _Point, step: Array) -> _Point:
        try:
            state = point.state.moved(step)
            return _Point(state=state, at=linearise(problem, state), W=point.W)
        except (TrajectoryError, ImpossibleScannerError):
            return replace(point, at=replace(point.at, r=np.full_like(point.at.r, np.nan)))

    def renewed(point: _Point) -> _Point:
        return replace(point, W=whiteners(point.at.C))

    at = linearise(problem, start)
    begin = _Point(state=start, at=at, W=whiteners(at.C))
    found = least_squares(rows, moved, begin, steps=steps, tolerance=STEP_TOLERANCE, damping=0.0, renewed=renewed)
    if found.status is Status.NO_START:
        raise NotConvergedError("at the start a ball lies behind the source; the start is too far off")
    flat = VALLEY_TOLERANCE * len(found.r)
    if not (unfinished or found.status is Status.CONVERGED or promised(found.J, found.r) < flat):
        raise NotConvergedError(f"{found.status.value}: chi2 is {found.cost:.6g} for {len(found.r)} equations")
    return _estimate(problem, found.state.state, found.r, found.J, found.state.at)


def _factor(J: Array) -> tuple[Array, Array] | None:
    """Cholesky's L of J^T J with columns of length 1, and those lengths; None where it is singular.

    The priors keep the condition of J below 1e5, so that its square is harmless; a factor is ten times faster than an
    SVD of some hundred equations.
    """
    N = J.T @ J
    lengths = np.sqrt(np.diag(N))
    scale: Array = np.where(lengths > 0, lengths, 1.0)
    try:
        return np.asarray(np.linalg.cholesky(N / scale[:, None] / scale), dtype=np.float64), scale
    except np.linalg.LinAlgError:
        return None


def _estimate(problem: KinematicProblem, state: State, r: Array, J: Array, at: Linearised) -> MapEstimate:
    factor = _factor(J)
    if factor is None:
        raise NotConvergedError("the poses leave a direction of the unknowns undetermined; free fewer parameters")
    L, scale = factor
    half = np.asarray(solve_triangular(L, np.eye(len(L)), lower=True)) / scale
    sigma = problem.prior_sigma
    held = sigma[np.isfinite(sigma)]
    chi2 = float(r @ r)
    log_det = 2 * float(np.sum(np.log(np.diag(L))) + np.sum(np.log(scale)))
    log_det_C = float(np.sum(np.log(at.C[:, 0, 0] * at.C[:, 1, 1] - at.C[:, 0, 1] * at.C[:, 1, 0])))
    return MapEstimate(
        problem=problem,
        state=state,
        at=at,
        covariance=half.T @ half,
        chi2=chi2,
        dof=len(r) - J.shape[1],
        log_evidence=-0.5 * (chi2 + log_det_C + 2 * float(np.sum(np.log(held))) + log_det),
    )


def linear_fit(estimate: MapEstimate) -> LinearFit:
    """The estimate as the checks look at it: centres, and priors and bars as rows of their own."""
    return linear_at(estimate.problem, estimate.state)


def linear_at(problem: KinematicProblem, state: State) -> LinearFit:
    """The same of any rows at any state, such as all rows at the optimum of those that were used."""
    at = linearise(problem, state)
    W = whiteners(at.C)
    r, J = _weighted(problem, state, at, W)
    k = at.r.size
    return LinearFit(
        problem=problem.data,
        r=at.r,
        J=at.J,
        C=at.C,
        W=W,
        prior_rows=J[k:],
        prior_residuals=r[k:],
        information=J.T @ J,
    )


def singular_values(estimate: MapEstimate) -> Array:
    """(m,) of the weighted Jacobian with its priors, columns of length 1, largest first."""
    _, J = _weighted(estimate.problem, estimate.state, estimate.at, whiteners(estimate.at.C))
    s: Array = np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), 1e-300), compute_uv=False)
    return s
