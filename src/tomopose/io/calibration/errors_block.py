"""The "manipulator" block of calibration.json: identified errors, and what is needed to apply them to any scan.

    {"kind": "hexapod" | "serial" | "map" | "inverse" | "twin",  "nominal": the machine as in its file,
     "names", "values", "units", "u": of its errors,
     "scatter": {"t_mm", "w_rad"}, three each along H, of the plate from pose to pose, with the drift of the run,
     "lag": {"names", "values"} of worn guides and drives, where the run showed it,
     "translation_scale": factor on the plate's shifts, where it was freed and is not 1,
     "range": {"t_mm": [low (3), high (3)], "w_rad": [low, high]}: of the calibration's poses; of twins also
     "source_range"}

A calibration that trusts the poses has no kind: the block is empty, or holds its scatter and scale alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.io.numbers_json import decode_array, encode
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
from tomopose.manipulator.files import hexapod_from_document, serial_from_document
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.pose_map import PoseMap
from tomopose.manipulator.real_poses import ErrorModel, Repeatability
from tomopose.manipulator.twin import twin_document

WHERE = "calibration: manipulator"


def errors_document(errors: Errors) -> dict[str, Any]:
    """The block of a calibration's errors."""
    block: dict[str, Any] = {}
    if isinstance(errors, TwinErrors):
        units = (*(u for m in (errors.detector, errors.source) if m for u in m.units), *("rad",) * 3, *("mm",) * 6)
        block = {"kind": "twin", "nominal": twin_document(errors), "units": list(units)}
        block |= {"source_range": _range_document(errors.source_range)}
    elif not isinstance(errors, RigidErrors):
        machine = errors.machine
        block = {"kind": machine.kind, "nominal": machine.to_json(), "units": list(machine.units)}
        if errors.lag is not None:
            block |= {"lag": {"names": list(errors.lag.names), "values": encode(errors.lag.values)}}
    if not isinstance(errors, RigidErrors):
        block |= {"names": list(errors.names), "values": encode(errors.values), "u": encode(errors.u)}
        block |= {"range": _range_document(errors.range)}
    if not isinstance(errors, TwinErrors) and errors.translation_scale != 1.0:
        block |= {"translation_scale": errors.translation_scale}
    if errors.scatter is not None:
        block |= {"scatter": {"t_mm": encode(errors.scatter.t), "w_rad": encode(errors.scatter.w)}}
        block["scatter"] |= {"about": "H"} if errors.scatter.about_H else {}
    return block


def errors_from_document(block: Mapping[str, object], *, inverse: bool = False) -> Errors:
    """The errors in a block; inverse: of tables of inverse poses, whose plate turns about H.

    Raises InputError where the block is damaged.
    """
    try:
        return _errors(block, inverse)
    except KeyError as error:
        raise InputError(f"{WHERE}: the key {error} is missing") from error


def _errors(block: Mapping[str, Any], inverse: bool) -> Errors:
    scatter = None
    if "scatter" in block:
        found = block["scatter"]
        about_H = found["about"] == "H" if "about" in found else inverse
        scatter = PoseScatter(t=decode_array(found["t_mm"], 3), w=decode_array(found["w_rad"], 3), about_H=about_H)
    scale = float(block.get("translation_scale", 1.0))
    kind = block.get("kind")
    if kind is None:
        return RigidErrors(translation_scale=scale, scatter=scatter)
    m = len(block["names"])
    values, u, limits = decode_array(block["values"], m), decode_array(block["u"], m), _range(block["range"])
    if kind == "twin":
        twin = _twin(block, values, u, limits, scatter)
        errors: Errors = twin
        names = twin.names
    else:
        machine = _machine(kind, block["nominal"])
        lag = block.get("lag")
        of = EmpiricalErrors if isinstance(machine, PoseMap) else IdentifiedErrors
        errors = of(
            machine=machine,
            values=values,
            u=u,
            range=limits,
            scatter=scatter,
            lag=None if lag is None else Lag(names=tuple(lag["names"]), values=decode_array(lag["values"], -1)),
            translation_scale=scale,
        )
        names = machine.names
    if tuple(block["names"]) != names:
        raise InputError(f"{WHERE}: names and values do not fit a {kind} with {len(names)} errors")
    return errors


def _twin(block: Mapping[str, Any], values: Any, u: Any, limits: PoseRange, scatter: PoseScatter | None) -> TwinErrors:
    nominal = block["nominal"]
    machines = {
        who: _machine(nominal[who]["kind"], {k: v for k, v in nominal[who].items() if k != "kind"})
        if who in nominal
        else None
        for who in ("detector", "source")
    }
    return TwinErrors(
        **machines,
        base=RigidTransform.from_matrix(np.asarray(nominal["base"]), source=Frame.H, target=Frame.H),
        focus=decode_array(nominal["focus_mm"], 3),
        base_t_sigma=float(nominal["base_t_sigma_mm"]),
        base_w_sigma=float(nominal["base_w_sigma_rad"]),
        focus_sigma=float(nominal["focus_sigma_mm"]),
        values=values,
        u=u,
        range=limits,
        source_range=_range(block["source_range"]),
        scatter=scatter,
    )


def _machine(kind: str, nominal: Mapping[str, Any]) -> ErrorModel:
    if kind == "hexapod":
        return hexapod_from_document(nominal, WHERE)
    if kind == "serial":
        return serial_from_document(nominal, WHERE)
    if kind == "inverse":
        return InverseManipulator(machine=_machine(nominal["kind"], nominal["machine"]))
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
    raise InputError(f"{WHERE} has kind {kind!r}; hexapod, serial, map, inverse and twin are known")


def _range_document(limits: PoseRange) -> dict[str, Any]:
    return {
        "t_mm": [encode(limits.t_low), encode(limits.t_high)],
        "w_rad": [encode(limits.w_low), encode(limits.w_high)],
    }


def _range(block: Mapping[str, object]) -> PoseRange:
    (t_low, t_high), (w_low, w_high) = (decode_array(block[k], 2, 3) for k in ("t_mm", "w_rad"))
    return PoseRange(t_low=t_low, t_high=t_high, w_low=w_low, w_high=w_high)
