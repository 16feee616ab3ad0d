r"""Maximum a posteriori estimate of mount, balls, scanner and manipulator errors together.

For pose k the model predicts x_D,k(theta) with theta = (T_HT, t of each ball, freed scanner parameters, manipulator
errors p).  Minimised is

    sum_k r_k^T C_k^-1 r_k  +  sum_i p_i^2 / sigma_i^2  +  sum_bars (|t_a - t_b| - L)^2 / u_L^2

with C_k the covariance of the observation plus that of the plate's scatter seen through the projection,
C_k = C_obs,k + f J_pose diag(repeatability) J_pose^T.  The priors sigma_i make the problem well posed: shifts and
turns of all base joints (or all platform joints) together cannot be told from T_HT (or t), and stay where the prior
puts them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from tomopose.calibration.residuals import SCANNER_COLUMNS, projection_blocks, whiteners
from tomopose.errors import NotConvergedError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel
from tomopose.units import Array

STEPS = 40
COST_TOLERANCE = 1e-8
"""Relative to the number of equations: a step that gains less than this in chi2 ends the iteration."""
RANK_TOLERANCE = 1e-12
"""Singular values below this times the largest count as zero: nothing is known in that direction."""
LEAST_DAMPING, LARGEST_DAMPING = 1e-6, 1e8


@dataclass(frozen=True, kw_only=True)
class KinematicProblem:
    """What was measured, and what may be wrong.  Rows of poses, x_D and covariance belong together.

    x_D (n, 2) px, covariance (n, 2, 2) px^2: observed ball centres.
    model:       error model of the manipulator, or None for a machine without errors.
    free:        scanner parameter -> prior standard deviation (inf: none).
    bars:        (ball a, ball b) -> (distance, its standard uncertainty), mm.
    view_sigma:  scanner parameter -> standard deviation of its scatter from view to view (a C-arm's d_SD, say).
    scatter:     factor f on the variance of the model's repeatability.
    """

    scanner: Scanner
    poses: PoseSequence
    x_D: Array
    covariance: Array
    model: ErrorModel | None = None
    free: Mapping[str, float] = field(default_factory=dict)
    bars: Mapping[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    view_sigma: Mapping[str, float] = field(default_factory=dict)
    scatter: float = 1.0
    repeatability: Array | None = None

    @property
    def ball_ids(self) -> tuple[int, ...]:
        return tuple(int(i) for i in np.unique(self.poses.ball_id))

    @property
    def tangent(self) -> tuple[str, ...]:
        """Names of the coordinates of theta, in order, as `Calibration.tangent` has them."""
        ids = self.ball_ids
        balls = [f"t_{x}" for x in "xyz"] if len(ids) == 1 else [f"t[{i}]_{x}" for i in ids for x in "xyz"]
        mount = [f"{what}_HT_{x}" for what in "wt" for x in "xyz"]
        return (*mount, *balls, *self.free, *(() if self.model is None else self.model.names))

    @property
    def prior_sigma(self) -> Array:
        """Prior standard deviation of each coordinate of theta; inf where there is none."""
        flat = np.full(6 + 3 * len(self.ball_ids), np.inf)
        errors = np.zeros(0) if self.model is None else self.model.sigma
        return np.concatenate([flat, list(self.free.values()), errors])

    def rows(self, index: Array) -> KinematicProblem:
        """The same problem with those rows only."""
        return replace(
            self, poses=self.poses.select(index), x_D=self.x_D[index], covariance=self.covariance[index]
        )


@dataclass(frozen=True, kw_only=True)
class State:
    """A point theta: mount, balls (nb, 3) in the order of ball ids, scanner, manipulator errors p."""

    T_HT: RigidTransform
    balls: Array
    scanner: Scanner
    p: Array

    def moved(self, step: Array, free: tuple[str, ...]) -> State:
        nb, nf = self.balls.size, len(free)
        values = {n: getattr(self.scanner, n) + d for n, d in zip(free, step[6 + nb : 6 + nb + nf], strict=True)}
        T_HT = RigidTransform(
            R=exp_rotation(step[:3]) @ self.T_HT.R, t=self.T_HT.t + step[3:6], source=Frame.H, target=Frame.T
        )
        return State(
            T_HT=T_HT,
            balls=self.balls + step[6 : 6 + nb].reshape(-1, 3),
            scanner=replace(self.scanner, **values) if free else self.scanner,
            p=self.p + step[6 + nb + nf :],
        )


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """Residuals r (n, 2) observed minus calculated, px; J (n, 2, m) of the prediction; C (n, 2, 2) px^2;
    J_pose (n, 2, 6) by (w, t) of the plate."""

    r: Array
    J: Array
    C: Array
    J_pose: Array


@dataclass(frozen=True, kw_only=True)
class MapEstimate:
    """The optimum: state, linearisation there, covariance (m, m), chi2 with priors, dof = equations - free parameters
    without a prior, log_evidence (Laplace; comparable between models of the same observations)."""

    problem: KinematicProblem
    state: State
    at: Linearised
    covariance: Array
    singular_values: Array
    chi2: float
    chi2_data: float
    dof: int
    log_evidence: float
    steps: int


def linearise(problem: KinematicProblem, state: State) -> Linearised:
    """The prediction and its derivatives at theta."""
    poses = problem.poses
    row_of = {ball: k for k, ball in enumerate(problem.ball_ids)}
    ball_row = np.array([row_of[int(i)] for i in poses.ball_id])
    n, nb = len(poses), len(row_of)
    T_MH, J_errors = poses.T_MH, np.zeros((n, 6, 0))
    if problem.model is not None:
        real = problem.model.real_poses(poses, state.p)
        T_MH, J_errors = real.T_MH, real.J
    blocks = projection_blocks(
        state.scanner, T_HT=state.T_HT, T_MH=T_MH, t=state.balls[ball_row], alpha=poses.alpha
    )
    J_pose = np.concatenate([-blocks.G_H @ skew(blocks.x_H - T_MH.t), blocks.G_H], axis=2)
    J_balls = np.zeros((n, 2, nb, 3))
    J_balls[np.arange(n), :, ball_row] = blocks.J_t
    columns = [SCANNER_COLUMNS.index(name) for name in problem.free]
    J = np.concatenate(
        [blocks.J_mount, J_balls.reshape(n, 2, 3 * nb), blocks.J_scanner[:, :, columns], J_pose @ J_errors], axis=2
    )
    C = problem.covariance.copy()
    variance = problem.repeatability
    if variance is None and problem.model is not None:
        variance = problem.model.repeatability.variance
    if variance is not None:
        C = C + problem.scatter * (J_pose * variance) @ np.swapaxes(J_pose, 1, 2)
    for name, sigma in problem.view_sigma.items():
        g = blocks.J_scanner[:, :, SCANNER_COLUMNS.index(name)] * sigma
        C = C + g[:, :, None] * g[:, None, :]
    return Linearised(r=problem.x_D - blocks.x_D, J=J, C=C, J_pose=J_pose)


def _bar_rows(problem: KinematicProblem, state: State) -> tuple[Array, Array]:
    """Weighted residuals (nbar,) and rows (nbar, m) of the known distances between balls."""
    ids = problem.ball_ids
    rows, m = [], len(problem.tangent)
    r = []
    for (a, b), (length, u) in problem.bars.items():
        i, j = ids.index(a), ids.index(b)
        d = state.balls[i] - state.balls[j]
        distance = float(np.linalg.norm(d))
        row = np.zeros(m)
        row[6 + 3 * i : 9 + 3 * i], row[6 + 3 * j : 9 + 3 * j] = d / distance / u, -d / distance / u
        rows.append(row)
        r.append((length - distance) / u)
    return np.array(r), np.reshape(rows, (len(r), m))


def _weighted(
    problem: KinematicProblem, state: State, W: Array | None = None
) -> tuple[Array, Array, Linearised, Array]:
    """All residuals and rows in standard deviations: observations, bars, priors; the linearisation; whiteners.

    W (n, 2, 2): whiteners to use; None: those of this state.
    """
    at = linearise(problem, state)
    W = whiteners(at.C) if W is None else W
    m = at.J.shape[2]
    r_bar, J_bar = _bar_rows(problem, state)
    sigma = problem.prior_sigma
    held = np.flatnonzero(np.isfinite(sigma))
    freed = np.array([getattr(state.scanner, n) - getattr(problem.scanner, n) for n in problem.free])
    value = np.concatenate([np.zeros(m - len(freed) - len(state.p)), freed, state.p])
    J_prior = np.zeros((len(held), m))
    J_prior[np.arange(len(held)), held] = 1 / sigma[held]
    r = np.concatenate([(W @ at.r[:, :, None])[..., 0].ravel(), r_bar, -(value / sigma)[held]])
    return r, np.concatenate([(W @ at.J).reshape(-1, m), J_bar, J_prior]), at, W


def _svd(J: Array) -> tuple[Array, Array, Array, Array]:
    """U, s, V^T of J with columns of length 1, and those lengths."""
    scale = np.sqrt(np.einsum("ij,ij->j", J, J))
    scale = np.where(scale > 0, scale, 1.0)
    U, s, Vt = np.linalg.svd(J / scale, full_matrices=False)
    return U, s, Vt, scale


def solve_map(problem: KinematicProblem, start: State) -> MapEstimate:
    """Levenberg-Marquardt from `start`, the weights renewed at every step.

    Raises NotConvergedError where no optimum is reached.
    """
    state, damping, free = start, 0.0, tuple(problem.free)
    drop = np.inf
    for step in range(1, STEPS + 1):
        r, J, at, W = _weighted(problem, state)
        if not np.isfinite(r).all():
            raise NotConvergedError("at the start a ball lies behind the source; the start is too far off")
        if abs(drop) < COST_TOLERANCE * len(r):
            return _estimate(problem, state, r, J, at, step)
        U, s, Vt, scale = _svd(J)
        along = U.T @ r
        while True:
            gain = np.where(s > s[0] * RANK_TOLERANCE, s / np.maximum(s**2 + damping, 1e-300), 0.0)
            trial = state.moved((Vt.T @ (gain * along)) / scale, free)
            r_new = _weighted(problem, trial, W)[0]
            drop = float(r @ r - r_new @ r_new)
            if np.isfinite(r_new).all() and drop > -COST_TOLERANCE * len(r):
                state, damping = trial, damping / 10 if damping > LEAST_DAMPING else 0.0
                break
            damping = max(damping * 10, LEAST_DAMPING)
            if damping > LARGEST_DAMPING:
                raise NotConvergedError(f"step {step}: no direction lowers chi2 = {r @ r:.6g}, and it is no optimum")
    raise NotConvergedError(f"no optimum after {STEPS} steps; the last one still gained {drop:.3g} in chi2")


def _estimate(problem: KinematicProblem, state: State, r: Array, J: Array, at: Linearised, steps: int) -> MapEstimate:
    _, s, Vt, scale = _svd(J)
    inverse = np.where(s > s[0] * RANK_TOLERANCE, 1 / np.maximum(s, 1e-300), np.inf)
    half = np.where(np.isfinite(inverse), inverse, 0.0)[:, None] * Vt / scale
    sigma = problem.prior_sigma
    held = sigma[np.isfinite(sigma)]
    n_data = at.r.size
    chi2, chi2_data = float(r @ r), float(r[:n_data] @ r[:n_data])
    log_det = 2 * float(np.sum(np.log(np.where(s > 0, s, 1e-300))) + np.sum(np.log(scale)))
    log_evidence = -0.5 * (
        chi2 + float(np.sum(np.log(np.linalg.det(at.C)))) + 2 * float(np.sum(np.log(held))) + log_det
    )
    return MapEstimate(
        problem=problem,
        state=state,
        at=at,
        covariance=half.T @ half,
        singular_values=s,
        chi2=chi2,
        chi2_data=chi2_data,
        dof=len(r) - J.shape[1],
        log_evidence=log_evidence,
        steps=steps,
    )


def parameter_units(problem: KinematicProblem) -> tuple[str, ...]:
    """The unit of each coordinate of theta."""
    return (
        *("rad",) * 3, *("mm",) * 3, *("mm",) * (3 * len(problem.ball_ids)),
        *(PARAMETER_UNITS[name] for name in problem.free), *(() if problem.model is None else problem.model.units),
    )
