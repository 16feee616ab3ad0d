"""From a fit of any model to a `Calibration`: parameters, outliers, evidence, findings.  There is no other builder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.calibration.checks.ball_size import measured_ball_size, require_ball_size
from tomopose.calibration.checks.conventions.hypothesis import Diagnosis
from tomopose.calibration.checks.evidence.evidence import (
    AgainstRigid,
    BallSize,
    Evidence,
    ScatterFound,
    Undistinguished,
)
from tomopose.calibration.checks.rules import findings
from tomopose.calibration.checks.score_tests.scanner_tests import ScannerTests
from tomopose.calibration.checks.stability import stability
from tomopose.calibration.model.assumed import Assumed
from tomopose.calibration.model.budget import budget_words
from tomopose.calibration.model.covariance import angles_by_tangent
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import FreeParameters, adjusted_scanners, unit_of
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.silhouettes import chain_matrices
from tomopose.calibration.model.unseen import Unseen
from tomopose.calibration.result import (
    Arrangement,
    Calibration,
    ModelComparison,
    Parameter,
    PoseNoiseFound,
    ViewDistances,
)
from tomopose.calibration.rigid.contradiction import Contradicted
from tomopose.calibration.rigid.fit import tangent_names
from tomopose.calibration.rigid.observability import Observability
from tomopose.calibration.uncertainty.halves import halves_of
from tomopose.calibration.uncertainty.scan_budget import reference_of, scan_budget
from tomopose.geometry.rotations import angles_from_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import Errors
from tomopose.provenance import Provenance
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class ManipulatorEvidence:
    """What only models with the manipulator's errors have; as in `rules.Evidence`."""

    scatter: ScatterFound | None = None
    against_rigid: AgainstRigid | None = None
    size: float | None = None
    run_effects: bool = False
    open_turns: str = ""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A fit of any model.

    everything, keep, distance2: all rows, (n,) bool those used, (n,) their squared studentised residuals.
    linear:       the fit of the rows used, linearised.
    free, delta:  freed scanner parameters and their deviations;  p, p_names, p_units: (k,) the manipulator's errors.
    covariance:   (m, m), widened by the factor `widening`;  widens: whether this model's covariance grows with chi2.
    chi2, dof:    of the result;  fit_chi2: with the covariances that the fit used.
    misfit:       more rows fail than may be outliers.
    expected_px, stated_px: d_rms that the covariances in use and the stated ones explain.
    magnification_at_ball: mean of d_SD over the ball's distance.
    view_matrices: (n, 3, 4) from the balls' frame to pixels of the rows used, where source and panel move apart.
    assumed:      of the scanner;  contradicted: values of it that were freed.
    tests:        one effect after the other, or None where they do not apply.
    unseen, budget: as of the result.
    undistinguished: readings of the orientation columns that the poses cannot distinguish.
    """

    everything: Problem
    keep: Any
    distance2: Array
    linear: LinearFit
    T_HT: RigidTransform
    balls: Array
    free: FreeParameters
    delta: Array
    p: Array
    p_names: tuple[str, ...]
    p_units: tuple[str, ...]
    covariance: Array
    widening: float
    widens: bool
    chi2: float
    fit_chi2: float
    dof: int
    converged: bool
    status: str
    misfit: bool
    expected_px: float
    stated_px: float
    model: str
    arrangement: Arrangement
    errors: Errors
    observability: Observability
    manipulator: ManipulatorEvidence = ManipulatorEvidence()
    diagnosis: Diagnosis | None = None
    comparison: ModelComparison | None = None
    pose_noise: PoseNoiseFound | None = None
    views: ViewDistances | None = None
    magnification_at_ball: float | None = None
    view_matrices: Array | None = None
    assumed: tuple[Assumed, ...] = ()
    contradicted: tuple[Contradicted, ...] = ()
    tests: ScannerTests | None = None
    unseen: Unseen | None = None
    undistinguished: tuple[Undistinguished, ...] = ()
    provenance: Provenance | None = None


def build(f: Fitted) -> Calibration:
    """The calibration of a fit, with every check that applies to its model and arrangement."""
    used = f.linear.problem
    scanners = adjusted_scanners(used.scanners, f.free, f.delta)
    result = Calibration(
        scanner=scanners[0],
        T_HT=f.T_HT,
        balls=dict(zip(used.ball_ids, f.balls, strict=True)),
        tangent=(*tangent_names(used.ball_ids, f.free), *f.p_names),
        covariance=f.covariance,
        pose_id=used.pose_id,
        x_D=used.x_D,
        residuals=f.linear.r,
        chi2=f.chi2,
        dof=f.dof,
        parameters=parameter_list(f),
        observability=f.observability,
        outliers=_outliers(f),
        not_seen=used.not_seen,
        model=f.model,
        arrangement=f.arrangement,
        errors=f.errors,
        priors=dict(zip(f.free.names, (float(s) for s in f.free.sigma), strict=True)),
        assumed=f.assumed,
        contradicted=f.contradicted,
        explanations=() if f.tests is None else f.tests.explanations,
        unseen=f.unseen,
        converged=f.converged,
        status=f.status,
        hypotheses=f.diagnosis.hypotheses if f.diagnosis else (),
        comparison=f.comparison,
        pose_noise=f.pose_noise,
        views=f.views,
        widening=f.widening,
        expected_residual=f.expected_px,
        magnification_at_ball=f.magnification_at_ball,
        runs=scanners if len(scanners) > 1 else (),
        pivot=used.pivot,
        convention=used.convention,
        provenance=f.provenance,
    )
    scan = reference_of(result, used)
    result = replace(result, budget=scan_budget(result, used, f.linear, scan))
    if scan is not None:
        J = scan.J[:, :, : len(result.tangent)]
        result = replace(result, halves=halves_of(f.linear, J, scan.x_D, widening=f.widening))
    result = replace(result, stability=stability(f.linear, f.T_HT.R, f.everything, f.keep))
    evidence = evidence_of(f, result)
    judged = replace(result, checks=findings(evidence))
    if judged.verdict != "rejected":
        # where nothing fits, the ball's place and with it the size that it should have mean nothing
        require_ball_size(evidence.ball_size)
    return judged


def evidence_of(f: Fitted, result: Calibration) -> Evidence:
    """What the rules look at."""
    x, more = f.linear.problem.x_D, f.manipulator
    numbers = (f.chi2, f.fit_chi2, f.linear.r, f.covariance)
    return Evidence(
        model=f.model,
        arrangement=f.arrangement,
        converged=f.converged,
        finite=all(bool(np.isfinite(value).all()) for value in numbers),
        dof=f.dof,
        n_used=len(x),
        outliers=tuple(result.outliers),
        misfit=f.misfit,
        chi2=f.fit_chi2,
        chi2_dof=result.chi2_dof,
        widened=f.widens,
        residual_px=result.d_rms,
        expected_px=f.stated_px,
        spread_px=float(np.sqrt(np.mean(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))),
        scan_px=None if result.budget is None else result.budget.measured,
        stated_px=None if result.budget is None else result.budget.total,
        stated_words="" if result.budget is None else budget_words(result.budget, result.assumed),
        tests=f.tests,
        contradicted=f.contradicted,
        undistinguished=f.undistinguished,
        halves=result.halves,
        diagnosis=f.diagnosis,
        stability=result.stability,
        scatter=more.scatter,
        against_rigid=more.against_rigid,
        size=more.size,
        run_effects=more.run_effects,
        open_turns=more.open_turns,
        ball_size=ball_size_of(f),
        prior_pulls=tuple(
            (name, float(d / s))
            for name, d, s in zip(f.free.names, f.delta, f.free.sigma, strict=True)
            if np.isfinite(s)
        ),
    )


def ball_size_of(f: Fitted) -> BallSize | None:
    """What the silhouettes of the rows used say about the magnification."""
    used = f.linear.problem
    P = f.view_matrices
    if P is None:
        P = chain_matrices(used, adjusted_scanners(used.scanners, f.free, f.delta), f.T_HT)
    return measured_ball_size(used, P, f.balls[used.ball])


def parameter_list(f: Fitted) -> tuple[Parameter, ...]:
    """The estimated numbers with their standard uncertainties: angles of T_HT, t_HT, balls, freed ones, errors."""
    C, R = f.covariance, f.T_HT.R
    if f.unseen is not None:
        # the estimate answers to what no ball shows by its gain
        C = C + (f.unseen.gain * f.unseen.sigma**2) @ f.unseen.gain.T
    E = angles_by_tangent(R)
    u_angles = np.sqrt(np.einsum("ij,jk,ik->i", E, C[:3, :3], E))
    u = np.sqrt(np.maximum(np.diag(C), 0.0))
    result = [
        Parameter(name=f"phi_HT_{c}", value=float(a), u=float(s), unit="rad")
        for c, a, s in zip("xyz", angles_from_rotation(R), u_angles, strict=True)
    ]
    names = (*tangent_names(f.linear.problem.ball_ids, f.free)[3:], *f.p_names)
    values = np.concatenate([f.T_HT.t, f.balls.ravel(), f.free.value + f.delta, f.p])
    units = (*("mm",) * (3 + f.balls.size), *(unit_of(n) for n in f.free.names), *f.p_units)
    result += [
        Parameter(name=n, value=float(v), u=float(s), unit=unit)
        for n, v, s, unit in zip(names, values, u[3:], units, strict=True)
    ]
    return tuple(result)


def expected_px(linear: LinearFit) -> float:
    """d_rms that the covariances C of a fit explain, px, after the fit has used up its parameters."""
    n, m = len(linear.r), max(linear.J.shape[2] - len(linear.prior_rows), 0)
    total = float(np.trace(linear.C, axis1=1, axis2=2).mean())
    return float(np.sqrt(total * max(1.0 - m / (2 * n), 0.0)))


def magnification_at_balls(problem: Problem, scanners: tuple[Scanner, ...], T_HT: RigidTransform, t: Array) -> float:
    """Mean over the rows of d_SD over the distance of the ball from the source along the beam; t (n, 3), mm in M."""
    x_T = T_HT.apply((problem.R_MH @ t[:, :, None])[..., 0] + problem.t_MH)
    found = []
    for run, scanner in enumerate(scanners):
        mine = problem.run == run
        T_TW = scanner.T_TW(problem.alpha[mine])
        x_W = (T_TW.R @ x_T[mine][:, :, None])[..., 0] + T_TW.t
        found.append(scanner.d_SD / scanner.T_WS.apply(x_W)[:, 2])
    return float(np.mean(np.concatenate(found)))


def _outliers(f: Fitted) -> dict[str, str]:
    return {
        i: f"{d:.1f} standard deviations away, beyond what a clean run allows"
        for i, d, k in zip(f.everything.pose_id, np.sqrt(f.distance2), f.keep, strict=True)
        if not k
    }
