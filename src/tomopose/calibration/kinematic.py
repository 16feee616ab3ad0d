"""The manipulator's own errors, identified from the same radiographs as its mount.

A platform whose joints are off by 0.1 mm tilts other than its controller says; the radiographs of one ball in many
poses hold enough to find its errors, given its nominal geometry and how far its parts may be off.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from tomopose.calibration.kinematic_fit import ModelFit, fit_model
from tomopose.calibration.kinematic_solve import KinematicProblem, State, singular_values
from tomopose.calibration.model_choice import EVIDENCE_GAIN, Judgement, better, by_rotation, judge
from tomopose.calibration.multi_ball import require_balls_not_swapped
from tomopose.calibration.parameters import (
    FreeParameters,
    adjusted_scanners,
    free_parameters,
    translation_scale,
    unit_of,
)
from tomopose.calibration.problem import Problem, pair
from tomopose.calibration.result import Calibration, Observability, Parameter
from tomopose.calibration.run_changes import change_in_words, find_change, require_same_pivot
from tomopose.calibration.slack import determined_turns, map_candidates
from tomopose.calibration.uncertainty import WIDENING_PROBABILITY, angles_by_tangent
from tomopose.errors import InputError, NotConvergedError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import angles_from_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import manipulator_block
from tomopose.manipulator.files import hexapod_from_document, read_manipulator, serial_from_document
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.pose_map import PoseMap
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, Repeatability
from tomopose.manipulator.run_effects import WithRunEffects, with_run_effects
from tomopose.manipulator.serial import SerialRobot
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.units import Array

MODELS = ("auto", "rigid", "kinematic", "slack")
RUN_EFFECTS_FOUND = (
    "during the run the manipulator drifted or its drives lagged (drift and lag are among the parameters): the scan "
    "may be off by as much again"
)
LARGE_SCATTER = 9.0
"""A scatter whose variance is this many times the stated one means an error that no model here holds."""


def calibrate_kinematic(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    rigid: Calibration,
    manipulator: Any = None,
    model: str = "auto",
    free: FreeParameters | None = None,
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    view_sigma: Mapping[str, float] | None = None,
    robust: bool = True,
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
    robust:       set aside centres that do not belong.

    Raises
    ------
    InputError         a manipulator that does not fit, balls mixed up, a pivot that changed during the run.
    OutOfReachError    poses that the platform cannot reach.
    TrajectoryError    singular poses.
    NotConvergedError  no optimum.
    """
    if model not in MODELS:
        raise InputError(f"unknown model {model!r}; known are {', '.join(MODELS)}")
    machine = machine_of(manipulator)
    if machine is None and model == "kinematic":
        raise InputError("model 'kinematic' needs the manipulator's nominal geometry (hexapod.json or robot.json)")
    data = pair(scanner, poses, observations)
    freed = _freed_as(rigid, data) if free is None else free
    problem = KinematicProblem(
        data=data,
        poses=pose_rows(data, poses),
        free=freed,
        bars=_known_bars(distances, data),
        view_sigma=dict(view_sigma or {}),
        repeatability=Repeatability() if machine is None else machine.repeatability,
    )
    start = State(
        T_HT=rigid.T_HT,
        balls=np.array([rigid.balls[i] for i in data.ball_ids]),
        delta=_freed_values(rigid, freed) - freed.value,
        p=np.zeros(0),
    )
    candidates: list[tuple[str, ErrorModel | None]] = [("rigid", None)]
    if model == "kinematic" or (model == "auto" and machine is not None):
        candidates.append(("kinematic", machine))
    if model == "slack":
        candidates += map_candidates(problem, start)
    fits = _fit_all(problem, start, candidates, robust, needed="kinematic" if model == "kinematic" else "rigid")
    doubts = _sound_run(fits, problem)
    judged = {name: judge(name, fit) for name, fit in fits.items()}
    chosen = _choose(model, judged)
    if chosen == "rigid" and model == "auto":
        return replace(rigid, extra={**rigid.extra, **_comparison(judged, fits, chosen)})
    return _calibration(rigid, fits, judged, chosen, model, data.pose_id, doubts)


def machine_of(manipulator: Any) -> ErrorModel | None:
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
    known = 6 + 3 * len(rigid.balls)
    names = {name.split("[")[0] for name in rigid.tangent[known:]}
    arguments = {} if rigid.provenance is None else rigid.provenance.arguments
    held = [name for name in data.scanner.sigma if name not in names]
    return free_parameters(data.scanners, free=sorted(names), fix=held, priors=arguments.get("priors"))


def _freed_values(rigid: Calibration, free: FreeParameters) -> Array:
    found = {p.name: p.value for p in rigid.parameters}
    return np.array([found.get(name, value) for name, value in zip(free.names, free.value, strict=True)])


def _known_bars(
    distances: Mapping[tuple[int, int], tuple[float, float]] | None, data: Problem
) -> dict[tuple[int, int], tuple[float, float]]:
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
    problem: KinematicProblem, start: State, candidates: Sequence[tuple[str, ErrorModel | None]], robust: bool,
    needed: str,
) -> dict[str, ModelFit]:
    """The candidates' fits, simplest first, all on the rows that belong for the richest: evidence compares only so.

    A candidate without an optimum is left out, unless it is the rigid one or the one `needed`.
    """
    fits: dict[str, ModelFit] = {}
    keep = None
    for name, machine in reversed(candidates):
        own, begin = replace(problem, model=machine), start
        if machine is not None:
            begin = replace(start, p=np.zeros(len(machine.names)))
        try:
            if keep is None:
                fits[name] = _with_run_effects(own, fit_model(own, begin, robust=robust))
                keep = fits[name].keep
            else:
                fits[name] = fit_model(own, begin, keep=keep)
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
        other = fit_model(replace(problem, model=model), start, keep=fit.keep, resize=False)
    except NotConvergedError:
        return fit
    return replace(other, size=fit.size) if other.estimate.log_evidence > estimate.log_evidence + EVIDENCE_GAIN else fit


def _sound_run(fits: Mapping[str, ModelFit], problem: KinematicProblem) -> tuple[str, ...]:
    """Doubts about the run itself, judged with the model that fits best; InputError where it cannot be used."""
    fit = max(fits.values(), key=lambda f: f.estimate.log_evidence)
    require_balls_not_swapped(fit, problem)
    change = find_change(fit)
    require_same_pivot(fit, change)
    return () if change is None else (change_in_words(fit, change),)


def _choose(model: str, judged: Mapping[str, Judgement]) -> str:
    if model in ("kinematic", "rigid"):
        return model
    if model == "auto":
        return "kinematic" if "kinematic" in judged and better(judged["kinematic"], judged["rigid"]) else "rigid"
    chosen = "rigid"
    for name in judged:
        if name != "rigid" and better(judged[name], judged[chosen]):
            chosen = name
    return chosen


def _comparison(
    judged: Mapping[str, Judgement], fits: Mapping[str, ModelFit], chosen: str
) -> dict[str, Any]:
    """What the report shows: the models side by side, and their residuals by axis of rotation."""
    shown = dict.fromkeys(("rigid", chosen if chosen != "rigid" else list(fits)[-1]))
    problem = fits["rigid"].estimate.problem
    residuals = {name: fits[name].estimate.at.r for name in shown}
    return {
        "models": [j.to_json() for j in judged.values()],
        "model_chosen": chosen,
        "by_rotation": by_rotation(problem.poses, residuals, problem.data.scanner),
    }


def _parameters(fit: ModelFit) -> tuple[Parameter, ...]:
    e, free = fit.estimate, fit.estimate.problem.free
    u = np.sqrt(np.diag(e.covariance))
    E = angles_by_tangent(e.state.T_HT.R)
    u_angles = np.sqrt(np.einsum("ij,jk,ik->i", E, e.covariance[:3, :3], E))
    result = [
        Parameter(name=f"phi_HT_{c}", value=float(a), u=float(s), unit="rad")
        for c, a, s in zip("xyz", angles_from_rotation(e.state.T_HT.R), u_angles, strict=True)
    ]
    values = np.concatenate([e.state.T_HT.t, e.state.balls.ravel(), free.value + e.state.delta, e.state.p])
    model = e.problem.model
    units = (
        *("mm",) * (3 + e.state.balls.size), *(unit_of(n) for n in free.names), *(() if model is None else model.units)
    )
    result += [
        Parameter(name=n, value=float(v), u=float(s), unit=unit)
        for n, v, s, unit in zip(e.problem.tangent[3:], values, u[3:], units, strict=True)
    ]
    return tuple(result)


def _calibration(
    rigid: Calibration, fits: Mapping[str, ModelFit], judged: Mapping[str, Judgement], chosen: str, asked: str,
    ids: tuple[str, ...], doubts: tuple[str, ...],
) -> Calibration:
    fit = fits[chosen]
    e = fit.estimate
    problem, model = e.problem, e.problem.model
    data = problem.data
    block: dict[str, Any] = {}
    notes: list[str] = []
    if model is not None:
        before = len(e.problem.tangent) - len(model.names)
        if isinstance(model, WithRunEffects):
            model = model.machine  # drift and lag of this run are no property of the machine
            doubts = (*doubts, RUN_EFFECTS_FOUND)
        m = len(model.names)
        u = np.sqrt(np.diag(e.covariance))[before : before + m]
        block = manipulator_block(model, e.state.p[:m], u, problem.poses)
        scale = translation_scale(problem.free, e.state.delta)
        block |= {"translation_scale": scale} if scale != 1.0 else {}
        gamma = m - float(np.sum((u / model.sigma) ** 2))
        notes.append(
            f"the radiographs determine {gamma:.1f} of {m} errors of the manipulator; the others, and shifts and turns "
            "of whole plates, which the mount and the ball take up, stay at their priors"
        )
    block["scatter"] = {
        "t_mm": problem.repeatability.t_mm * np.sqrt(problem.scatter),
        "w_rad": problem.repeatability.w_rad * np.sqrt(problem.scatter),
    }
    reasons = [*doubts, *_doubts(fit, judged, chosen)]
    if asked == "slack":
        sentence = determined_turns(e)
        if sentence:
            reasons.append(sentence)
    outliers = {
        str(i): f"residual beyond what a clean run allows: {d:.1f} standard deviations"
        for i, d, k in zip(ids, np.sqrt(fit.distance2), fit.keep, strict=True) if not k
    }
    name = "slack" if asked == "slack" else chosen
    scanners = adjusted_scanners(data.scanners, problem.free, e.state.delta)
    return Calibration(
        scanner=scanners[0],
        T_HT=e.state.T_HT,
        balls=dict(zip(data.ball_ids, e.state.balls, strict=True)),
        tangent=problem.tangent,
        covariance=e.covariance,
        pose_id=data.pose_id,
        x_D=data.x_D,
        residuals=e.at.r,
        chi2=e.chi2,
        dof=e.dof,
        parameters=_parameters(fit),
        observability=Observability(singular_values=singular_values(e), notes=tuple(notes)),
        outliers=outliers,
        model=name,
        manipulator=block,
        converged=True,
        status=f"optimum of {len(data)} poses reached with the {name} model",
        verdict="doubtful" if reasons else "trustworthy",
        reasons=tuple(reasons),
        hypotheses=rigid.hypotheses,
        pivot=data.pivot,
        convention=data.convention,
        extra={
            **{k: v for k, v in rigid.extra.items() if k in ("not_seen",)},
            **({"scanners": scanners} if len(scanners) > 1 else {}),
            **_comparison(judged, fits, chosen),
        },
        provenance=provenance(
            arguments={**({} if rigid.provenance is None else dict(rigid.provenance.arguments)), "model": asked}
        ),
    )


def _doubts(fit: ModelFit, judged: Mapping[str, Judgement], chosen: str) -> Iterator[str]:
    """Why a result is to be used with care."""
    e = fit.estimate
    if fit.scatter > LARGE_SCATTER:
        r = e.problem.repeatability
        um, urad = 1000 * r.t_mm * np.sqrt(fit.scatter), 1e6 * r.w_rad * np.sqrt(fit.scatter)
        yield (
            f"poses scatter {np.sqrt(fit.scatter):.1f} times as much as the manipulator's repeatability says "
            f"({um:.2g} um, {urad:.2g} urad): an error that this model does not hold (backlash, drift)"
        )
    elif e.chi2 > chdtri(max(e.dof, 1), WIDENING_PROBABILITY) and e.dof > 0:
        yield f"chi2/dof is {e.chi2 / e.dof:.2f}: the stated uncertainties do not explain the residuals"
    if chosen != "rigid" and not better(judged[chosen], judged["rigid"]):
        yield (
            f"held-out poses are not predicted better than by trusting the poses ({judged[chosen].cv_rms:.4f} px, "
            f"rigid {judged['rigid'].cv_rms:.4f} px); use model auto"
        )
    if fit.size > 5.0:
        yield (
            f"the identified errors are {fit.size:.1f} times as large as the machine's file says; check its geometry "
            "and units"
        )
