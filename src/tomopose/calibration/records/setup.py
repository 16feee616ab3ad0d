"""What two calibrations must have in common before their mounts can be compared: scanner, pivot, machine."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping

import numpy as np

from tomopose.calibration.model.parameters import base_name
from tomopose.calibration.result import Calibration
from tomopose.geometry.scanner import PARAMETER_UNITS

Value = float | int | str

SAME_VALUE = 1e-9
"""Relative; numbers that passed through a file keep 15 digits."""


def file_name(name: str) -> str:
    """The name of a scanner value in scanner.json: d_SD -> d_SD_mm."""
    unit = PARAMETER_UNITS.get(name, "")
    return f"{name}_{unit}" if unit else name


def held_scanner(calibration: Calibration) -> dict[str, Value]:
    """Scanner values that were taken from scanner.json unchanged, by their names there.

    Freed ones are estimates, which differ from run to run by their uncertainty; they are compared as such.
    """
    freed = {base_name(n) for n in calibration.tangent}
    freed |= {"p_u"} if "pitch_ratio" in freed else set()
    scanner = calibration.scanner
    held: dict[str, Value] = {file_name(n): float(getattr(scanner, n)) for n in PARAMETER_UNITS if n not in freed}
    return held | {"n_u_px": scanner.n_u, "n_v_px": scanner.n_v, "image_rows": scanner.image_rows}


def scanner_changes(a: Mapping[str, Value], b: Mapping[str, Value]) -> tuple[str, ...]:
    """Differences between held values in words, "d_SR_mm 283.5 -> 284"; values that one side estimated are left out."""
    return tuple(f"{n} {_text(a[n])} -> {_text(b[n])}" for n in a if n in b and not _same(a[n], b[n]))


def _same(a: Value, b: Value) -> bool:
    if isinstance(a, str) or isinstance(b, str):
        return a == b
    return math.isclose(a, b, rel_tol=SAME_VALUE, abs_tol=1e-15)


def _text(value: Value) -> str:
    return value if isinstance(value, str) else f"{value:.10g}"


def observed_digest(calibration: Calibration) -> str:
    """SHA-256 of the centres that the calibration used, with their pose ids: another run has other centres."""
    digest = hashlib.sha256("\n".join(calibration.pose_id).encode())
    digest.update(np.ascontiguousarray(calibration.x_D, dtype="<f8").tobytes())
    return digest.hexdigest()
