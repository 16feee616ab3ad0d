"""Rules that need the whole run: what is no ball beside the other images, and what is no run at all."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tomopose.detection.settings import RunSettings
from tomopose.errors import InputError, ShapeError

Row = dict[str, Any]

NO_FORM: tuple[list[int], str] = ([], "")
"""Shape and type of an image that could not be opened."""


def refuse_another_form(first: Row, row: Row) -> None:
    """ShapeError or InputError where an image has another shape or type than the run's first."""
    (shape, kind), (other, other_kind) = first.get("form", NO_FORM), row.get("form", NO_FORM)
    if shape and other and (shape, kind) != (other, other_kind):
        error = ShapeError if shape != other else InputError
        raise error(
            f"image {row['name']} has shape {tuple(other)}{' of ' + other_kind if other_kind else ''}, the first "
            f"({first['name']}) {tuple(shape)}{' of ' + kind if kind else ''}; a run's images have one shape and type; "
            "is it a colour image, or of another run?"
        )


def refuse_unusable(rows: list[Row], settings: RunSettings) -> None:
    """Raises where too many images could not even be looked at: that is the caller's input, not one bad image."""
    bad = [row for row in rows if str(row.get("reason", "")).startswith("bad image")]
    if not bad or (len(bad) < len(rows) and len(bad) <= max(1, settings.most_unusable * len(rows))):
        return
    error = ShapeError if bad[0]["fault"] == "ShapeError" else InputError
    number = f"all {len(rows)}" if len(bad) == len(rows) else f"{len(bad)} of {len(rows)}"
    raise error(
        f"{number} images are unusable; the first, {bad[0]['name']}: {bad[0]['reason'].removeprefix('bad image: ')}"
    )


def of_one_size(rows: list[Row], settings: RunSettings) -> list[Row]:
    """The rows, with a refusal in place of one that shows something of quite another size than the other images."""
    radii = [row["radius"] for row in rows if "x_D" in row]
    if len(radii) < settings.enough:
        return rows
    usual = float(np.median(radii))
    return [_of_size(row, usual, settings) for row in rows]


def _of_size(row: Row, usual: float, settings: RunSettings) -> Row:
    if "x_D" not in row or abs(math.log(row["radius"] / usual)) < math.log(settings.other_size):
        return row
    u, v = row["x_D"]
    return {
        "name": row["name"],
        "reason": f"not found: the shape at ({u:.0f}, {v:.0f}) has a radius of {row['radius']:.1f} px, the ball in the "
        f"other images {usual:.1f} px",
    }


def nominal_radius_is_off(rows: list[Row], expected: float, ball_diameter: float, settings: RunSettings) -> bool:
    """Whether a ball on the rotation axis would be larger or smaller than in every image, by more than 2 %.

    expected: its radius there, px.  A run's poses move the ball along the beam, so that its radii differ; where they
    do not reach the nominal one by 20 %, d_SD, d_SR, a pitch or the diameter is wrong: InputError.
    """
    ratio = [row["radius"] / expected for row in rows if "x_D" in row]
    if len(ratio) < settings.enough:
        return False
    off = max(min(ratio) - 1.0, 1.0 - max(ratio))
    if off > settings.far_off:
        raise InputError(
            f"the ball's silhouettes have {100 * min(ratio):.0f} to {100 * max(ratio):.0f} % of the size that "
            f"ball_diameter = {ball_diameter:g} mm has on the rotation axis; d_SD, d_SR, a pixel pitch or the diameter "
            "is wrong"
        )
    result: bool = off > settings.off
    return result
