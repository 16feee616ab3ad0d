r"""Balls on a table that turns and nothing else: u_0, v_0, roll and tilts of the panel against the table's axis.

The commonest set of all.  A ball at (x, y, z) of T runs on a circle about the axis, and with R_z(alpha) the table,

    x_D = P_S T_WS R_z(alpha) (x, y, z; 1),

whose unknowns are the places of the balls and the scanner.  The circles know no azimuth (the balls take it), no height
of the source (v_0 is where they project to lines) and no length (d_SR is the scale), so of the eleven numbers of a
projection there remain d_SD, one ratio of pitches, u_0, v_0, eta, theta and phi.  W is *defined* by the axis and the
focal spot: axis_y and the tilts of the axis are zero, and what they would say is in u_0, eta, theta and phi.  The
geometry of single circles is that of Noo et al., Phys. Med. Biol. 45 (2000) 3489, and of Cho et al., Med. Phys. 32
(2005) 968; the estimate here is the maximum a posteriori of all centres at once, started where the rays of each ball
meet best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tomopose.calibration.build import magnification_at_balls
from tomopose.calibration.checks.conventions.alternatives import ALTERNATIVES
from tomopose.calibration.checks.conventions.hypothesis import Diagnosis, Hypothesis, compared, rank
from tomopose.calibration.checks.placement import require_on_panel
from tomopose.calibration.identified.calibrate import known_bars, pose_rows
from tomopose.calibration.identified.fit import ModelFit, fit_model
from tomopose.calibration.identified.hypothesis import hypothesis_of
from tomopose.calibration.identified.map_estimate import KinematicProblem, State, solve_map
from tomopose.calibration.identified.model_selection import judged
from tomopose.calibration.identified.result import calibration_of
from tomopose.calibration.identified.scatter import with_posterior_scatter
from tomopose.calibration.model.assumed import (
    WOBBLE_MM,
    WOBBLE_RAD,
    assumed_for,
    scatter_assumed,
    with_assumed,
)
from tomopose.calibration.model.parameters import (
    MATTERS,
    adjusted_scanners,
    base_name,
    free_parameters,
    unit_of,
)
from tomopose.calibration.model.problem import STILL_MM, STILL_RAD, Problem, pair, travel
from tomopose.calibration.model.silhouettes import chain_matrices
from tomopose.calibration.model.twin_projection import balls_from_rays
from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import freed_names
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import Repeatability
from tomopose.observations import BallObservations
from tomopose.provenance import provenance
from tomopose.values import require_types

AXIS = ("axis_y", "axis_tilt_x", "axis_tilt_y")
"""Zero by the definition of W."""

WANTED = ("u_0", "v_0", "eta")
"""What such a set determines well: estimated without a prior, unless scanner.json states one."""

FEWEST_ANGLES = 5

READINGS = (
    "rows flipped",
    "columns flipped",
    "image turned by 180 degrees",
    "image transposed",
    "table sign",
    "pairing lag -1",
    "pairing lag +1",
)
"""Alternatives that change what a turning table shows; the others are readings of poses."""

MIRRORED = "rows flipped"
"""A mirror image of the balls in a plane across the axis: no set of circles distinguishes it."""


@require_types
def calibrate_turntable(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    free: str | Sequence[str] = "auto",
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    robust: bool = True,
    hypotheses: bool = True,
) -> Calibration:
    """Find the scanner's values and the balls' places from balls on a table that turns.

    Parameters
    ----------
    scanner:      nominal values.  u_0, v_0 and eta need not be known; d_SR is the scale, with its uncertainty.
    poses:        table angles `alpha` that differ, and the plate at one pose throughout; `ball_id` where there are
                  several balls: at different heights and radii they show most.
    observations: as in `calibrate`.
    free, fix, priors: as in `calibrate`.
    distances:    (ball id, ball id) -> (distance, standard uncertainty), mm: a scale that d_SR need not give.
    robust:       set aside centres that do not belong.
    hypotheses:   try the other sense of the table, flipped images and a pairing lag.

    Returns
    -------
    A calibration whose T_HT is the identity by definition: the balls are in T, and matrices hold for scans that turn
    the table alone.

    Raises
    ------
    InputError           a plate that moves, or a table that does not turn.
    NotObservableError   a value that these circles do not determine.
    NotConvergedError    no optimum.
    """
    free, auto = freed_names(free)
    data = pair(scanner, poses, observations)
    require_on_panel(data)
    _require_turning(data)
    wanted = [n for n in WANTED if n not in scanner.sigma and n not in fix and n not in dict(priors or {})]
    free = tuple(dict.fromkeys([*free, *wanted]))
    assumed = assumed_for(scanner, free=free, fix=fix, priors=dict(priors or {}), no_effect=AXIS)
    held = [n for n in AXIS if n in scanner.sigma]
    axis: dict[str, Any] = dict.fromkeys(AXIS, 0.0)
    known = replace(with_assumed(scanner, assumed), **axis)
    freed = free_parameters((known,), free=free, fix=(*fix, *held), priors=priors)
    problem = KinematicProblem(
        data=replace(data, scanners=(known,)),
        poses=pose_rows(data, poses),
        free=freed,
        bars=known_bars(distances, data),
        repeatability=Repeatability(t_mm=WOBBLE_MM, w_rad=WOBBLE_RAD),
        mount_known=True,
    )
    fit = _fitted(problem, robust=robust, widen=auto)
    own = hypothesis_of(fit.estimate, name="declared", words="the data as declared", remedy="", outcome="declared")
    if own.fits:
        _require_determined(fit)
    chosen = _with_exact_mount(with_posterior_scatter(fit))
    diagnosis = _diagnosis(fit, own) if hypotheses else None
    e = chosen.estimate
    found = calibration_of(
        {"rigid": chosen},
        {"rigid": judged("rigid", chosen)},
        "rigid",
        asked="turntable",
        everything=problem.data,
        arrangement="turntable",
        magnification_at_ball=magnification_at_balls(
            e.problem.data,
            adjusted_scanners(e.problem.data.scanners, e.problem.free, e.state.delta),
            e.state.T_HT,
            e.state.balls[e.problem.data.ball],
        ),
        diagnosis=diagnosis,
        assumed=(*assumed, *scatter_assumed(WOBBLE_MM, WOBBLE_RAD, "default")),
        provenance=provenance(arguments={"arrangement": "turntable", "free": list(free), "fix": list(fix)}),
    )
    return replace(found, scanner=replace(found.scanner, sigma=scanner.sigma))


def _with_exact_mount(fit: ModelFit) -> ModelFit:
    """The steps of the iteration round the identity by 1e-27."""
    state = replace(fit.estimate.state, T_HT=RigidTransform.identity(Frame.H, Frame.T))
    return replace(fit, estimate=replace(fit.estimate, state=state))


def _require_turning(data: Problem) -> None:
    """InputError for poses of which this method knows nothing."""
    shifted, turned = travel(data.R_MH, data.t_MH)
    if turned > STILL_RAD or shifted > STILL_MM:
        raise InputError(
            f"the manipulator moves (by {shifted:.3g} mm and {turned:.3g} rad) while the table turns; this method is "
            "for a table that turns alone, calibrate without --arrangement turntable finds the mount too"
        )
    angles = np.unique(np.round(np.mod(data.alpha, 2 * np.pi), 9))
    if len(angles) < FEWEST_ANGLES:
        raise InputError(
            f"the table is at {len(angles)} angles only (alpha_deg); a circle needs at least {FEWEST_ANGLES}"
        )


def _start(problem: KinematicProblem) -> State:
    """The balls where their rays meet best under the nominal scanner."""
    data = problem.data
    T_HT = RigidTransform.identity(Frame.H, Frame.T)
    P = chain_matrices(data, data.scanners, T_HT)
    balls = balls_from_rays(P, data.x_D, data.ball, len(data.ball_ids))
    return State(T_HT=T_HT, balls=balls, delta=np.zeros(len(problem.free)), p=np.zeros(0))


def _fitted(problem: KinematicProblem, *, robust: bool, widen: bool) -> ModelFit:
    try:
        return fit_model(problem, _start(problem), robust=robust, widen=widen)
    except NotConvergedError as error:
        raise NotConvergedError(
            f"the balls' circles fit no scanner near the declared one ({error}); check the sense of alpha_deg, the "
            "orientation of the images and the pairing: tomopose diagnose --arrangement turntable tries them"
        ) from error


def _require_determined(fit: ModelFit) -> None:
    """NotObservableError for a value without a prior that stays less certain than what matters to a scan."""
    e = fit.estimate
    u = np.sqrt(np.diag(e.covariance))[6 + e.state.balls.size :]
    for name, sigma, own in zip(e.problem.free.names, e.problem.free.sigma, u, strict=True):
        if np.isinf(sigma) and own > 20.0 * MATTERS[base_name(name)]:
            raise NotObservableError(
                f"these circles determine {name} only to {own:.2g} {unit_of(name)}: add a ball at another height and "
                f"farther from the axis, or state its sigma in scanner.json",
                direction=name,
            )


def _diagnosis(fit: ModelFit, own: Hypothesis) -> Diagnosis:
    """The declared reading against the other sense of the table, other images and a lag."""
    found = [own]
    whole = replace(fit.whole, scatter=1.0)
    for alternative in ALTERNATIVES:
        changed = alternative.change(whole.data) if alternative.name in READINGS else None
        if changed is None:
            continue
        problem = replace(whole, data=changed, poses=_rows_of(whole.poses, changed))
        try:
            estimate = solve_map(problem, _start(problem))
        except NotConvergedError:
            # a wrong reading may lead anywhere; one that cannot be fitted is not the right one
            continue
        one = hypothesis_of(
            estimate,
            name=alternative.name,
            words=alternative.words,
            remedy=alternative.remedy,
            outcome="worse",
        )
        found.append(replace(compared(own, one), symmetry=alternative.name == MIRRORED))
    return Diagnosis(hypotheses=rank(found))


def _rows_of(poses: PoseSequence, data: Problem) -> PoseSequence:
    return replace(poses.select(poses.index_of(data.pose_id)), alpha=data.alpha)


@require_types
def diagnose_turntable(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
) -> Diagnosis:
    """Rank the readings that a turning table distinguishes; arguments as of `calibrate_turntable`."""
    found = calibrate_turntable(scanner, poses, observations, free=free or "none", fix=fix, robust=False)
    return Diagnosis(hypotheses=found.hypotheses)
