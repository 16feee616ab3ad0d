"""One optimum of eq. (7) in Python's terms, around the compiled kernel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tomopose.calibration.model.ball_projection import (
    BALLS,
    ProjectionBlocks,
    projected_centres,
    projection_blocks,
)
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import FreeParameters, adjusted_scanners, translation_scale
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.tall import ByBall, is_tall
from tomopose.calibration.rigid.kernel import (
    DAMPING,
    NEAR_DAMPING,
    STEP_TOLERANCE,
    Freed,
    Rows,
    levenberg_marquardt,
    scanner_vectors,
)
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.least_squares import CODES, Status
from tomopose.units import Array

ITERATIONS = 60
_THREE_HALVES = 1.5 * np.eye(3)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """An optimum: R_HT (3, 3), t_HT (3,), t (balls, 3), delta (f,); chi2 with priors; N = J^T J with priors."""

    R_HT: Array
    t_HT: Array
    t: Array
    delta: Array
    chi2: float
    status: Status
    N: Array

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED

    @cached_property
    def inverse(self) -> Array:
        """(m, m): N^-1, the covariance by what was stated."""
        return inverse_information(self.N)

    @property
    def T_HT(self) -> RigidTransform:
        return RigidTransform(R=self.R_HT, t=self.t_HT, source=Frame.H, target=Frame.T)


def rows_of(problem: Problem, weight: Array | None = None, some: npt.NDArray[np.int64] | None = None) -> Rows:
    """The rows of a problem as the kernel takes them, all or some (k,); weight (n,) on the squared residuals of all,
    or all 1."""
    if some is not None:
        return Rows(
            x=problem.x_D[some],
            W=problem.W[some],
            weight=np.ones(len(some)),
            poses=problem.poses[some],
            run=problem.run[some],
            ball=problem.ball[some],
        )
    w = np.ones(len(problem)) if weight is None else np.ascontiguousarray(weight, dtype=np.float64)
    return Rows(
        x=problem.x_D,
        W=problem.W,
        weight=w,
        poses=problem.poses,
        run=problem.run,
        ball=problem.ball,
    )


def freed_of(problem: Problem, free: FreeParameters) -> Freed:
    """The freed parameters as the kernel takes them."""
    return Freed(
        s_0=problem.s_0, cols=free.cols, col_run=free.col_run, factor=free.factor, information=free.information
    )


def minimise(
    problem: Problem,
    free: FreeParameters,
    start: Fit | tuple[Array, Array, Array],
    *,
    weight: Array | None = None,
    rows: npt.NDArray[np.int64] | None = None,
    iterations: int = ITERATIONS,
    tolerance: float = STEP_TOLERANCE,
) -> Fit:
    """The optimum reached from a start (a fit, or R_HT, t_HT, t).

    weight: (n,) on the squared residuals, or rows: some rows (k,) alone.
    tolerance: in standard deviations, of the last step.
    """
    R, t_HT, t = (start.R_HT, start.t_HT, start.t) if isinstance(start, Fit) else start
    delta = start.delta if isinstance(start, Fit) and len(start.delta) == len(free) else np.zeros(len(free))
    damping = NEAR_DAMPING if isinstance(start, Fit) and start.converged else DAMPING
    at = np.concatenate([R.ravel(), t_HT, t.ravel(), delta])
    chi2, code, at, N = levenberg_marquardt(
        rows_of(problem, weight, rows), freed_of(problem, free), at, iterations, damping, tolerance
    )
    R, free_from = at[:9].reshape(3, 3), len(at) - len(delta)
    return Fit(
        # the rounding of many steps, taken off R: the nearest rotation, to second order in its distance
        R_HT=R @ (_THREE_HALVES - 0.5 * (R.T @ R)),
        t_HT=at[9:BALLS],
        t=at[BALLS:free_from].reshape(t.shape),
        delta=at[free_from:],
        chi2=float(chi2),
        status=CODES[code],
        N=N,
    )


def residuals(problem: Problem, free: FreeParameters, fit: Fit) -> Array:
    """(n, 2) px: observed minus calculated centres; NaN where a ball would be behind the source."""
    s = problem.s_0.copy()
    scanner_vectors(freed_of(problem, free), fit.delta, s)
    x = projected_centres(s, problem.run, fit.R_HT, fit.t_HT, problem.poses, fit.t[problem.ball])
    return np.asarray(problem.x_D - x)


def whitened2(problem: Problem, r: Array) -> Array:
    """(n,) squared length of residuals r (n, 2) px in standard deviations of the centres."""
    W = problem.W
    a = W[:, 0, 0] * r[:, 0] + W[:, 0, 1] * r[:, 1]
    b = W[:, 1, 0] * r[:, 0] + W[:, 1, 1] * r[:, 1]
    return a * a + b * b


def blocks(problem: Problem, free: FreeParameters, fit: Fit) -> ProjectionBlocks:
    """Projected centres and derivatives at a fit."""
    return projection_blocks(
        adjusted_scanners(problem.scanners, free, fit.delta),
        T_HT=fit.T_HT,
        T_MH=problem.T_MH,
        t=fit.t[problem.ball],
        alpha=problem.alpha,
        translation_scale=translation_scale(free, fit.delta),
        run=problem.run,
    )


def _by_freed(problem: Problem, free: FreeParameters, b: ProjectionBlocks) -> Array:
    """(n, 2, f): derivatives of the calculated centres by the freed parameters, px."""
    J: Array = b.J_scanner[:, :, free.cols] * free.factor
    if (free.col_run >= 0).any():
        mine = (free.col_run[None, :] < 0) | (free.col_run[None, :] == problem.run[:, None])
        J *= mine[:, None, :]
    return J


def derivatives(problem: Problem, free: FreeParameters, b: ProjectionBlocks) -> Array | ByBall:
    """(n, 2, m): derivatives of the calculated centres, as of `jacobian`; of very many centres of several balls what of
    them is not zero."""
    if len(problem.ball_ids) == 1 or not is_tall(2 * len(problem)):
        return jacobian(problem, free, b)
    return ByBall(
        w_HT=b.J_w_HT,
        t_HT=b.J_t_HT,
        own=b.J_t,
        freed=_by_freed(problem, free, b),
        ball=problem.ball,
        balls=len(problem.ball_ids),
    )


def jacobian(problem: Problem, free: FreeParameters, b: ProjectionBlocks) -> Array:
    """(n, 2, m): derivatives of the calculated centres by w_HT, t_HT, the balls and the freed parameters, px."""
    n, free_from = len(problem), 6 + 3 * len(problem.ball_ids)
    J = np.zeros((n, 2, free_from + len(free)))
    J[:, :, :3], J[:, :, 3:6] = b.J_w_HT, b.J_t_HT
    if len(problem.ball_ids) == 1:
        J[:, :, 6:9] = b.J_t
    else:
        column = 6 + 3 * problem.ball[:, None] + np.arange(3)
        np.put_along_axis(J, np.broadcast_to(column[:, None, :], (n, 2, 3)), b.J_t, axis=2)
    J[:, :, free_from:] = _by_freed(problem, free, b)
    return J


def linear_fit(problem: Problem, free: FreeParameters, fit: Fit) -> LinearFit:
    """The fit with its residuals, derivatives and priors, as the checks look at it."""
    b = blocks(problem, free, fit)
    return linearised(problem, free, fit, b, derivatives(problem, free, b))


def linearised(problem: Problem, free: FreeParameters, fit: Fit, b: ProjectionBlocks, J: Array | ByBall) -> LinearFit:
    """The same of a fit whose projection b and derivatives J (n, 2, m) are known."""
    m, stated = J.shape[2], np.flatnonzero(free.information > 0)
    root = np.sqrt(free.information[stated])
    rows = np.zeros((len(stated), m))
    rows[np.arange(len(stated)), m - len(free) + stated] = root
    return LinearFit(
        problem=problem,
        r=problem.x_D - b.x_D,
        J=J,
        C=problem.covariance,
        W=problem.W,
        prior_rows=rows,
        prior_residuals=-root * fit.delta[stated],
        information=fit.N,
    )


def tangent_names(ball_ids: tuple[int, ...], free: FreeParameters) -> tuple[str, ...]:
    """The names of the coordinates of a covariance, in order."""
    balls = [f"t_{c}" if len(ball_ids) == 1 else f"t[{b}]_{c}" for b in ball_ids for c in "xyz"]
    return (*(f"w_HT_{c}" for c in "xyz"), *(f"t_HT_{c}" for c in "xyz"), *balls, *free.names)
