"""Identified errors at work: where the real plate is for any pose table, and what to command instead.

`Calibration.manipulator` (and calibration.json) hold a machine with the errors that were found:

    {"kind": "hexapod" | "serial" | "map",  "nominal": the machine as in its file,
     "names", "values", "units", "u": of its errors,
     "scatter": {"t_mm", "w_rad"}, three each along H, of the plate from pose to pose, with the drift of the run,
     "lag": {"names", "values"} of worn guides and drives, where the run showed it: it follows the direction from which
     a table's poses are approached, in their order,
     "translation_scale": factor on the plate's shifts, where it was freed and is not 1,
    "arrangement": "moving-scanner" where source and detector move, and poses are inverse ones,
    "view_sigma": {"d_SD": mm}: scatter of a scanner parameter from view to view,
     "range": {"t_mm": [low (3), high (3)], "w_rad": [low, high]}: of the calibration's poses}

Home of eq. (5) stays the identity: M is the frame that equals H when the controller's zero pose is executed without
error.  The real plate at commanded zero is one of the corrected poses like any other; the difference is a rigid pose of
the object, on which no measurement depends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.errors import InputError, OutOfReachError
from tomopose.geometry.rotations import log_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.files import hexapod_from_document, serial_from_document
from tomopose.manipulator.inverse import InverseManipulator, inverse_poses
from tomopose.manipulator.pose_map import PoseMap
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, RealPoses, Repeatability, moved
from tomopose.manipulator.run_effects import with_run_effects
from tomopose.manipulator.serial import SerialRobot
from tomopose.units import Array

MOVING_SCANNER = "moving-scanner"
"""Block's "arrangement" where source and detector move and the object does not move."""
RANGE_MARGIN = 0.1
"""Of the calibrated range's width: as far outside a pose still counts as inside."""
COMMAND_STEPS = 30
COMMAND_TOLERANCE = 1e-9
"""mm, and rad at 1000 mm."""


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


def manipulator_block(model: ErrorModel, p: Array, u: Array, poses: PoseSequence) -> dict[str, Any]:
    """The block above for errors p (m,) with standard uncertainties u, found with `poses`."""
    return {
        "kind": model.kind,
        "nominal": model.to_json(),
        "names": list(model.names),
        "values": np.asarray(p).tolist(),
        "units": list(model.units),
        "u": np.asarray(u).tolist(),
        "range": pose_range(poses),
    }


def pose_range(poses: PoseSequence) -> dict[str, Any]:
    """Lowest and highest shift and rotation vector of a table, as in the block's "range"."""
    t, w = poses.T_MH.t, log_rotation(poses.T_MH.R)
    return {
        "t_mm": [t.min(axis=0).tolist(), t.max(axis=0).tolist()],
        "w_rad": [w.min(axis=0).tolist(), w.max(axis=0).tolist()],
    }


def model_from_block(manipulator: Mapping[str, Any]) -> tuple[ErrorModel, Array]:
    """The machine and its errors p (m,) from a calibration's block; InputError where the block is damaged."""
    where = "calibration: manipulator"
    try:
        values = np.array(manipulator["values"], dtype=np.float64)
        kind = manipulator["kind"]
        model = machine_from_block(kind, manipulator["nominal"], where)
    except KeyError as error:
        raise InputError(f"{where}: the key {error} is missing") from error
    if tuple(manipulator.get("names", ())) != model.names or values.shape != (len(model.names),):
        raise InputError(f"{where}: names and values do not fit a {kind} with {len(model.names)} errors")
    return model, values


def machine_from_block(kind: str, nominal: Mapping[str, Any], where: str) -> ErrorModel:
    """The machine of a block's `nominal`."""
    if kind == "twin":
        raise InputError(f"{where} holds twin robots, whose scans need two pose tables; use twin_matrices")
    if kind == "hexapod":
        return hexapod_from_document(nominal, where)
    if kind == "serial":
        return serial_from_document(nominal, where)
    if kind == "inverse":
        return InverseManipulator(machine=machine_from_block(nominal["kind"], nominal["machine"], where))
    if kind == "map":
        return PoseMap(
            order=int(nominal["order"]),
            t_scale=nominal["t_scale_mm"],
            w_scale=nominal["w_scale_rad"],
            t_sigma=nominal["t_sigma_mm"],
            w_sigma=nominal["w_sigma_rad"],
            factors=nominal.get("factors"),
            repeatability=Repeatability(**nominal["repeatability"]),
        )
    raise InputError(f"{where} has kind {kind!r}; hexapod, serial, map and inverse are known")


def machines_of(manipulator: Mapping[str, Any]) -> tuple[ErrorModel | None, ErrorModel | None]:
    """The nominal machines of a block, without errors: the manipulator's, or those of detector and source of twins;
    None where it holds none."""
    where, nominal = "calibration: manipulator", manipulator.get("nominal", {})
    if manipulator.get("kind") == "twin":
        twins = {
            who: machine_from_block(block["kind"], {k: v for k, v in block.items() if k != "kind"}, where)
            for who, block in nominal.items()
            if who in ("detector", "source")
        }
        return twins.get("detector"), twins.get("source")
    if "kind" not in manipulator:
        return None, None
    machine = machine_from_block(manipulator["kind"], nominal, where)
    return (machine.machine if isinstance(machine, InverseManipulator) else machine), None


def _executed(
    manipulator: Mapping[str, Any], poses: PoseSequence, moves: PoseSequence
) -> tuple[RealPoses, tuple[str, ...]]:
    """Where the real plate is for commanded poses, with lags as of the table `moves`, and the errors' names."""
    model, p = model_from_block(manipulator)
    lag = manipulator.get("lag")
    if lag is None:
        return model.real_poses(poses, p), model.names
    worn = with_run_effects(model, moves)
    values, still = np.array(lag["values"], dtype=np.float64), worn.drift
    if tuple(lag["names"]) != worn.names[still.stop :] or values.shape != (len(worn.names) - still.stop,):
        raise InputError(f"calibration: manipulator: names and values of the lag do not fit a {model.kind}")
    real = worn.real_poses(poses, np.concatenate([p, np.zeros(still.stop - still.start), values]))
    J = np.delete(real.J, np.arange(still.start, still.stop), axis=2)
    return replace(real, J=J), (*model.names, *worn.names[still.stop :])


def correction(manipulator: Mapping[str, Any], poses: PoseSequence) -> PoseCorrection:
    """The table with the poses of the real plate, its Jacobian and what lies outside the calibrated range.

    A block without a machine (a rigid calibration) leaves the poses as they are.
    """
    n = len(poses)
    if "kind" not in manipulator:
        return PoseCorrection(poses=poses, J=np.zeros((n, 6, 0)), names=(), outside=np.zeros(n, dtype=bool))
    real, names = _executed(manipulator, poses, poses)
    scale = float(manipulator.get("translation_scale", 1.0))
    T_MH = replace(real.T_MH, t=scale * real.t)
    J = np.concatenate([real.J[:, :3], scale * real.J[:, 3:]], axis=1)
    outside = outside_range(manipulator["range"], poses)
    return PoseCorrection(
        poses=replace(poses, T_MH=T_MH), J=J, names=names, outside=outside, notes=outside_notes(outside, poses)
    )


def corrected_poses(manipulator: Mapping[str, Any], poses: PoseSequence) -> PoseSequence:
    """The table with T_MH of the real plate in place of the controller's."""
    return correction(manipulator, poses).poses


def commands_for(manipulator: Mapping[str, Any], wanted: PoseSequence) -> PoseSequence:
    """The table to command so that the real plate reaches the poses `wanted`: the inverse correction.

    Joint values are returned too where `wanted` has them (they say which branch of a robot is meant).
    Raises OutOfReachError, naming the poses, where the real machine cannot get there.
    """
    if "kind" not in manipulator:
        return wanted
    if manipulator["kind"] == "inverse" and "lag" not in manipulator:
        inner = {**manipulator, "kind": manipulator["nominal"]["kind"], "nominal": manipulator["nominal"]["machine"]}
        return inverse_poses(commands_for(inner, inverse_poses(wanted)))
    model, _ = model_from_block(manipulator)
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
        real, _ = _executed(manipulator, command, wanted)
        w = log_rotation(wanted.T_MH.R @ np.swapaxes(real.R, 1, 2))
        delta = np.concatenate([w, wanted.T_MH.t - real.t], axis=1)
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


def outside_range(limits: Mapping[str, Any], poses: PoseSequence) -> Any:
    """(n,) bool: the pose lies outside a block's "range", with a margin."""
    x = np.concatenate([poses.T_MH.t, log_rotation(poses.T_MH.R)], axis=1)
    low = np.concatenate([limits["t_mm"][0], limits["w_rad"][0]])
    high = np.concatenate([limits["t_mm"][1], limits["w_rad"][1]])
    margin = RANGE_MARGIN * (high - low) + np.repeat([1e-3, 1e-6], 3)
    return ((x < low - margin) | (x > high + margin)).any(axis=1)


def outside_notes(outside: Any, poses: PoseSequence, whose: str = "the manipulator's") -> tuple[str, ...]:
    """The sentence on poses outside the range in which `whose` errors were identified; none where all lie inside."""
    if not outside.any():
        return ()
    return (
        f"{int(outside.sum())} of {len(poses)} poses lie outside the range in which {whose} errors were identified, "
        f"the first is {poses.pose_id[int(np.flatnonzero(outside)[0])]!r}; there the correction rests on the model "
        "alone",
    )


def moving_scanner(manipulator: Mapping[str, Any]) -> bool:
    """Whether the block is of a manipulator that carries source and detector, so that tables hold inverse poses."""
    return manipulator.get("arrangement") == MOVING_SCANNER or manipulator.get("kind") == "inverse"
