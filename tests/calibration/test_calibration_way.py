"""How far T_HT travels from a calibration to projection matrices: the functions that a change of it reaches."""

from __future__ import annotations

import sys
from dataclasses import fields, is_dataclass, replace
from types import FrameType

import numpy as np
from calibration_cases import SCANNER, observe, paper_poses

import tomopose as tp

MOST = 12


def _content(value: object, depth: int = 0) -> object:
    """What a value holds, to be compared; arrays by their bytes."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, (list, tuple)):
        return tuple(_content(v, depth + 1) for v in value)
    if isinstance(value, dict):
        return tuple((k, _content(v, depth + 1)) for k, v in value.items())
    if is_dataclass(value) and depth < 6:
        return tuple(_content(getattr(value, f.name, None), depth + 1) for f in fields(value))
    return value if isinstance(value, (bool, int, float, str, bytes, type(None))) else type(value)


def _calls(calibration: tp.Calibration, poses: tp.PoseSequence) -> list[tuple[tuple[str, str], object]]:
    """((file, function), content of its arguments) of every function of the package, in the order of the calls."""
    seen: list[tuple[tuple[str, str], object]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or "/tomopose/" not in code.co_filename or code.co_name.startswith("<"):
            return
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        content = tuple(_content(frame.f_locals.get(name)) for name in names)
        seen.append(((code.co_filename.rsplit("/tomopose/", 1)[1], code.co_name), content))

    sys.setprofile(note)
    try:
        tp.projection_matrices(calibration, poses)
    finally:
        sys.setprofile(None)
    return seen


def test_from_a_calibration_to_its_matrices_t_ht_goes_through_twelve_functions_at_most():
    poses = paper_poses()
    calibration = tp.calibrate(replace(SCANNER, sigma={}), poses, observe(poses))
    moved = replace(calibration, T_HT=replace(calibration.T_HT, t=calibration.T_HT.t + [1e-3, 2e-3, -1e-3]))
    tp.projection_matrices(calibration, poses)
    one, other = _calls(calibration, poses), _calls(moved, poses)
    assert [name for name, _ in one] == [name for name, _ in other]
    way = dict.fromkeys(a for (a, x), (_, y) in zip(one, other, strict=True) if x != y)
    assert ("geometry/projection.py", "eq5_matrices") in way  # the measure sees what it is about
    assert ("calibration/uncertainty/trajectory.py", "scan_jacobian") in way
    assert len(way) <= MOST, list(way)
