"""Magnitudes that belong to another unit.

A file's column names say its units; a person may still have pasted other numbers below them.  These checks refuse what
is far more likely a mistake than a measurement, and every one can be answered: `# units: confirmed` in the table,
`"units": "confirmed"` in a JSON file, or `units_confirmed=True` in the call.  docs/formats/files.md states the rules.
"""

from __future__ import annotations

import math

import numpy as np

from tomopose.errors import UnitError
from tomopose.units import Array

SMALLEST_PLAN_DEG = 0.2
"""Orientations that all stay below this are taken for radians: +-10 deg is 0.17 rad; +-0.1 deg calibrates nothing."""
WHOLE_DEGREE_TOLERANCE = 0.005
"""Degrees; four digits after the point of a number in radians."""
LARGEST_ORIENTATION_DEG = 360.0
ENCODER_NOISE_MM, ENCODER_NOISE_DEG = 0.005, 0.002
"""Read-outs around a commanded zero stay below these; plans in metres and radians lie above."""
SMALLEST_PLAN_MM = 0.05
LARGEST_POSITION_MM = 5000.0
ONE_TURN = 2 * math.pi
FEWEST_ROBOT_AXES = 4
ROBOT_CONVENTIONS = frozenset({"kuka", "fanuc", "yaskawa", "staubli", "abb", "ur", "kawasaki"})
LARGEST_ROBOT_REACH_M = 5.0
"""Positions of a robot's table that all stay below this are metres: its base is farther than 5 mm from its tool."""

TABLE_REMEDY = "if the numbers are right, say so with a line '# units: confirmed' or units_confirmed=True"


def require_degrees(angles: Array, where: str) -> None:
    """UnitError if orientation angles that should be degrees look like radians, or exceed a full turn."""
    largest = _largest(angles)
    if largest > LARGEST_ORIENTATION_DEG:
        raise UnitError(f"{where}: an angle of {largest:g} is not an orientation in degrees; {TABLE_REMEDY}")
    if ENCODER_NOISE_DEG <= largest < SMALLEST_PLAN_DEG or _whole_degrees_in_radians(angles):
        raise UnitError(
            f"{where}: the angles look like radians (largest {largest:g}, which is {math.degrees(largest):.4g} deg "
            f"if it is rad), but the columns are in degrees; convert them, or {TABLE_REMEDY}"
        )


def require_table_degrees(alpha: Array, where: str) -> None:
    """UnitError if table angles in degrees look like radians: whole degrees, or one even turn, if they were rad."""
    largest = _largest(alpha)
    a = np.sort(np.abs(alpha))
    step = np.diff(a)
    even = len(a) > 3 and bool(np.ptp(step) < 1e-3 * step.max()) and step.max() > 0
    turn = even and min(abs(len(a) * step.mean() - ONE_TURN), abs(a[-1] - ONE_TURN)) < 1e-3 * ONE_TURN
    if turn or _whole_degrees_in_radians(alpha):
        raise UnitError(
            f"{where}: the table angles look like radians (largest {largest:g}, which is {math.degrees(largest):.4g} "
            f"deg if it is rad), but alpha_deg is in degrees; convert them, or {TABLE_REMEDY}"
        )


def require_joint_degrees(q: Array, where: str) -> None:
    """UnitError if joint values (n, k) that should be degrees look like radians.

    A robot of four or more axes of which none leaves +-6.28 deg works at its zero, which hardly any can.
    """
    largest = _largest(q)
    few = q.shape[1] < FEWEST_ROBOT_AXES
    if _whole_degrees_in_radians(q) or (not few and SMALLEST_PLAN_DEG < largest <= ONE_TURN):
        raise UnitError(
            f"{where}: the joint values look like radians (largest {largest:g}, which is {math.degrees(largest):.4g} "
            f"deg if it is rad), but the columns are in degrees; convert them, or {TABLE_REMEDY}"
        )


def require_radians(angles: Array, where: str) -> None:
    """UnitError if rotation vectors that should be in rad look like degrees."""
    largest = float(np.linalg.norm(angles, axis=-1).max(initial=0.0))
    if largest > ONE_TURN * (1 + 1e-6):
        raise UnitError(
            f"{where}: a rotation vector of length {largest:g} is more than one turn in radians; are these degrees? "
            f"Convert them, or {TABLE_REMEDY}"
        )


def require_millimetres(positions: Array, where: str, *, convention: str = "") -> None:
    """UnitError if positions that should be mm look like metres or micrometres.

    Metres: all below 0.05 and not just encoder noise about zero (below 0.005), or all whole half-millimetres if they
    were metres; in the convention of a robot's maker, all below 5.  Micrometres: above 5000.
    """
    largest = _largest(positions)
    if largest > LARGEST_POSITION_MM:
        raise UnitError(
            f"{where}: positions look like micrometres (largest {largest:g}, a reach of {largest / 1000:.3g} m if it "
            f"is mm); convert them, or {TABLE_REMEDY}"
        )
    halves = positions * 2000.0
    typed = bool(np.all(np.abs(halves - np.round(halves)) < 1e-6))
    least = LARGEST_ROBOT_REACH_M if convention in ROBOT_CONVENTIONS else SMALLEST_PLAN_MM
    if ENCODER_NOISE_MM <= largest < least or (0 < largest < ENCODER_NOISE_MM and typed):
        raise UnitError(
            f"{where}: positions look like metres (largest {largest:g}, which is {largest * 1000:g} mm if it is m), "
            f"but the columns are in millimetres; convert them, or {TABLE_REMEDY}"
        )


MIXED_AT_MOST_MM, MIXED_TOLERANCE = 0.05, 0.005
"""Rows in metres stay below 0.05 (50 mm); relative agreement with what other rows hold in mm."""


def require_one_unit(positions: Array, angles: Array | None, where: str) -> None:
    """UnitError where single rows are in metres or radians, and the others in mm or degrees.

    Such a row is small throughout, and each of its values, converted, is one that other rows have in the same column:
    plans repeat their levels.  Rows near zero, as encoders read them there, are no such rows.
    """
    row = _row_in_other_unit(positions, 1000.0, MIXED_AT_MOST_MM, ENCODER_NOISE_MM)
    if row is not None:
        x = positions[row]
        raise UnitError(
            f"{where}: row {row + 1} ({_shown(x)}) looks like metres among rows in mm: other rows hold "
            f"{_shown(1000 * x)}; convert it, or {TABLE_REMEDY}"
        )
    row = None if angles is None else _row_in_other_unit(angles, math.degrees(1.0), ONE_TURN / 2, 0.004)
    if row is not None and angles is not None:
        a = angles[row]
        raise UnitError(
            f"{where}: row {row + 1} ({_shown(a)}) looks like radians among rows in degrees: other rows hold "
            f"{_shown(np.degrees(a))}; convert it, or {TABLE_REMEDY}"
        )


def _row_in_other_unit(values: Array, factor: float, at_most: float, noise: float) -> int | None:
    """The first row all of whose values, times the factor, are levels of other rows but are not as written."""
    size = np.abs(values).max(axis=1, initial=0.0)
    small = (size < at_most) & (size > noise)
    levels = [values[~small & (np.abs(column) > at_most), k] for k, column in enumerate(values.T)]
    for row in np.flatnonzero(small):
        counted = [k for k in range(values.shape[1]) if abs(values[row, k]) > max(noise, 0.05 * size[row])]
        if all(_near(values[row, k] * factor, levels[k]) for k in counted) and not any(
            _near(values[row, k], values[~small, k]) for k in counted
        ):
            return int(row)
    return None


def _near(value: float, levels: Array) -> bool:
    """Whether at least two of the levels, as a plan has them, are this value."""
    return bool((np.abs(np.abs(levels) - abs(value)) <= MIXED_TOLERANCE * abs(value)).sum() >= 2)


def _shown(values: Array) -> str:
    return ", ".join(f"{v:.5g}" for v in values)


def _largest(values: Array) -> float:
    return float(np.abs(values).max(initial=0.0))


def _whole_degrees_in_radians(angles: Array) -> bool:
    """All angles are whole degrees if they are radians, and not all whole if they are degrees."""
    a = angles[angles != 0]
    if a.size == 0 or np.abs(a).max() > ONE_TURN + 1e-3:
        return False
    as_rad = np.degrees(a)
    return bool(
        np.all(np.abs(as_rad - np.round(as_rad)) < WHOLE_DEGREE_TOLERANCE)
        and np.any(np.abs(a - np.round(a)) > WHOLE_DEGREE_TOLERANCE)
    )
