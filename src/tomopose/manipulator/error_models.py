"""A calibration's errors of the manipulator, and what follows from them: where the real plate is, what to command.

`Calibration.errors` is one of four types, and there are no others:

    RigidErrors       the poses are trusted, except for a scale of their translations and a scatter;
    IdentifiedErrors  a hexapod or a robot with the errors of its geometry that were found;
    EmpiricalErrors   a smooth map of pose errors, for machines whose kinematics nobody knows;
    TwinErrors        two robots, of source and of detector.

Home of eq. (5) stays the identity: M is the frame that equals H when the controller's zero pose is executed without
error.  The real plate at commanded zero is one of the corrected poses like any other; the difference is a rigid pose of
the object, on which no measurement depends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from tomopose.errors import InputError, OutOfReachError, ShapeError
from tomopose.geometry.rotations import log_rotation
from tomopose.geometry.transforms import RigidTransform, moved
from tomopose.manipulator.inverse import InverseManipulator, inverse_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, RealPoses
from tomopose.manipulator.run_effects import with_run_effects
from tomopose.manipulator.serial import SerialRobot
from tomopose.manipulator.twin import TwinRobots, twin_names
from tomopose.units import Array, float_array
from tomopose.values import require_types, value

RANGE_MARGIN = 0.1
"""Of the calibrated range's width: as far outside a pose still counts as inside."""
COMMAND_STEPS = 30
COMMAND_TOLERANCE = 1e-9
"""mm, and rad at 1000 mm."""


@value
class PoseScatter:
    """Standard deviations of the plate from pose to pose along H: t (3,) mm of its origin, w (3,) rad of its turns.

    about_H: the turns are about the origin of H (tables of inverse poses); else about the plate's own origin.
    """

    t: Array
    w: Array
    about_H: bool = False

    def __post_init__(self) -> None:
        for name in ("t", "w"):
            object.__setattr__(self, name, float_array(np.broadcast_to(np.asarray(getattr(self, name)), 3)))

    @property
    def variance(self) -> Array:
        """(6,) of (w, t), rad^2 and mm^2."""
        return np.concatenate([self.w**2, self.t**2])


@value
class PoseRange:
    """Lowest and highest shift t (3,) mm and rotation vector w (3,) rad of a pose table."""

    t_low: Array
    t_high: Array
    w_low: Array
    w_high: Array

    @classmethod
    def of(cls, poses: PoseSequence) -> PoseRange:
        t, w = poses.T_MH.t, log_rotation(poses.T_MH.R)
        return cls(t_low=t.min(axis=0), t_high=t.max(axis=0), w_low=w.min(axis=0), w_high=w.max(axis=0))

    def outside(self, poses: PoseSequence) -> Any:
        """(n,) bool: the pose lies outside, with a margin."""
        x = np.concatenate([poses.T_MH.t, log_rotation(poses.T_MH.R)], axis=1)
        low, high = (np.concatenate(pair) for pair in ((self.t_low, self.w_low), (self.t_high, self.w_high)))
        margin = RANGE_MARGIN * (high - low) + np.repeat([1e-3, 1e-6], 3)
        return ((x < low - margin) | (x > high + margin)).any(axis=1)


@value
class Lag:
    """Worn guides and drives: names and values (mm) of play, which follows the direction of each move."""

    names: tuple[str, ...]
    values: Array


@value
class RigidErrors:
    """The poses are trusted.  translation_scale: factor on the plate's shifts; scatter: None where none is known."""

    translation_scale: float = 1.0
    scatter: PoseScatter | None = None


@dataclass(frozen=True, kw_only=True)
class MachineErrors:
    """What identified and empirical errors share.

    machine: the model with its nominal geometry and the priors of its errors.
    values, u: (m,) the errors found and their standard uncertainties, in the order of machine.names, machine.units.
    range:     of the poses in which they were found;  scatter: of the plate, with the drift of the run.
    lag:       where the run showed it;  translation_scale: factor on the plate's shifts.
    """

    machine: ErrorModel
    values: Array
    u: Array
    range: PoseRange
    scatter: PoseScatter | None = None
    lag: Lag | None = None
    translation_scale: float = 1.0

    def __post_init__(self) -> None:
        _hold_one_value_each(self, self.machine.names)

    @property
    def names(self) -> tuple[str, ...]:
        return self.machine.names


@value
class IdentifiedErrors(MachineErrors):
    """A hexapod or a robot (an InverseManipulator of one, where it carries the scanner) and the errors that it has."""


@value
class EmpiricalErrors(MachineErrors):
    """A map of pose errors of low order: nothing is known of the machine."""


@value
class TwinErrors:
    """Twin robots as in `TwinRobots`, without a pose table, and the errors that were found.

    values, u: (m,) in the order of `names`: errors of the detector's robot, of the source's, then the set-up.
    range, source_range: of the detector's table of inverse poses, and of the source's table.
    """

    detector: ErrorModel | None
    source: ErrorModel | None
    base: RigidTransform
    focus: Array
    base_t_sigma: float
    base_w_sigma: float
    focus_sigma: float
    values: Array
    u: Array
    range: PoseRange
    source_range: PoseRange
    scatter: PoseScatter | None = None

    def __post_init__(self) -> None:
        _hold_one_value_each(self, self.names)

    @property
    def names(self) -> tuple[str, ...]:
        return twin_names(self.detector, self.source)

    def robots(self, source_poses: PoseSequence) -> TwinRobots:
        """The twins with a table of the source robot's poses."""
        return TwinRobots(
            detector=self.detector,
            source=self.source,
            source_poses=source_poses,
            base=self.base,
            focus=self.focus,
            base_t_sigma=self.base_t_sigma,
            base_w_sigma=self.base_w_sigma,
            focus_sigma=self.focus_sigma,
        )


Errors: TypeAlias = RigidErrors | IdentifiedErrors | EmpiricalErrors | TwinErrors
OneMachine: TypeAlias = RigidErrors | IdentifiedErrors | EmpiricalErrors


def _hold_one_value_each(errors: MachineErrors | TwinErrors, names: tuple[str, ...]) -> None:
    for field in ("values", "u"):
        value = float_array(getattr(errors, field))
        if value.shape != (len(names),):
            raise ShapeError(f"manipulator: names and {field} do not fit: {len(names)} errors, shape {value.shape}")
        object.__setattr__(errors, field, value)


@dataclass(frozen=True, kw_only=True)
class PoseCorrection:
    """Corrected poses and what is known about them.

    poses:    the table with T_MH of the real plate.
    J:        (n, 6, m) derivative of (w, t) of the real plate by the errors `names`: it turns by exp(w) from the left,
              its origin moves by t, both in H, rad and mm.
    outside:  (n,) bool: the pose lies outside the range in which the errors were identified.
    notes:    sentences to show with the result.
    """

    poses: PoseSequence
    J: Array
    names: tuple[str, ...]
    outside: Any
    notes: tuple[str, ...] = ()


def machines_of(errors: Errors) -> tuple[ErrorModel | None, ErrorModel | None]:
    """The nominal machines, without errors: the manipulator's, or those of detector and source of twins; None for a
    machine without a model."""
    if isinstance(errors, TwinErrors):
        return errors.detector, errors.source
    if isinstance(errors, RigidErrors):
        return None, None
    machine = errors.machine
    return (machine.machine if isinstance(machine, InverseManipulator) else machine), None


def _executed(errors: MachineErrors, poses: PoseSequence, moves: PoseSequence) -> tuple[RealPoses, tuple[str, ...]]:
    """Where the real plate is for commanded poses, with lags as of the table `moves`, and the errors' names."""
    model, p = errors.machine, errors.values
    if errors.lag is None:
        return model.real_poses(poses, p), model.names
    worn = with_run_effects(model, moves)
    values, still = errors.lag.values, worn.drift
    if errors.lag.names != worn.names[still.stop :] or values.shape != (len(worn.names) - still.stop,):
        raise InputError(f"calibration: manipulator: names and values of the lag do not fit a {model.kind}")
    real = worn.real_poses(poses, np.concatenate([p, np.zeros(still.stop - still.start), values]))
    J = np.delete(real.J, np.arange(still.start, still.stop), axis=2)
    return replace(real, J=J), (*model.names, *worn.names[still.stop :])


def require_one_table(errors: Errors) -> OneMachine:
    """The errors of a single manipulator; InputError for twins, whose scans have two tables."""
    if isinstance(errors, TwinErrors):
        raise InputError("the calibration is of twin robots, whose scans need two pose tables; use twin_matrices")
    return errors


def correction(errors: Errors, poses: PoseSequence) -> PoseCorrection:
    """The table with the poses of the real plate, its Jacobian and what lies outside the calibrated range."""
    own, n = require_one_table(errors), len(poses)
    scale = own.translation_scale
    if isinstance(own, RigidErrors):
        where = poses if scale == 1.0 else replace(poses, T_MH=replace(poses.T_MH, t=scale * poses.T_MH.t))
        return PoseCorrection(poses=where, J=np.zeros((n, 6, 0)), names=(), outside=np.zeros(n, dtype=bool))
    real, names = _executed(own, poses, poses)
    T_MH = replace(real.T_MH, t=scale * real.t)
    J = np.concatenate([real.J[:, :3], scale * real.J[:, 3:]], axis=1)
    outside = own.range.outside(poses)
    return PoseCorrection(
        poses=replace(poses, T_MH=T_MH), J=J, names=names, outside=outside, notes=outside_notes(outside, poses)
    )


@require_types
def corrected_poses(errors: Errors, poses: PoseSequence) -> PoseSequence:
    """The table with T_MH of the real plate in place of the controller's."""
    return correction(errors, poses).poses


@require_types
def commands_for(errors: Errors, wanted: PoseSequence) -> PoseSequence:
    """The table to command so that the real plate reaches the poses `wanted`: the inverse correction.

    Joint values are returned too where `wanted` has them (they say which branch of a robot is meant).
    Raises OutOfReachError, naming the poses, where the real machine cannot get there.
    """
    own = require_one_table(errors)
    scale = own.translation_scale
    if isinstance(own, RigidErrors):
        return wanted if scale == 1.0 else replace(wanted, T_MH=replace(wanted.T_MH, t=wanted.T_MH.t / scale))
    if isinstance(own.machine, InverseManipulator) and own.lag is None:
        inner = replace(own, machine=own.machine.machine)
        return inverse_poses(commands_for(inner, inverse_poses(wanted)))
    model = own.machine
    command = replace(wanted, q=None)
    extra = None
    if isinstance(model, SerialRobot):
        if len(model.joints) < 6:
            raise InputError(
                f"a machine of {len(model.joints)} joints cannot be commanded to correct all six coordinates of a "
                "pose; its matrices hold where it really goes"
            )
        q, extra = model.joint_values(wanted)
        command = replace(wanted, q=q)
    for _ in range(COMMAND_STEPS):
        real, _ = _executed(own, command, wanted)
        w = log_rotation(wanted.T_MH.R @ np.swapaxes(real.R, 1, 2))
        delta = np.concatenate([w, wanted.T_MH.t - scale * real.t], axis=1)
        miss = np.maximum(np.abs(delta[:, :3]).max(axis=1) * 1000.0, np.abs(delta[:, 3:]).max(axis=1))
        if miss.max() < COMMAND_TOLERANCE:
            return command if wanted.q is not None else replace(command, q=None)
        R, t = moved(command.T_MH.R, command.T_MH.t, delta)
        T_MH = RigidTransform(R=R, t=t, source=command.T_MH.source, target=command.T_MH.target)
        if isinstance(model, SerialRobot) and extra is not None:
            T_flange = RigidTransform.from_matrix(
                T_MH.matrix @ np.linalg.inv(extra), source=T_MH.source, target=T_MH.target
            )
            command = replace(command, T_MH=T_MH, q=model.inverse(T_flange, q_start=command.q))
        else:
            command = replace(command, T_MH=T_MH)
    bad = np.flatnonzero(miss >= COMMAND_TOLERANCE)
    raise OutOfReachError(
        f"{bad.size} wanted poses cannot be commanded: pose {wanted.pose_id[int(bad[0])]!r} is missed by "
        f"{miss[bad[0]]:.3g} mm",
        indices=bad.tolist(),
    )


def outside_notes(outside: np.ndarray, poses: PoseSequence, whose: str = "the manipulator's") -> tuple[str, ...]:
    """The sentence on poses outside the range in which `whose` errors were identified; none where all lie inside."""
    if not outside.any():
        return ()
    return (
        f"{int(outside.sum())} of {len(poses)} poses lie outside the range in which {whose} errors were identified, "
        f"the first is {poses.pose_id[int(np.flatnonzero(outside)[0])]!r}; there the correction rests on the model "
        "alone",
    )
