"""Eq. (7) solved: from observed centres to the mount T_HT and the ball t, without a start value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.calibration.fit import Fit, blocks, jacobian, minimise, tangent_names
from tomopose.calibration.initial import closed_form, other_starts, ray_equations
from tomopose.calibration.observability import cure, observability, unobservable_directions
from tomopose.calibration.parameters import (
    UNITS,
    FreeParameters,
    adjusted_scanners,
    free_parameters,
    translation_scale,
    unit_of,
)
from tomopose.calibration.problem import Problem, pair
from tomopose.calibration.residuals import SCANNER_COLUMNS
from tomopose.calibration.result import Calibration, Parameter
from tomopose.calibration.robust import RobustFit, robust_fit
from tomopose.calibration.uncertainty import angles_by_tangent, inverse_information, widening
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.rotations import angles_from_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.units import Array

MODELS = ("auto", "rigid", "kinematic", "slack")
POOR_CHI2, POOR_SHARE = 9.0, 2e-3
"""An optimum is suspected to be local when its median residual is 3 sigma and 0.2 % of the centres' spread."""


def _median_residual(problem: Problem, free: FreeParameters, fit: Fit) -> tuple[float, float]:
    r = problem.x_D - blocks(problem, free, fit).x_D
    if not np.isfinite(r).all():
        return np.inf, np.inf
    d2 = ((problem.W @ r[:, :, None])[..., 0] ** 2).sum(axis=1)
    return float(np.median(d2)), float(np.median(np.linalg.norm(r, axis=1)))


def _poor(problem: Problem, free: FreeParameters, fit: Fit) -> tuple[bool, float]:
    d2, d = _median_residual(problem, free, fit)
    spread = float(np.sqrt(np.mean((problem.x_D - problem.x_D.mean(axis=0)) ** 2)))
    return not fit.converged or (d2 > POOR_CHI2 and d > POOR_SHARE * spread), d2


def best_fit(problem: Problem, free: FreeParameters) -> Fit:
    """The optimum of all rows, from the closed form, or the best of the optima from many starts where it looks poor."""
    n, d = ray_equations(problem)
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    fit = minimise(problem, held, closed_form(problem, n, d))
    poor, measure = _poor(problem, held, fit)
    if poor:
        for start in other_starts(problem, n, d):
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
    rows[:, m - len(free):] = np.diag(np.sqrt(free.information))
    return rows[free.information > 0]


def require_observable(problem: Problem, free: FreeParameters, J: Array) -> None:
    """NotObservableError, in words, where data and priors together leave a direction unknown.  J (n, 2, m), px."""
    names = tangent_names(problem.ball_ids, free)
    whitened = np.concatenate([(problem.W @ J).reshape(-1, J.shape[2]), _prior_rows(free, J.shape[2])])
    s, bad = unobservable_directions(whitened, names)
    if bad:
        direction, remedy = cure(problem, names, bad[-1])
        raise NotObservableError(
            f"the poses do not determine the calibration: {direction}; {remedy}",
            direction=direction,
            singular_values=tuple(float(x) for x in s),
        )


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A robust fit with all that the later steps need: problem of all rows and of the kept ones, J (kept, 2, m)."""

    problem: Problem
    used: Problem
    free: FreeParameters
    robust: RobustFit
    J: Array
    x_calc: Array
    chi2: float
    dof: int
    covariance: Array

    @property
    def fit(self) -> Fit:
        return self.robust.fit


def solve(problem: Problem, free: FreeParameters, *, robust: bool = True) -> Solution:
    """Best fit, outliers set aside, observability demanded, covariance by the stated rule."""
    start = best_fit(problem, free)
    if not np.isfinite(start.chi2):
        raise NotConvergedError("no start led to an optimum with the ball in front of the source in every pose")
    everything = np.ones(len(problem), dtype=bool)
    require_observable(problem, free, jacobian(problem, free, blocks(problem, free, start)))
    result = robust_fit(problem, free, start) if robust else RobustFit(
        fit=start, keep=everything, distance2=np.full(len(problem), np.nan), scale=np.nan, misfit=False
    )
    used = problem.select(result.keep)
    b = blocks(used, free, result.fit)
    J = jacobian(used, free, b)
    require_observable(used, free, J)
    dof = 2 * len(used) + int((free.information > 0).sum()) - J.shape[2]
    if dof <= 0:
        raise InputError(f"{len(used)} poses leave no degree of freedom for {J.shape[2]} unknowns; image more poses")
    chi2 = result.fit.chi2
    covariance = inverse_information(result.fit.N) * widening(chi2, dof)
    return Solution(
        problem=problem, used=used, free=free, robust=result, J=J, x_calc=b.x_D, chi2=chi2, dof=dof,
        covariance=covariance,
    )


def parameter_list(solution: Solution) -> tuple[Parameter, ...]:
    """The estimated numbers with their standard uncertainties: angles of T_HT, t_HT, the balls, freed parameters."""
    fit, C, free = solution.fit, solution.covariance, solution.free
    E = angles_by_tangent(fit.R_HT)
    u_angles = np.sqrt(np.einsum("ij,jk,ik->i", E, C[:3, :3], E))
    u = np.sqrt(np.maximum(np.diag(C), 0.0))
    names = tangent_names(solution.problem.ball_ids, free)
    result = [
        Parameter(name=f"phi_HT_{c}", value=float(a), u=float(s), unit="rad")
        for c, a, s in zip("xyz", angles_from_rotation(fit.R_HT), u_angles, strict=True)
    ]
    values = np.concatenate([fit.t_HT, fit.t.ravel(), free.value + fit.delta])
    units = ["mm"] * (3 + fit.t.size) + [unit_of(n) for n in free.names]
    result += [
        Parameter(name=n, value=float(v), u=float(s), unit=unit)
        for n, v, s, unit in zip(names[3:], values, u[3:], units, strict=True)
    ]
    return tuple(result)


def assumed_names(free: FreeParameters) -> tuple[str, ...]:
    """The scanner parameters that are taken as known and that poses could in principle show."""
    held = {n.split("[")[0] for n in free.names}
    drop = {"p_u", "p_v"} | ({"pitch_ratio"} if "p_u" in held else set())
    return tuple(n for n in UNITS if n not in held | drop)


def assumed_jacobian(solution: Solution, names: tuple[str, ...]) -> Array:
    """(n, 2, a): derivatives of the calculated centres by parameters that were held, px."""
    p = solution.used
    J_s = blocks(p, solution.free, solution.fit).J_scanner
    columns = [SCANNER_COLUMNS.index("p_u" if n == "pitch_ratio" else n) for n in names]
    factor = np.array([p.scanner.p_v if n == "pitch_ratio" else 1.0 for n in names])
    return J_s[:, :, columns] * factor


def _calibration(solution: Solution, arguments: Mapping[str, Any]) -> Calibration:
    p, fit, free = solution.used, solution.fit, solution.free
    scanners = adjusted_scanners(p.scanners, free, fit.delta)
    assumed = assumed_names(free)
    scale = translation_scale(free, fit.delta)
    limit = "residual beyond what a clean run allows"
    outliers = {
        i: f"{limit}: {d:.1f} standard deviations"
        for i, d, k in zip(solution.problem.pose_id, np.sqrt(solution.robust.distance2), solution.robust.keep,
                           strict=True)
        if not k
    }
    extra: dict[str, Any] = {"not_seen": dict(p.not_seen)} if p.not_seen else {}
    if len(scanners) > 1:
        extra["scanners"] = scanners
    return Calibration(
        scanner=scanners[0],
        T_HT=fit.T_HT,
        balls=dict(zip(p.ball_ids, fit.t, strict=True)),
        tangent=tangent_names(p.ball_ids, free),
        covariance=solution.covariance,
        pose_id=p.pose_id,
        x_D=p.x_D,
        residuals=p.x_D - solution.x_calc,
        chi2=solution.chi2,
        dof=solution.dof,
        parameters=parameter_list(solution),
        observability=observability(p, free, solution.J, assumed_jacobian(solution, assumed), assumed),
        outliers=outliers,
        manipulator={"translation_scale": scale} if scale != 1.0 else {},
        converged=fit.converged,
        status=(
            f"optimum of {len(p)} poses reached" if fit.converged
            else "the iteration ended before it reached an optimum"
        ),
        pivot=p.pivot,
        convention=p.convention,
        extra=extra,
        provenance=provenance(arguments=arguments),
    )


def calibrate(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    manipulator: Any = None,
    model: str = "auto",
    free: Iterable[str] = (),
    fix: Iterable[str] = (),
    priors: Mapping[str, float] | None = None,
    robust: bool = True,
    hypotheses: bool = True,
    raise_on_failure: bool = True,
) -> Calibration:
    """Find T_HT and t from radiographs of one ball.  Eq. (7), in one step, from no start value.

    Parameters
    ----------
    scanner:      intrinsic geometry; parameters with a prior standard deviation (`scanner.sigma`) are freed with it.
    poses:        the manipulator's poses with table angles and ball ids.
    observations: projected ball centres (px) with covariance, paired with the poses by pose_id.
                  Sequences of the three solve several runs (magnifications) of one mount together.
    manipulator:  a nominal hexapod or robot, needed for model "kinematic".
    model:        "rigid" trusts the poses; "kinematic" and "slack" identify the manipulator's errors too; "auto" is
                  "rigid" without a manipulator, and otherwise what predicts held-out poses best.
    free, fix:    names of scanner parameters to estimate or to hold; see `parameters.UNITS`.
    priors:       name -> prior standard deviation (mm, px, rad), in place of the scanner's.
    robust:       set aside centres that do not belong, and list them.
    hypotheses:   try the cheap rival conventions and say so in the verdict.
    raise_on_failure: raise where no optimum was reached; otherwise the status says so.

    Raises
    ------
    InputError          unknown ids or names, too few poses.
    NotObservableError  a direction that the poses (with the priors) cannot determine, in words.
    NotConvergedError   no optimum, with the calibration as far as it came.
    """
    if model not in MODELS:
        raise InputError(f"unknown model {model!r}; known are {', '.join(MODELS)}")
    if model == "kinematic" and manipulator is None:
        raise InputError("model 'kinematic' needs the manipulator's nominal geometry (--manipulator FILE)")
    problem = pair(scanner, poses, observations)
    freed = free_parameters(problem.scanners, free=free, fix=fix, priors=priors)
    solution = solve(problem, freed, robust=robust)
    arguments = {"model": model, "free": list(free), "fix": list(fix), "priors": dict(priors or {}), "robust": robust}
    rigid = _calibration(solution, arguments)
    if not rigid.converged and raise_on_failure:
        raise NotConvergedError(rigid.status, calibration=rigid)
    if model == "rigid" or (model == "auto" and manipulator is None):
        return rigid
    from tomopose.calibration.kinematic import calibrate_kinematic

    return calibrate_kinematic(scanner, poses, observations, manipulator=manipulator, model=model, rigid=rigid)
