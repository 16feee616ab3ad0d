"""The calibration that trusts the poses: eq. (7) with what was assumed, the scatter of the poses, and all checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.build import Fitted, build, expected_px, magnification_at_balls
from tomopose.calibration.checks.conventions.alternative import Alternative
from tomopose.calibration.checks.conventions.alternatives import ALTERNATIVES
from tomopose.calibration.checks.conventions.diagnose import ranked, set_pose_alternative
from tomopose.calibration.checks.conventions.hypothesis import Diagnosis
from tomopose.calibration.checks.evidence.evidence import Undistinguished
from tomopose.calibration.checks.evidence.undistinguished import undistinguished_readings
from tomopose.calibration.checks.placement import require_on_panel
from tomopose.calibration.checks.score_tests.scanner_tests import ScannerTests, rows_to_test, scanner_tests
from tomopose.calibration.model.assumed import Assumed, scatter_assumed, taken_as_known, without_effect
from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS
from tomopose.calibration.model.covariance import widening
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import (
    UNITS,
    FreeParameters,
    ImpossibleScannerError,
    adjusted_scanners,
    base_name,
    free_parameters,
    translation_scale,
)
from tomopose.calibration.model.problem import STILL_MM, STILL_RAD, Problem, pair, travel
from tomopose.calibration.model.unseen import Unseen, unseen_of
from tomopose.calibration.result import Arrangement, Calibration, PoseNoiseFound
from tomopose.calibration.rigid.contradiction import NOTHING_FITS, Contradicted, contradicted
from tomopose.calibration.rigid.estimate import Solution, solve, with_pose_noise
from tomopose.calibration.rigid.fit import blocks
from tomopose.calibration.rigid.observability import observability
from tomopose.errors import NotConvergedError, NotObservableError
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.manipulator.error_models import PoseScatter, RigidErrors
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import Repeatability
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.units import Array


def assumed_names(free: FreeParameters) -> tuple[str, ...]:
    """The scanner parameters that are taken as known and that poses could in principle show."""
    held = {base_name(n) for n in free.names}
    drop = {"p_u", "p_v"} | ({"pitch_ratio"} if "p_u" in held else set())
    return tuple(n for n in UNITS if n not in held | drop)


def assumed_jacobian(solution: Solution, names: tuple[str, ...]) -> Array:
    """(n, 2, a): derivatives of the calculated centres by parameters that were held, px."""
    p = solution.used
    J_s = solution.at.J_scanner
    columns = [SCANNER_COLUMNS.index("p_u" if n == "pitch_ratio" else n) for n in names]
    factor = np.array([p.scanner.p_v if n == "pitch_ratio" else 1.0 for n in names])
    result: Array = J_s[:, :, columns] * factor
    return result


def _stated_chi2(solution: Solution, stated: Solution) -> float:
    """chi2 of the final residuals by the stated covariances of the centres alone, priors included."""
    W = stated.problem.select(solution.robust.keep).W
    r = solution.used.x_D - solution.x_calc
    prior = float((solution.free.information * solution.fit.delta**2).sum())
    return float(((W @ r[:, :, None]) ** 2).sum()) + prior


def _rigid(
    solution: Solution,
    stated: Solution,
    diagnosis: Diagnosis | None,
    arrangement: Arrangement,
    arguments: Mapping[str, object],
    taken: Taken,
) -> Calibration:
    p, fit, free = solution.used, solution.fit, solution.free
    tests = _tests(stated)  # before the fits' derivatives are held: of many balls both are large
    stated_px = expected_px(stated.linear)
    assumed = assumed_names(free)
    chi2 = _stated_chi2(solution, stated)
    noise, scatter = None, None
    if solution.noise is not None:
        scatter = PoseScatter(t=np.full(3, solution.noise.translation), w=np.full(3, solution.noise.rotation))
        noise = PoseNoiseFound(
            translation_mm=solution.noise.translation,
            rotation_rad=solution.noise.rotation,
            gain=solution.noise.gain,
            chi2_dof_with=solution.chi2 / solution.dof,
            chi2_dof_without=chi2 / solution.dof,
            found=solution.noise.found,
        )
    linear = solution.linear
    scanners = adjusted_scanners(p.scanners, free, fit.delta)
    scale = translation_scale(free, fit.delta)
    return build(
        Fitted(
            everything=solution.problem,
            keep=solution.robust.keep,
            distance2=solution.robust.distance2,
            linear=linear,
            T_HT=fit.T_HT,
            balls=fit.t,
            free=free,
            delta=fit.delta,
            p=np.zeros(0),
            p_names=(),
            p_units=(),
            covariance=solution.covariance,
            widening=widening(solution.chi2, solution.dof),
            widens=True,
            chi2=chi2,
            fit_chi2=solution.chi2,
            dof=solution.dof,
            converged=fit.converged,
            status=(f"optimum of {len(p)} poses reached" if fit.converged else fit.status.value),
            misfit=stated.robust.misfit,
            expected_px=expected_px(linear),
            stated_px=stated_px,
            model="rigid",
            arrangement=arrangement,
            errors=RigidErrors(translation_scale=scale, scatter=scatter),
            observability=observability(p, free, linear.J, assumed_jacobian(solution, assumed), assumed),
            diagnosis=diagnosis,
            pose_noise=noise,
            magnification_at_ball=magnification_at_balls(
                replace(p, t_MH=scale * p.t_MH), scanners, fit.T_HT, fit.t[p.ball]
            ),
            assumed=taken.assumed,
            contradicted=taken.contradicted,
            tests=tests,
            undistinguished=taken.undistinguished,
            unseen=_unseen(solution, linear, taken, moving_scanner=arrangement == "moving-scanner"),
            provenance=provenance(arguments=arguments),
        )
    )


@dataclass(frozen=True, kw_only=True)
class Taken:
    """assumed: of the scanner;  contradicted: values whose prior the images contradict, which were freed;  exact: names
    that the user holds;  undistinguished: readings of the orientation columns."""

    assumed: tuple[Assumed, ...]
    contradicted: tuple[Contradicted, ...] = ()
    exact: tuple[str, ...] = ()
    undistinguished: tuple[Undistinguished, ...] = ()


def _tests(solution: Solution) -> ScannerTests | None:
    """One effect after the other, on all rows but those that chance may have spoilt; None where nothing fits.

    With the stated sigmas alone: a scatter that was estimated from the effect would hide it.
    """
    if not solution.fit.converged or solution.chi2 > NOTHING_FITS * 2 * len(solution.used):
        return None
    rows = np.flatnonzero(rows_to_test(solution.robust.keep))
    problem = solution.used if len(rows) == len(solution.used) else solution.problem.select(rows)
    if 2 * len(problem) < len(solution.covariance) + FEWEST_TESTED:
        return None
    at = solution.at if problem is solution.used else blocks(problem, solution.free, solution.fit)
    return scanner_tests(problem, solution.free, solution.fit, at)


FEWEST_TESTED = 10
"""Equations beyond the unknowns that the tests need."""


def _unseen(solution: Solution, linear: LinearFit, taken: Taken, *, moving_scanner: bool) -> Unseen:
    """What no ball shows of table and manipulator, and how the estimate answers to it."""
    p, fit = solution.used, solution.fit
    return unseen_of(
        solution.at,
        fit.inverse,
        linear.J,
        linear.C,
        T_HT=fit.T_HT,
        origin=p.t_MH,
        alpha=p.alpha,
        moving_scanner=moving_scanner,
        scale_known="translation_scale" in (*taken.exact, *solution.free.names),
        measured=all(a.source != "default" for a in taken.assumed if a.name in PARAMETER_UNITS),
    )


def _require_moves(problem: Problem) -> None:
    """NotObservableError where nothing but the table moves."""
    shifted, turned = travel(problem.R_MH, problem.t_MH)
    if shifted < STILL_MM and turned < STILL_RAD and np.ptp(problem.alpha) > 0:
        raise NotObservableError(
            "the manipulator has one pose throughout and only the table turns: such a set says nothing of the mount "
            "T_HT; it determines u_0, v_0, roll and tilts of the panel and the places of the balls: --arrangement "
            "turntable (tp.calibrate_turntable). For the mount, image the ball in poses that move and turn the plate",
            direction="T_HT",
        )


def _scatter_assumed(pose_noise: str | tuple[float, float] | None, maker: Repeatability | None) -> tuple[Assumed, ...]:
    """What was assumed of the poses' scatter: the maker's repeatability, or a number that was given."""
    if pose_noise is None:
        return scatter_assumed(0.0, 0.0, "exact")
    if not isinstance(pose_noise, str):
        return scatter_assumed(float(pose_noise[0]), float(pose_noise[1]), "option")
    prior = Repeatability() if maker is None else maker
    return scatter_assumed(prior.t_mm, prior.w_rad, "default" if maker is None else "option")


def _by_assumed(
    problem: Problem, freed: FreeParameters, *, robust: bool, auto: bool
) -> tuple[Solution, FreeParameters, tuple[Contradicted, ...]]:
    """(solution, what is freed, what the images contradict) with the stated and assumed standard deviations."""
    stated = solve(problem, freed, robust=robust)
    if not auto:
        return stated, freed, ()
    freed, against = contradicted(stated.used, freed, stated.fit)
    if against:
        stated = solve(problem, freed, robust=robust, start=stated.fit)
    return stated, freed, against


def rigid_calibration(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    auto: bool = True,
    maker: Repeatability | None = None,
    robust: bool = True,
    hypotheses: bool | Sequence[Alternative] = True,
    pose_noise: str | tuple[float, float] | None = "auto",
    arrangement: Arrangement = "moving-object",
) -> tuple[Calibration, FreeParameters]:
    """The calibration that trusts the poses, and what was freed; arguments as of `calibrate`."""
    plain = pair(scanner, poses, observations)
    require_on_panel(plain)
    _require_moves(plain)
    no_effect = without_effect(plain.alpha, moving_scanner=arrangement == "moving-scanner")
    assumed, scanners, freed = taken_as_known(plain.scanners, free=free, fix=fix, priors=priors, no_effect=no_effect)
    problem = replace(plain, scanners=scanners)
    try:
        stated, freed, against = _by_assumed(problem, freed, robust=robust, auto=auto)
    except ImpossibleScannerError:
        # Something else is wrong, such as a convention: with the scanner as declared it shows.
        problem = replace(plain, scanners=tuple(replace(s, sigma={}) for s in plain.scanners))
        freed, against = free_parameters(problem.scanners, free=free, fix=fix), ()
        stated = solve(problem, freed, robust=robust)
    solution = with_pose_noise(stated, pose_noise, robust=robust, maker=maker)
    diagnosis: Diagnosis | None = None
    blind: tuple[Undistinguished, ...] = ()
    if hypotheses:
        other = set_pose_alternative(problem, poses)
        known = [*(ALTERNATIVES if isinstance(hypotheses, bool) else hypotheses), *([other] if other else [])]
        diagnosis = ranked(stated.used, freed, stated.fit, [a for a in known if a.quick], starts=0)
        if diagnosis.nothing_fits:
            diagnosis = ranked(stated.used, freed, stated.fit, known, starts=0)
        if arrangement == "moving-object":
            blind = undistinguished_readings(stated.used, freed, stated.fit, diagnosis, known)
    arguments = {
        "free": list(free),
        "fix": list(fix),
        "priors": dict(priors or {}),
        "robust": robust,
        "pose_noise": pose_noise if pose_noise is None or isinstance(pose_noise, str) else list(pose_noise),
    }
    taken = Taken(
        assumed=(*assumed, *_scatter_assumed(pose_noise, maker)),
        contradicted=against,
        exact=tuple(fix),
        undistinguished=blind,
    )
    found = _rigid(solution, stated, diagnosis, arrangement, arguments, taken)
    found = replace(found, scanner=replace(found.scanner, sigma=plain.scanner.sigma))
    if not found.converged:
        raise NotConvergedError(found.status, calibration=found)
    return found, freed
