"""Eq. (7) solved: from observed centres to the mount T_HT and the ball t, with uncertainty and a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tomopose.calibration.checks.convention_tests import Diagnosis, ranked, set_pose_rival
from tomopose.calibration.checks.conventions import RIVALS, Rival
from tomopose.calibration.checks.stability import Integrity, integrity
from tomopose.calibration.checks.verdict import Findings, verdict
from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS
from tomopose.calibration.model.covariance import angles_by_tangent, widening
from tomopose.calibration.model.parameters import (
    UNITS,
    FreeParameters,
    adjusted_scanners,
    base_name,
    free_parameters,
    translation_scale,
    unit_of,
)
from tomopose.calibration.model.problem import pair
from tomopose.calibration.result import Calibration, Parameter
from tomopose.calibration.rigid.estimate import Solution, solve, with_pose_noise
from tomopose.calibration.rigid.fit import blocks, tangent_names
from tomopose.calibration.rigid.observability import observability
from tomopose.calibration.uncertainty.propagation import tilt_sigma
from tomopose.errors import InputError, NotConvergedError
from tomopose.geometry.rotations import angles_from_rotation
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.units import Array

MODELS = ("auto", "rigid", "kinematic", "slack")


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
    held = {base_name(n) for n in free.names}
    drop = {"p_u", "p_v"} | ({"pitch_ratio"} if "p_u" in held else set())
    return tuple(n for n in UNITS if n not in held | drop)


def assumed_jacobian(solution: Solution, names: tuple[str, ...]) -> Array:
    """(n, 2, a): derivatives of the calculated centres by parameters that were held, px."""
    p = solution.used
    J_s = blocks(p, solution.free, solution.fit).J_scanner
    columns = [SCANNER_COLUMNS.index("p_u" if n == "pitch_ratio" else n) for n in names]
    factor = np.array([p.scanner.p_v if n == "pitch_ratio" else 1.0 for n in names])
    return J_s[:, :, columns] * factor


def _stated_chi2(solution: Solution, stated: Solution) -> float:
    """chi2 of the final residuals by the stated covariances of the centres alone, priors included."""
    W = stated.problem.select(solution.robust.keep).W
    r = solution.used.x_D - solution.x_calc
    prior = float((solution.free.information * solution.fit.delta**2).sum())
    return float(((W @ r[:, :, None]) ** 2).sum()) + prior


def _outliers(solution: Solution) -> dict[str, str]:
    robust = solution.robust
    return {
        i: f"{d:.1f} standard deviations away, beyond what a clean run allows"
        for i, d, k in zip(solution.problem.pose_id, np.sqrt(robust.distance2), robust.keep, strict=True)
        if not k
    }


def _extra(solution: Solution, checks: Integrity, chi2_dof: float) -> dict[str, Any]:
    """What the report shows besides, ready for JSON."""
    p = solution.problem
    extra: dict[str, Any] = {
        "integrity": checks.to_json(),
        "widening": widening(solution.chi2, solution.dof),
        "expected_residual_px": _expected_px(solution),
    }
    if solution.noise is not None:
        extra["pose_noise"] = {
            "translation_mm": solution.noise.translation,
            "rotation_rad": solution.noise.rotation,
            "gain": solution.noise.gain,
            "chi2_dof_with": solution.chi2 / solution.dof,
            "chi2_dof_without": chi2_dof,
        }
    if p.not_seen:
        extra["not_seen"] = dict(p.not_seen)
    if len(p.scanners) > 1:
        extra["runs"] = [
            {name: getattr(s, name) for name in PARAMETER_UNITS}
            for s in adjusted_scanners(p.scanners, solution.free, solution.fit.delta)
        ]
    return extra


def _expected_px(solution: Solution) -> float:
    """d_rms that the covariances in use explain, px, after the fit has used up its parameters."""
    n, m = len(solution.used), solution.J.shape[2]
    total = float(np.trace(solution.used.covariance, axis1=1, axis2=2).mean())
    return float(np.sqrt(total * max(1.0 - m / (2 * n), 0.0)))


def _calibration(
    solution: Solution, stated: Solution, diagnosis: Diagnosis | None, arguments: Mapping[str, Any]
) -> Calibration:
    p, fit, free = solution.used, solution.fit, solution.free
    scanners = adjusted_scanners(p.scanners, free, fit.delta)
    assumed = assumed_names(free)
    scale = translation_scale(free, fit.delta)
    checks = integrity(p, free, fit)
    chi2 = _stated_chi2(solution, stated)
    result = Calibration(
        scanner=scanners[0],
        T_HT=fit.T_HT,
        balls=dict(zip(p.ball_ids, fit.t, strict=True)),
        tangent=tangent_names(p.ball_ids, free),
        covariance=solution.covariance,
        pose_id=p.pose_id,
        x_D=p.x_D,
        residuals=p.x_D - solution.x_calc,
        chi2=chi2,
        dof=solution.dof,
        parameters=parameter_list(solution),
        observability=observability(p, free, solution.J, assumed_jacobian(solution, assumed), assumed),
        outliers=_outliers(solution),
        manipulator={"translation_scale": scale} if scale != 1.0 else {},
        converged=fit.converged,
        status=(
            f"optimum of {len(p)} poses reached"
            if fit.converged
            else "the iteration ended before it reached an optimum"
        ),
        hypotheses=tuple(h.to_json() for h in diagnosis.hypotheses) if diagnosis else (),
        pivot=p.pivot,
        convention=p.convention,
        extra=_extra(solution, checks, chi2 / solution.dof),
        provenance=provenance(arguments=arguments),
    )
    word, reasons = verdict(
        Findings(
            converged=result.converged,
            dof=result.dof,
            n_used=len(p),
            n_outliers=len(result.outliers),
            misfit=stated.robust.misfit,
            chi2_dof=result.chi2_dof,
            residual_px=result.d_rms,
            expected_px=_expected_px(stated),
            scan_px=tilt_sigma(result),
            diagnosis=diagnosis,
            integrity=checks,
        )
    )
    return replace(result, verdict=word, reasons=reasons)


def calibrate(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    manipulator: Any = None,
    model: str = "auto",
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    robust: bool = True,
    hypotheses: bool | Sequence[Rival] = True,
    pose_noise: Any = "auto",
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
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
    hypotheses:   try the cheap rival conventions (or those given) and say so in the verdict.
    pose_noise:   scatter of the manipulator about the poses it reports: "auto" estimates it where the residuals are
                  significantly above what the centres' covariances explain; (mm, rad) states it; None has none.
    distances:    (ball id, ball id) -> (distance, standard uncertainty), mm: scale bars.  With them the balls are
                  solved for by the estimator of the manipulator's errors, so model must not be "rigid".
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
    if distances and (model == "rigid" or (model == "auto" and manipulator is None)):
        raise InputError("distances between balls serve models with the manipulator's errors; give its geometry")
    problem = pair(scanner, poses, observations)
    freed = free_parameters(problem.scanners, free=free, fix=fix, priors=priors)
    stated = solve(problem, freed, robust=robust)
    solution = with_pose_noise(stated, pose_noise, robust=robust)
    diagnosis = None
    if hypotheses:
        other = set_pose_rival(problem, poses)
        known = RIVALS if isinstance(hypotheses, bool) else hypotheses
        quick = [r for r in (*known, *([other] if other else [])) if r.quick]
        diagnosis = ranked(stated.used, freed, stated.fit, quick, starts=0)
    arguments = {
        "model": model,
        "free": list(free),
        "fix": list(fix),
        "priors": dict(priors or {}),
        "robust": robust,
        "pose_noise": pose_noise if pose_noise is None or isinstance(pose_noise, str) else list(pose_noise),
    }
    rigid = _calibration(solution, stated, diagnosis, arguments)
    if not rigid.converged and raise_on_failure:
        raise NotConvergedError(rigid.status, calibration=rigid)
    if model == "rigid" or (model == "auto" and manipulator is None):
        return rigid
    from tomopose.calibration.identified.calibrate import calibrate_kinematic

    return calibrate_kinematic(
        scanner,
        poses,
        observations,
        manipulator=manipulator,
        model=model,
        rigid=rigid,
        free=freed,
        distances=distances,
        robust=robust,
    )
