"""The manipulator's own errors, identified from the same radiographs as its mount.

A platform whose joints are off by 0.1 mm tilts other than its controller says; the radiographs of one ball in many
poses hold enough to find its errors, given its nominal geometry and how far its parts may be off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tomopose.calibration.checks.conventions.hypothesis import Diagnosis
from tomopose.calibration.identified.fit import ModelFit, fit_model
from tomopose.calibration.identified.geometry_prior import averaged
from tomopose.calibration.identified.map_estimate import KinematicProblem, State
from tomopose.calibration.identified.model_selection import SELECTION, better, judged
from tomopose.calibration.identified.pose_map import map_candidates
from tomopose.calibration.identified.result import calibration_of, comparison, scatter_of_fit
from tomopose.calibration.identified.scale_bars import require_balls_not_swapped
from tomopose.calibration.identified.scatter import with_posterior_scatter
from tomopose.calibration.model.parameters import FreeParameters, base_name, free_parameters
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.result import Calibration, ModelJudgement
from tomopose.errors import InputError, NotConvergedError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import RigidErrors
from tomopose.manipulator.files import hexapod_from_document, read_manipulator, serial_from_document
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.pose_map import PoseMap
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, Repeatability
from tomopose.manipulator.run_effects import with_run_effects
from tomopose.manipulator.serial import SerialRobot
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.units import Array

MODELS = ("auto", "rigid", "kinematic", "slack")


def calibrate_kinematic(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    rigid: Calibration,
    manipulator: ErrorModel | str | Path | Mapping[str, object] | None = None,
    model: str = "auto",
    free: FreeParameters | None = None,
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    view_sigma: Mapping[str, float] | None = None,
    inverse: bool = False,
    robust: bool = True,
    auto: bool = False,
) -> Calibration:
    """Find the mount, the balls and the manipulator's errors together: a maximum a posteriori estimate.

    Parameters
    ----------
    scanner, poses, observations: as in `calibrate`.
    rigid:        the calibration that trusts the poses: start, and the answer if auto finds no better.
    manipulator:  Hexapod, SerialRobot, content or path of hexapod.json or robot.json; None for "slack".
    model:        "kinematic": the machine's errors; "slack": scatter and a smooth map of pose errors, for machines
                  whose kinematics nobody knows; "rigid": none; "auto": kinematic if evidence and held-out poses say
                  that it is better, else rigid.
    free:         freed scanner parameters with priors; by default those of the rigid calibration.
    distances:    (ball id, ball id) -> (distance, standard uncertainty), mm: scale bars.
    view_sigma:   scanner parameter -> standard deviation of its scatter from view to view.
    inverse:      the table holds inverse poses, those of a scanner that moves.
    robust:       set aside centres that do not belong.
    auto:         free scanner values whose priors the images contradict beside the machine's errors.

    Raises
    ------
    InputError         a manipulator that does not fit, balls mixed up.
    TrajectoryError    poses that the platform cannot reach (OutOfReachError), singular poses.
    NotConvergedError  no optimum.
    """
    machine = machine_of(manipulator)
    _require_model(model, machine)
    data = pair(scanner, poses, observations)
    freed = _freed_as(rigid, data) if free is None else free
    problem = KinematicProblem(
        data=data,
        poses=pose_rows(data, poses),
        free=freed,
        bars=known_bars(distances, data),
        view_sigma=dict(view_sigma or {}),
        repeatability=Repeatability() if machine is None else machine.repeatability,
        inverse=inverse or isinstance(machine, InverseManipulator),
    )
    start = State(
        T_HT=rigid.T_HT,
        balls=np.array([rigid.balls[i] for i in data.ball_ids]),
        delta=_freed_values(rigid, freed) - freed.value,
        p=np.zeros(0),
    )
    needed = "kinematic" if model == "kinematic" else "rigid"
    fits = _fit_all(problem, start, _candidates(model, machine, problem, start), robust, needed=needed, widen=auto)
    best = max(fits.values(), key=lambda f: f.estimate.log_evidence)
    require_balls_not_swapped(best, problem)
    found = {name: judged(name, fit) for name, fit in fits.items()}
    chosen = _choose(model, found)
    if chosen == "rigid" and model == "auto" and not (problem.bars or problem.view_sigma):
        errors = RigidErrors(translation_scale=_scale_of(rigid), scatter=scatter_of_fit(fits["rigid"]))
        return replace(rigid, errors=errors, comparison=comparison(found, fits, chosen))
    fits[chosen] = averaged(with_posterior_scatter(fits[chosen]))
    earlier = {} if rigid.provenance is None else dict(rigid.provenance.arguments)
    return calibration_of(
        fits,
        found,
        chosen,
        asked=model,
        everything=data,
        arrangement="moving-scanner" if problem.inverse else rigid.arrangement,
        magnification_at_ball=rigid.magnification_at_ball,
        diagnosis=Diagnosis(hypotheses=rigid.hypotheses) if rigid.hypotheses else None,
        assumed=rigid.assumed,
        provenance=provenance(arguments={**earlier, "model": model}),
    )


def _require_model(model: str, machine: ErrorModel | None) -> None:
    if model not in MODELS:
        raise InputError(f"unknown model {model!r}; known are {', '.join(MODELS)}")
    if machine is None and model == "kinematic":
        raise InputError("model 'kinematic' needs the manipulator's nominal geometry (hexapod.json or robot.json)")


def _candidates(
    model: str, machine: ErrorModel | None, problem: KinematicProblem, start: State
) -> list[tuple[str, ErrorModel | None]]:
    """The error models among which the data choose, simplest first."""
    candidates: list[tuple[str, ErrorModel | None]] = [("rigid", None)]
    if model == "kinematic" or (model == "auto" and machine is not None):
        candidates.append(("kinematic", machine))
    if model == "slack":
        candidates += map_candidates(problem, start)
    return candidates


def _scale_of(rigid: Calibration) -> float:
    return rigid.errors.translation_scale if isinstance(rigid.errors, RigidErrors) else 1.0


def machine_of(manipulator: ErrorModel | str | Path | Mapping[str, object] | None) -> ErrorModel | None:
    """The error model meant by a model, a document or a path."""
    if manipulator is None or isinstance(manipulator, (Hexapod, SerialRobot, PoseMap, InverseManipulator)):
        return manipulator
    if isinstance(manipulator, (str, Path)):
        return read_manipulator(manipulator)
    if isinstance(manipulator, Mapping):
        schema = str(manipulator.get("schema", ""))
        if "base_joints_mm" in manipulator or "/hexapod/" in schema:
            return hexapod_from_document(manipulator, "manipulator")
        if "joints" in manipulator or "/serial/" in schema:
            return serial_from_document(manipulator, "manipulator")
    raise InputError(
        f"manipulator is {type(manipulator).__name__}; a Hexapod, a SerialRobot, the content of hexapod.json or "
        "robot.json or its path is needed"
    )


def pose_rows(data: Problem, poses: PoseSequence | Sequence[PoseSequence]) -> PoseSequence:
    """The commanded poses of the rows of `data`, with joint values where every run has them."""
    runs = [poses] if isinstance(poses, PoseSequence) else list(poses)
    parts = [run.select(data.index[data.run == r]) for r, run in enumerate(runs)]
    q = None if any(part.q is None for part in parts) else np.concatenate([np.asarray(part.q) for part in parts])
    return PoseSequence(
        T_MH=RigidTransform(R=data.R_MH, t=data.t_MH, source=Frame.M, target=Frame.H),
        pose_id=data.pose_id,
        alpha=data.alpha,
        ball_id=np.asarray(data.ball_ids)[data.ball],
        time_utc=data.time_utc,
        pivot=data.pivot,
        convention=data.convention,
        source=runs[0].source,
        q=q,
    )


def _freed_as(rigid: Calibration, data: Problem) -> FreeParameters:
    """What the rigid calibration freed, with the same priors."""
    priors = {base_name(name): sigma for name, sigma in rigid.priors.items()}
    held = [name for name in data.scanner.sigma if name not in priors]
    stated = {name: sigma for name, sigma in priors.items() if np.isfinite(sigma)}
    return free_parameters(data.scanners, free=sorted(priors), fix=held, priors=stated)


def _freed_values(rigid: Calibration, free: FreeParameters) -> Array:
    found = {p.name: p.value for p in rigid.parameters}
    return np.array([found.get(name, value) for name, value in zip(free.names, free.value, strict=True)])


def known_bars(
    distances: Mapping[tuple[int, int], tuple[float, float]] | None, data: Problem
) -> dict[tuple[int, int], tuple[float, float]]:
    """The scale bars, checked against the balls that were observed."""
    bars = {}
    for (a, b), (length, u) in dict(distances or {}).items():
        missing = [i for i in (a, b) if i not in data.ball_ids]
        if missing or a == b:
            raise InputError(f"distance between balls {a} and {b}: observed are balls {list(data.ball_ids)}")
        if not (np.isfinite([length, u]).all() and length > 0 and u > 0):
            raise InputError(f"distance between balls {a} and {b} is {length} +- {u} mm; two numbers > 0 are needed")
        bars[a, b] = (float(length), float(u))
    return bars


def _fit_all(
    problem: KinematicProblem,
    start: State,
    candidates: Sequence[tuple[str, ErrorModel | None]],
    robust: bool,
    needed: str,
    widen: bool,
) -> dict[str, ModelFit]:
    """The candidates' fits, simplest first, all on the rows that belong for the richest: evidence compares only so.

    A candidate without an optimum is left out, unless it is the rigid one or the one `needed`.
    """
    fits: dict[str, ModelFit] = {}
    keep, misfit = None, False
    for name, machine in reversed(candidates):
        own, begin = replace(problem, model=machine), start
        if machine is not None:
            begin = replace(start, p=np.zeros(len(machine.names)))
        try:
            if keep is None:
                fits[name] = _with_run_effects(own, fit_model(own, begin, robust=robust, widen=widen))
                keep, misfit = fits[name].keep, fits[name].misfit
            else:
                fits[name] = replace(fit_model(own, begin, keep=keep, widen=widen), misfit=misfit)
        except NotConvergedError:
            if name in ("rigid", needed):
                raise
    return dict(reversed(fits.items()))


def _with_run_effects(problem: KinematicProblem, fit: ModelFit) -> ModelFit:
    """The fit with drift and lag of the run beside the machine's errors, where more than its scatter is left and the
    evidence is for them; else the fit as it is."""
    estimate = fit.estimate
    machine = estimate.problem.model
    if machine is None or fit.scatter <= 1.0 or machine.kind == "map":
        return fit
    model = with_run_effects(machine, problem.poses)
    more = np.zeros(len(model.names) - len(machine.names))
    start = replace(estimate.state, p=np.concatenate([estimate.state.p, more]))
    try:
        other = fit_model(replace(problem, model=model, free=estimate.problem.free), start, keep=fit.keep)
    except NotConvergedError:
        return fit
    if other.estimate.log_evidence > estimate.log_evidence + SELECTION.evidence_gain:
        return replace(other, size=fit.size, misfit=fit.misfit, contradicted=fit.contradicted)
    return fit


def _choose(model: str, judged: Mapping[str, ModelJudgement]) -> str:
    if model in ("kinematic", "rigid"):
        return model
    if model == "auto":
        return "kinematic" if "kinematic" in judged and better(judged["kinematic"], judged["rigid"]) else "rigid"
    chosen = "rigid"
    for name in judged:
        if name != "rigid" and better(judged[name], judged[chosen]):
            chosen = name
    return chosen
