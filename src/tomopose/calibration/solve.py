"""Eq. (7) solved: from observed centres to the mount T_HT and the ball t, with uncertainty and a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tomopose.calibration.checks.conventions.alternative import Alternative
from tomopose.calibration.result import Calibration
from tomopose.calibration.rigid.contradiction import as_stated
from tomopose.calibration.trusted_poses import rigid_calibration
from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, Repeatability
from tomopose.observations import BallObservations
from tomopose.values import require_types

CONVENTION_RULE = "convention not distinguished"
"""Found by poses that are trusted, and true of every model."""

MODELS = ("auto", "rigid", "kinematic", "slack")


@require_types
def calibrate(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    manipulator: ErrorModel | str | Path | Mapping[str, object] | None = None,
    model: str = "auto",
    free: str | Sequence[str] = "auto",
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    robust: bool = True,
    hypotheses: bool | Sequence[Alternative] = True,
    pose_noise: str | Repeatability | tuple[float, float] | None = "auto",
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
) -> Calibration:
    """Find T_HT and t from radiographs of one ball.  Eq. (7), in one step, from no start value.

    Parameters
    ----------
    scanner:      intrinsic geometry; values with a prior standard deviation (`scanner.sigma`) are estimated with it, 0
                  is exact, and those without any get a documented default (`model.assumed`).
    poses:        the manipulator's poses with table angles and ball ids.
    observations: projected ball centres (px) with covariance, paired with the poses by pose_id.
                  Sequences of the three solve several runs (magnifications) of one mount together.
    manipulator:  a nominal hexapod or robot, needed for model "kinematic".
    model:        "rigid" trusts the poses; "kinematic" and "slack" identify the manipulator's errors too; "auto" is
                  "rigid" without a manipulator, and otherwise what predicts held-out poses best.
    free:         "auto": a scanner value whose stated or assumed standard deviation the images contradict is freed,
                  and the first line says so; "none": none is; or names to estimate without a prior.
    fix:          names of scanner values to hold: exact; see `parameters.UNITS`.
    priors:       name -> prior standard deviation (mm, px, rad), in place of the scanner's.
    robust:       set aside centres that do not belong, and list them.
    hypotheses:   try the cheap alternative conventions (or those given) and say so in the verdict; all of them
                  where neither these nor the declared one fit.
    pose_noise:   scatter of the manipulator about the poses it reports: "auto" estimates it as the root mean of
                  its posterior, never tested to zero; (mm, rad) states it; None has none.  Its prior is the maker's
                  repeatability: a Repeatability given here, else the manipulator's file's or the paper's hexapod's.
    distances:    (ball id, ball id) -> (distance, standard uncertainty), mm: scale bars.  With them the balls are
                  solved for by the estimator of the manipulator's errors, so model must not be "rigid".

    Raises
    ------
    InputError          unknown ids or names, too few poses.
    NotObservableError  a direction that the poses (with the priors) cannot determine, in words.
    NotConvergedError   no optimum; its `calibration` is as far as it came.
    """
    trusts_poses = model == "rigid" or (model == "auto" and manipulator is None)
    _require_model(model, has_geometry=manipulator is not None, distances=bool(distances) and trusts_poses)
    free, auto = freed_names(free)
    rigid, freed = rigid_calibration(
        scanner,
        poses,
        observations,
        free=free,
        auto=auto,
        maker=pose_noise if isinstance(pose_noise, Repeatability) else maker_of(manipulator),
        fix=fix,
        priors=priors,
        robust=robust,
        hypotheses=hypotheses,
        pose_noise="auto" if isinstance(pose_noise, Repeatability) else pose_noise,
    )
    rigid = _said(rigid, model)
    # a manipulator's errors, fitted to a wrong reading of the data, explain anything
    if trusts_poses or rigid.verdict == "rejected":
        return rigid
    from tomopose.calibration.identified.calibrate import calibrate_kinematic

    found = calibrate_kinematic(
        scanner, poses, observations,
        manipulator=manipulator,
        model=model,
        rigid=rigid,
        free=as_stated(freed, rigid.contradicted),
        auto=auto,
        distances=distances,
        robust=robust,
    )  # fmt: skip
    return _with_doubts_of(found, rigid)


def _require_model(model: str, *, has_geometry: bool, distances: bool) -> None:
    """InputError for an unknown model, one without the geometry that it needs, or distances that nothing uses."""
    if model not in MODELS:
        raise InputError(f"unknown model {model!r}; known are {', '.join(MODELS)}")
    if model == "kinematic" and not has_geometry:
        raise InputError("model 'kinematic' needs the manipulator's nominal geometry (--manipulator FILE)")
    if distances:
        raise InputError("distances between balls serve models with the manipulator's errors; give its geometry")


def _said(rigid: Calibration, model: str) -> Calibration:
    """The calibration whose provenance names the model that was asked for."""
    if rigid.provenance is None:
        return rigid
    arguments = {"model": model, **rigid.provenance.arguments}
    return replace(rigid, provenance=replace(rigid.provenance, arguments=arguments))


def _with_doubts_of(found: Calibration, rigid: Calibration) -> Calibration:
    """Identified errors do not settle how the orientation columns are read: that doubt stays."""
    doubts = tuple(f for f in rigid.checks if f.rule == CONVENTION_RULE)
    return replace(found, checks=(*found.checks, *doubts)) if doubts else found


def freed_names(free: str | Sequence[str]) -> tuple[tuple[str, ...], bool]:
    """(names to free, whether values that the images contradict are freed too) of "auto", "none" or names."""
    if isinstance(free, str):
        if free not in ("auto", "none"):
            raise InputError(
                f"free is {free!r}; 'auto', 'none' or names such as ('d_SR', 'u_0') are needed, a single text is not"
            )
        return (), free == "auto"
    return tuple(free), not free


def maker_of(manipulator: ErrorModel | str | Path | Mapping[str, object] | None) -> Repeatability | None:
    """The maker's repeatability, as the manipulator's file says; None: not known."""
    if manipulator is None:
        return None
    from tomopose.calibration.identified.calibrate import machine_of

    machine = machine_of(manipulator)
    return None if machine is None else machine.repeatability
