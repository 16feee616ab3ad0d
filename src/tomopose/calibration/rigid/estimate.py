"""The optimum from the data alone: start, outliers, observability, covariance, and pose noise where it is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.model.ball_projection import ProjectionBlocks
from tomopose.calibration.model.covariance import significant, widening
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import UNITS, FreeParameters, free_parameters
from tomopose.calibration.model.problem import POSITION_UNITS, Problem
from tomopose.calibration.model.tall import ByBall, is_tall
from tomopose.calibration.rigid.fit import (
    Fit,
    blocks,
    derivatives,
    linearised,
    minimise,
    residuals,
    tangent_names,
    whitened2,
)
from tomopose.calibration.rigid.observability import direction_and_remedy, unobservable_directions, whitened_columns
from tomopose.calibration.rigid.outliers import RobustFit, robust_fit
from tomopose.calibration.rigid.pose_noise import PoseNoise, estimate_pose_noise, total_covariance
from tomopose.calibration.rigid.start import closed_form, other_starts, ray_equations
from tomopose.errors import InputError, NotConvergedError, NotObservableError, UnitError
from tomopose.manipulator.real_poses import Repeatability
from tomopose.units import Array

LIKELY = 2.5
"""A ball on the manipulator is taken to be within this factor of the rotation axis' distance from the focal spot."""

COLLAPSED = 1e-3
"""A ball nearer to the source than this part of d_SR cannot have been imaged."""

POOR_CHI2, POOR_SHARE = 9.0, 2e-3
"""An optimum is suspected to be local when its median residual is 3 sigma and 0.2 % of the centres' spread."""


def _median_residual(problem: Problem, free: FreeParameters, fit: Fit) -> tuple[float, float]:
    r = residuals(problem, free, fit)
    d2 = whitened2(problem, r)
    # a centre that is not finite makes the median so too
    return (
        (float(np.median(d2)), float(np.sqrt(np.median((r * r).sum(axis=1)))))
        if np.isfinite(d2).all()
        else (np.inf, np.inf)
    )


def _poor(problem: Problem, free: FreeParameters, fit: Fit) -> tuple[bool, float]:
    d2, d = _median_residual(problem, free, fit)
    spread = float(np.sqrt(np.mean((problem.x_D - problem.x_D.mean(axis=0)) ** 2)))
    return not fit.converged or (d2 > POOR_CHI2 and d > POOR_SHARE * spread), d2


def best_fit(problem: Problem, free: FreeParameters) -> Fit:
    """The optimum of all rows, from the closed form, or the best of the optima from many starts where it looks poor."""
    rays = ray_equations(problem)
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    fit = minimise(problem, held, closed_form(problem, rays))
    poor, measure = _poor(problem, held, fit)
    if poor:
        for start in other_starts(problem, rays):
            other = minimise(problem, held, start, iterations=30)
            still_poor, other_measure = _poor(problem, held, other)
            if other_measure < measure or not np.isfinite(measure):
                fit, measure = other, other_measure
            if not still_poor:
                break
        fit = minimise(problem, held, fit)
    return minimise(problem, free, fit) if len(free) else fit


def _prior_rows(free: FreeParameters, m: int) -> Array:
    rows = np.zeros((len(free), m))
    rows[:, m - len(free) :] = np.diag(np.sqrt(free.information))
    return rows[free.information > 0]


def require_observable(problem: Problem, free: FreeParameters, J: Array | ByBall) -> None:
    """NotObservableError, in words, where data and priors together leave a direction unknown.  J (n, 2, m), px."""
    names = tangent_names(problem.ball_ids, free)
    whitened = np.concatenate([whitened_columns(problem, J), _prior_rows(free, J.shape[2])])
    s, bad = unobservable_directions(whitened, names)
    if bad:
        direction, remedy = direction_and_remedy(problem, names, bad[-1])
        raise NotObservableError(
            f"the poses do not determine the calibration: {direction}; {remedy}",
            direction=direction,
            singular_values=tuple(float(x) for x in s),
        )


def require_no_other_unit(distance: float, d_SR: float) -> None:
    """UnitError where another unit of the positions has the ball near the rotation axis; distance: mm, to the spot."""
    off_axis = {u: abs(np.log(max(distance * u[2], 1e-300) / d_SR)) for u in POSITION_UNITS}
    name, symbol, factor = min(off_axis, key=lambda u: off_axis[u])
    if off_axis[name, symbol, factor] < np.log(LIKELY):
        raise UnitError(
            f"the positions look like {name} ({symbol}), not millimetres: millimetres place the ball at the focal spot "
            f"({distance:.3g} mm from it), {name} {distance * factor:.4g} mm from it, near the rotation axis (d_SR "
            f"{d_SR:g} mm); multiply x_mm, y_mm and z_mm of the pose table by {factor:g}"
        )


def require_length(problem: Problem, fit: Fit) -> None:
    """NotObservableError where the ball has fallen into the source: without any length an optimum may shrink at will.

    Poses that only turn about one point, as those of an isocentric C-arm do, hold no such information while the table
    does not move.
    """
    scanner = problem.scanners[problem.run[0]]
    source = (scanner.T_WS @ scanner.T_TW(float(problem.alpha[0]))).inv.t
    ball = fit.R_HT @ (problem.R_MH[0] @ fit.t[problem.ball[0]] + problem.t_MH[0]) + fit.t_HT
    distance = float(np.linalg.norm(ball - source))
    if distance < COLLAPSED * scanner.d_SR:
        if not problem.units_confirmed:
            require_no_other_unit(distance, scanner.d_SR)
        direction = "the size of t_HT and t: every distance from the source may be shrunk alike"
        raise NotObservableError(
            f"the poses do not determine the calibration: {direction}; add poses that translate, another table angle, "
            "or known distances between balls with the manipulator's geometry",
            direction=direction,
        )


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A robust fit with all that the later steps need.

    problem, used: all rows, and those not set aside;  kept: projection of the rows used, where they are not very many.
    chi2: by the covariances that were used;  covariance: (m, m), widened by the rule in `uncertainty`.
    noise: the pose noise that the covariances include, or None.
    """

    problem: Problem
    used: Problem
    noise: PoseNoise | None
    free: FreeParameters
    robust: RobustFit
    kept: ProjectionBlocks | None
    chi2: float
    dof: int
    covariance: Array

    @property
    def fit(self) -> Fit:
        return self.robust.fit

    @property
    def at(self) -> ProjectionBlocks:
        """Projection of the rows used."""
        return blocks(self.used, self.free, self.fit) if self.kept is None else self.kept

    @property
    def x_calc(self) -> Array:
        """(used, 2) px."""
        return self.at.x_D

    @property
    def linear(self) -> LinearFit:
        """The fit of the rows used, as the checks look at it: calculated anew, since of many balls it is large."""
        at = self.at
        return linearised(self.used, self.free, self.fit, at, derivatives(self.used, self.free, at))

    def at_all_rows(self) -> ProjectionBlocks:
        """Projection of all rows, those set aside included."""
        return self.at if self.used is self.problem else blocks(self.problem, self.free, self.fit)


def solve(
    problem: Problem,
    free: FreeParameters,
    *,
    robust: bool = True,
    start: Fit | None = None,
    noise: PoseNoise | None = None,
    before: RobustFit | None = None,
) -> Solution:
    """Best fit, outliers set aside, observability demanded, covariance by the stated rule.

    before: as of `robust_fit`.
    """
    first = best_fit(problem, free) if start is None else minimise(problem, free, start)
    if not np.isfinite(first.chi2):
        raise NotConvergedError("no start led to an optimum with the ball in front of the source in every pose")
    require_length(problem, first)
    everything = np.ones(len(problem), dtype=bool)
    b = blocks(problem, free, first)
    J = derivatives(problem, free, b)
    # judged by detection noise alone: pose noise as large as a mistake would hide behind "not observable"
    if noise is None:
        require_observable(problem, free, J)
    result = (
        robust_fit(problem, free, first, b.x_D, J, before=before)
        if robust
        else RobustFit(fit=first, keep=everything, distance2=np.full(len(problem), np.nan), scale=np.nan, misfit=False)
    )
    used = problem.select(result.keep)
    if result.fit is not first or used is not problem:
        b = blocks(used, free, result.fit)
        J = derivatives(used, free, b)
    if noise is None and not result.keep.all():
        require_observable(used, free, J)
    dof = 2 * len(used) + int((free.information > 0).sum()) - J.shape[2]
    if dof <= 0:
        raise InputError(f"{len(used)} poses leave no degree of freedom for {J.shape[2]} unknowns; image more poses")
    chi2 = result.fit.chi2
    return Solution(
        problem=problem,
        used=used,
        noise=noise,
        free=free,
        robust=result,
        kept=None if is_tall(2 * len(used)) else b,
        chi2=chi2,
        dof=dof,
        covariance=result.fit.inverse * widening(chi2, dof),
    )


NOISE_ROUNDS = 3


def _given_noise(pose_noise: str | tuple[float, float]) -> PoseNoise | None:
    """The scatter that was stated, or None where it is to be estimated."""
    if isinstance(pose_noise, str):
        if pose_noise != "auto":
            raise InputError(f"pose_noise is {pose_noise!r}; None, 'auto' or two numbers (mm, rad) are needed")
        return None
    if np.shape(pose_noise) != (2,) or not np.isfinite(pose_noise).all() or np.min(pose_noise) < 0:
        raise InputError(f"pose_noise is {pose_noise!r}; two numbers (mm, rad), not negative, are needed")
    return PoseNoise(translation=float(pose_noise[0]), rotation=float(pose_noise[1]))


def with_pose_noise(
    solution: Solution,
    pose_noise: str | tuple[float, float] | None,
    *,
    robust: bool = True,
    maker: Repeatability | None = None,
) -> Solution:
    """The solution with the manipulator's scatter in the weights.

    pose_noise: None (detection noise only), "auto" (its posterior, with the maker's repeatability as prior; see
    `pose_noise`), or the standard deviations (mm, rad) of a pose's translation and rotation, a coordinate each.
    """
    if pose_noise is None:
        return solution
    original, free = solution.problem, solution.free
    # what did not fit as a whole is not made to fit by setting its worst rows aside
    robust = robust and not solution.robust.misfit
    given = _given_noise(pose_noise)
    rounds = NOISE_ROUNDS if given is None and significant(solution.chi2, solution.dof) else 1
    for _ in range(rounds):
        noise = _posterior(original.select(solution.robust.keep), solution, maker) if given is None else given
        if noise.translation == noise.rotation == 0.0:
            return solution
        V = total_covariance(original.covariance, solution.at_all_rows(), noise)
        problem = original.with_covariance(V)
        solution = solve(problem, free, robust=robust, start=solution.fit, noise=noise, before=solution.robust)
    return solution


def _posterior(used: Problem, solution: Solution, maker: Repeatability | None) -> PoseNoise:
    free, at = solution.free, solution.at
    J = derivatives(solution.used, free, at)
    known = np.zeros(J.shape[2] - len(free))
    return estimate_pose_noise(
        used.covariance,
        at,
        J,
        used.x_D - at.x_D,
        information=np.concatenate([known, free.information]),
        deviation=np.concatenate([known, solution.fit.delta]),
        maker=maker,
    )
