"""A fit of the manipulator's errors as a `Calibration`, and what the report shows beside the rigid model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tomopose.calibration.build import Fitted, ManipulatorEvidence, build, expected_px
from tomopose.calibration.checks.conventions.hypothesis import Diagnosis
from tomopose.calibration.checks.evidence.evidence import RAISED_SCATTER, AgainstRigid, ScatterFound
from tomopose.calibration.checks.evidence.measures import EFFECT_SHARE
from tomopose.calibration.checks.score_tests.fit_tests import score_tests
from tomopose.calibration.checks.score_tests.scanner_tests import ScannerTests, rows_to_test
from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.identified.map_estimate import blocks_of, linear_at, linear_fit, linearise, singular_values
from tomopose.calibration.identified.model_selection import better, by_rotation
from tomopose.calibration.identified.pose_map import determined_turns
from tomopose.calibration.model.assumed import Assumed
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import translation_scale
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.unseen import Unseen, unseen_of
from tomopose.calibration.result import Arrangement, Calibration, ModelComparison, ModelJudgement
from tomopose.calibration.rigid.contradiction import NOTHING_FITS
from tomopose.calibration.rigid.observability import Observability
from tomopose.manipulator.error_models import (
    EmpiricalErrors,
    Errors,
    IdentifiedErrors,
    Lag,
    PoseRange,
    PoseScatter,
    RigidErrors,
    TwinErrors,
)
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.pose_map import PoseMap
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel
from tomopose.manipulator.run_effects import WithRunEffects
from tomopose.manipulator.serial import SerialRobot
from tomopose.manipulator.twin import TwinRobots
from tomopose.provenance import Provenance
from tomopose.units import Array

KNOWN_SCALE = 0.5
"""Share of its prior variance above which the common scale of a robot's links counts as not measured."""


def comparison(judged: Mapping[str, ModelJudgement], fits: Mapping[str, ModelFit], chosen: str) -> ModelComparison:
    """What the report shows: the models side by side, and their residuals by axis of rotation."""
    shown = dict.fromkeys(("rigid", chosen if chosen != "rigid" else list(fits)[-1]))
    problem = fits["rigid"].estimate.problem
    residuals = {name: fits[name].estimate.at.r for name in shown}
    return ModelComparison(
        models=tuple(judged.values()),
        chosen=chosen,
        by_rotation=by_rotation(problem.poses, residuals, problem.data.scanner),
    )


def scatter_of_fit(fit: ModelFit) -> PoseScatter:
    """Standard deviations of the plate from pose to pose, along H: its scatter, and the run's drift, which a scan may
    repeat."""
    problem = fit.estimate.problem
    variance = problem.scatter * problem.repeatability.variance
    if isinstance(problem.model, WithRunEffects):
        p = fit.estimate.state.p
        C = fit.estimate.covariance[-len(p) :, -len(p) :]
        variance = variance + problem.model.drift_variance(problem.poses, p, C)
    return PoseScatter(t=np.sqrt(variance[3:]), w=np.sqrt(variance[:3]), about_H=problem.inverse)


def _errors(fit: ModelFit, source_poses: PoseSequence | None) -> Errors:
    """The errors that a fit found; source_poses: of twin robots, the source's table of the poses used."""
    e = fit.estimate
    model, p, scatter = e.problem.model, e.state.p, scatter_of_fit(fit)
    scale = translation_scale(e.problem.free, e.state.delta)
    if model is None:
        return RigidErrors(translation_scale=scale, scatter=scatter)
    u = np.sqrt(np.diag(e.covariance))[len(e.covariance) - len(p) :]
    limits = PoseRange.of(e.problem.poses)
    if isinstance(model, TwinRobots):
        return TwinErrors(
            detector=model.detector,
            source=model.source,
            base=model.base,
            focus=model.focus,
            base_t_sigma=model.base_t_sigma,
            base_w_sigma=model.base_w_sigma,
            focus_sigma=model.focus_sigma,
            values=p,
            u=u,
            range=limits,
            source_range=PoseRange.of(model.source_poses if source_poses is None else source_poses),
            scatter=scatter,
        )
    lag = None
    if isinstance(model, WithRunEffects):
        last = model.drift.stop
        lag = Lag(names=model.names[last:], values=p[last:])
        model = model.machine
    m = len(model.names)
    of = EmpiricalErrors if isinstance(model, PoseMap) else IdentifiedErrors
    return of(machine=model, values=p[:m], u=u[:m], range=limits, scatter=scatter, lag=lag, translation_scale=scale)


def _notes(fit: ModelFit) -> list[str]:
    """What the radiographs determine of the errors, and what they do not."""
    e = fit.estimate
    model = e.problem.model
    if model is None:
        return []
    before = len(e.problem.tangent) - len(model.names)
    if isinstance(model, WithRunEffects):
        model = model.machine
    m = len(model.names)
    u = np.sqrt(np.diag(e.covariance))[before : before + m]
    gamma = m - float(np.sum((u / model.sigma) ** 2))
    return [
        f"the radiographs determine {gamma:.1f} of {m} errors of the manipulator; the others, and shifts and turns of "
        "whole plates, which the mount and the ball take up, stay at their priors",
        *_scale_note(model, e.covariance[before : before + m, before : before + m]),
    ]


def _stated_px(fit: ModelFit) -> float:
    """d_rms that the stated covariances explain, with the stated repeatability."""
    e = fit.estimate
    problem = e.problem
    if problem.scatter == 1.0:
        return expected_px(linear_fit(e))
    linear = linear_fit(e)
    n, m = len(linear.r), max(linear.J.shape[2] - len(linear.prior_rows), 0)
    at = linearise(replace(problem, scatter=1.0), e.state)
    total = float(np.trace(at.C, axis1=1, axis2=2).mean())
    return float(np.sqrt(total * max(1.0 - m / (2 * n), 0.0)))


def _manipulator_evidence(
    fit: ModelFit, judged: Mapping[str, ModelJudgement], chosen: str, asked: str
) -> ManipulatorEvidence:
    e = fit.estimate
    repeatability = e.problem.repeatability
    return ManipulatorEvidence(
        scatter=ScatterFound(ratio=fit.scatter, t_mm=repeatability.t_mm, w_rad=repeatability.w_rad),
        against_rigid=None
        if chosen == "rigid"
        else AgainstRigid(
            chosen_px=judged[chosen].cv_rms,
            rigid_px=judged["rigid"].cv_rms,
            better=better(judged[chosen], judged["rigid"]),
        ),
        size=fit.size,
        run_effects=isinstance(e.problem.model, WithRunEffects),
        open_turns=determined_turns(e) if asked == "slack" else "",
    )


def calibration_of(
    fits: Mapping[str, ModelFit],
    judged: Mapping[str, ModelJudgement],
    chosen: str,
    *,
    asked: str,
    everything: Problem,
    arrangement: Arrangement,
    magnification_at_ball: float | None,
    diagnosis: Diagnosis | None = None,
    assumed: tuple[Assumed, ...] = (),
    source_poses: PoseSequence | None = None,
    view_matrices: Array | None = None,
    provenance: Provenance | None = None,
) -> Calibration:
    """The calibration by the model `chosen`.  everything: all rows that were paired, those set aside too;
    view_matrices: of `build.Fitted`."""
    fit = fits[chosen]
    e = fit.estimate
    problem, model = e.problem, e.problem.model
    name = "slack" if asked == "slack" else chosen
    linear = linear_fit(e)
    return build(
        Fitted(
            everything=everything,
            keep=fit.keep,
            distance2=fit.distance2,
            linear=linear,
            T_HT=e.state.T_HT,
            balls=e.state.balls,
            free=problem.free,
            delta=e.state.delta,
            p=e.state.p,
            p_names=() if model is None else model.names,
            p_units=() if model is None else model.units,
            covariance=e.covariance,
            widening=1.0,
            widens=False,
            chi2=e.chi2,
            fit_chi2=e.chi2,
            dof=e.dof,
            converged=True,
            status=f"optimum of {len(problem.data)} poses reached with the {name} model",
            misfit=fit.misfit,
            expected_px=expected_px(linear),
            stated_px=_stated_px(fit),
            model=name,
            arrangement=arrangement,
            errors=_errors(fit, source_poses),
            observability=Observability(singular_values=singular_values(e), notes=tuple(_notes(fit))),
            manipulator=_manipulator_evidence(fit, judged, chosen, asked),
            diagnosis=diagnosis,
            comparison=comparison(judged, fits, chosen),
            magnification_at_ball=magnification_at_ball,
            view_matrices=view_matrices,
            assumed=assumed,
            contradicted=fit.contradicted,
            tests=_tests(fit),
            unseen=_unseen(fit, linear),
            provenance=provenance,
        )
    )


def _tests(fit: ModelFit) -> ScannerTests | None:
    """One effect after the other, on all rows but those that chance may have spoilt; None where nothing fits."""
    e = fit.estimate
    if e.chi2 > NOTHING_FITS * 2 * len(e.problem.data):
        return None
    problem = fit.whole.rows(rows_to_test(fit.keep))
    # what a twin's robots may do is in its errors; a table that turns alone has no manipulator
    still = isinstance(problem.model, TwinRobots) or problem.mount_known
    without = ("manipulator",) if still else ()
    at, b = linear_at(problem, e.state), blocks_of(problem, e.state)
    # backlash and other play of a machine are no white noise, of which chance makes what looks significant
    played = fit.scatter > RAISED_SCATTER or isinstance(problem.model, WithRunEffects)
    least = EFFECT_SHARE if played else 0.0
    return score_tests(at, b, problem.free, e.state.delta, without=without, least_share=least)


def _unseen(fit: ModelFit, linear: LinearFit) -> Unseen | None:
    """What no ball shows; of twin robots the tolerances of links and set-up hold the scale of everything."""
    e = fit.estimate
    problem = e.problem
    if isinstance(problem.model, TwinRobots):
        return None
    return unseen_of(
        blocks_of(problem, e.state),
        e.covariance,
        linear.J,
        linear.C,
        T_HT=e.state.T_HT,
        origin=problem.data.t_MH,
        alpha=problem.data.alpha,
        moving_scanner=problem.inverse,
        # identified errors of a machine hold the scale that its parts state
        scale_known=len(e.state.p) > 0,
    )


def _scale_note(model: ErrorModel, covariance: Array) -> list[str]:
    """The sentence where only a robot's links state the scale of everything, and no measurement does.

    The common factor s of all lengths l_i with priors sigma_i is estimated by sum(l_i p_i / sigma_i^2) / sum(l_i^2 /
    sigma_i^2), with the prior variance 1 / sum(l_i^2 / sigma_i^2); a variance hardly below that is no measurement.
    """
    robot = model.machine if isinstance(model, InverseManipulator) else model
    if not isinstance(robot, SerialRobot):
        return []
    length = robot.lengths / robot.sigma**2
    prior = 1 / max(float(robot.lengths @ length), 1e-30)
    found = prior * float(length @ covariance @ length) * prior
    if found < KNOWN_SCALE * prior:
        return []
    remedy = "a known distance" if robot is not model else "table angles or a known distance"
    return [
        f"all lengths of the robot together, the ball's offset and the distance to the source are known to "
        f"{np.sqrt(found):.1e} only, from the tolerances of its links: the scale of the scan is as uncertain, whatever "
        f"the poses; use {remedy} between two balls"
    ]
