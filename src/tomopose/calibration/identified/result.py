"""A kinematic fit as a `Calibration`: parameters, doubts, and what the report shows beside the rigid model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.special import chdtri

from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.identified.map_estimate import singular_values
from tomopose.calibration.identified.model_selection import Judgement, better, by_rotation
from tomopose.calibration.identified.pose_map import determined_turns
from tomopose.calibration.model.covariance import WIDENING_PROBABILITY, angles_by_tangent
from tomopose.calibration.model.parameters import adjusted_scanners, translation_scale, unit_of
from tomopose.calibration.result import Calibration, Observability, Parameter
from tomopose.geometry.rotations import angles_from_rotation
from tomopose.manipulator.error_models import manipulator_block
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.real_poses import ErrorModel
from tomopose.manipulator.run_effects import WithRunEffects
from tomopose.manipulator.serial import SerialRobot
from tomopose.provenance import provenance
from tomopose.units import Array

RUN_EFFECTS_FOUND = (
    "during the run the manipulator drifted or its drives lagged (drift and lag are among the parameters): matrices "
    "apply the lag in the order of the scan's table, and count the drift, which a scan may show again, as scatter"
)
LARGE_SCATTER = 9.0
"""Times the stated variance: a scatter that means an error which no model here holds."""
KNOWN_SCALE = 0.5
"""Share of its prior variance above which the common scale of a robot's links counts as not measured."""


def comparison(judged: Mapping[str, Judgement], fits: Mapping[str, ModelFit], chosen: str) -> dict[str, Any]:
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
    C = e.covariance
    u = np.sqrt(np.diag(C))
    E = angles_by_tangent(e.state.T_HT.R)
    u_angles = np.sqrt(np.einsum("ij,jk,ik->i", E, C[:3, :3], E))
    result = [
        Parameter(name=f"phi_HT_{c}", value=float(a), u=float(s), unit="rad")
        for c, a, s in zip("xyz", angles_from_rotation(e.state.T_HT.R), u_angles, strict=True)
    ]
    values = np.concatenate([e.state.T_HT.t, e.state.balls.ravel(), free.value + e.state.delta, e.state.p])
    model = e.problem.model
    units = (
        *("mm",) * (3 + e.state.balls.size),
        *(unit_of(n) for n in free.names),
        *(() if model is None else model.units),
    )
    result += [
        Parameter(name=n, value=float(v), u=float(s), unit=unit)
        for n, v, s, unit in zip(e.problem.tangent[3:], values, u[3:], units, strict=True)
    ]
    return tuple(result)


def scatter_block(fit: ModelFit) -> dict[str, list[float]]:
    """Standard deviations of the plate from pose to pose, along H: its scatter, and the run's drift, which a scan may
    repeat."""
    problem = fit.estimate.problem
    variance = problem.scatter * problem.repeatability.variance
    if isinstance(problem.model, WithRunEffects):
        p = fit.estimate.state.p
        C = fit.estimate.covariance[-len(p) :, -len(p) :]
        variance = variance + problem.model.drift_variance(problem.poses, p, C)
    return {"t_mm": np.sqrt(variance[3:]).tolist(), "w_rad": np.sqrt(variance[:3]).tolist()}


def calibration_of(
    rigid: Calibration | None,
    fits: Mapping[str, ModelFit],
    judged: Mapping[str, Judgement],
    chosen: str,
    asked: str,
    ids: tuple[str, ...],
    doubts: tuple[str, ...],
) -> Calibration:
    fit = fits[chosen]
    e = fit.estimate
    problem, model = e.problem, e.problem.model
    data = problem.data
    block: dict[str, Any] = {}
    notes: list[str] = []
    lag = None
    if model is not None:
        before = len(e.problem.tangent) - len(model.names)
        if isinstance(model, WithRunEffects):
            last = model.drift.stop
            lag = {"names": list(model.names[last:]), "values": e.state.p[last:].tolist()}
            model = model.machine
            doubts = (*doubts, RUN_EFFECTS_FOUND)
        m = len(model.names)
        u = np.sqrt(np.diag(e.covariance))[before : before + m]
        block = manipulator_block(model, e.state.p[:m], u, problem.poses)
        scale = translation_scale(problem.free, e.state.delta)
        block |= {"translation_scale": scale} if scale != 1.0 else {}
        block |= {"lag": lag} if lag else {}
        gamma = m - float(np.sum((u / model.sigma) ** 2))
        notes.append(
            f"the radiographs determine {gamma:.1f} of {m} errors of the manipulator; the others, and shifts and turns "
            "of whole plates, which the mount and the ball take up, stay at their priors"
        )
        notes += _scale_note(model, e.covariance[before : before + m, before : before + m])
    block["scatter"] = scatter_block(fit)
    reasons = [*doubts, *_doubts(fit, judged, chosen)]
    if asked == "slack":
        sentence = determined_turns(e)
        if sentence:
            reasons.append(sentence)
    outliers = {
        str(i): f"residual beyond what a clean run allows: {d:.1f} standard deviations"
        for i, d, k in zip(ids, np.sqrt(fit.distance2), fit.keep, strict=True)
        if not k
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
        hypotheses=() if rigid is None else rigid.hypotheses,
        pivot=data.pivot,
        convention=data.convention,
        extra={
            **({"not_seen": dict(data.not_seen)} if data.not_seen else {}),
            **({"scanners": scanners} if len(scanners) > 1 else {}),
            **comparison(judged, fits, chosen),
        },
        provenance=provenance(
            arguments={
                **({} if rigid is None or rigid.provenance is None else dict(rigid.provenance.arguments)),
                "model": asked,
            }
        ),
    )


def _scale_note(model: ErrorModel, covariance: Array) -> list[str]:
    """The sentence where a robot's links tell the scale of everything, and no measurement does.

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
    cure = "a known distance" if robot is not model else "table angles or a known distance"
    return [
        f"all lengths of the robot together, the ball's offset and the distance to the source are known to "
        f"{np.sqrt(found):.1e} only, from the tolerances of its links: the scale of the scan is as uncertain, whatever "
        f"the poses; use {cure} between two balls"
    ]


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
