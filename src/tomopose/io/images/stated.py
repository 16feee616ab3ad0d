"""What image files say about the scanner themselves, held against what the user's scanner says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tomopose.geometry.scanner import Scanner

PITCH_TOLERANCE = 2e-3
"""Relative; a header prints a pitch with three digits."""
DISTANCE_TOLERANCE = 1e-2
"""Relative; a header holds the nominal distance, a scanner the calibrated one."""


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Geometry in an image file's header.

    values:    keys of scanner.json (mm) -> numbers.
    fields:    key -> the header's own name of it.
    readings, notes: what was read how, and what could not be used.
    """

    values: Mapping[str, float]
    fields: Mapping[str, str]
    readings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def contradictions(stated: Stated, scanner: Scanner, name: str) -> str:
    """A sentence, with both numbers of each value, where the scanner contradicts the header; "" where they agree."""
    known = {"p_u_mm": scanner.p_u, "p_v_mm": scanner.p_v, "d_SD_mm": scanner.d_SD, "d_SR_mm": scanner.d_SR}
    found = []
    for key, value in stated.values.items():
        if key not in known:
            continue
        limit = PITCH_TOLERANCE if key.startswith("p_") else DISTANCE_TOLERANCE
        if abs(value / known[key] - 1) > limit:
            field = stated.fields.get(key, key)
            found.append(f"{field} = {value:g} mm, but the scanner's {key} is {known[key]:g}")
    return f"{name} states {'; '.join(found)}: one of them is wrong; the scanner's is used" if found else ""
