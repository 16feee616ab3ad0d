"""The pixels of one radiograph: its form checked, bad pixels found, and only the part read that is needed."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from tomopose.errors import BallNotFoundError, InputError, ShapeError
from tomopose.geometry.scanner import Scanner
from tomopose.kernel_cache import njit
from tomopose.units import Array

NATIVE = ("uint8", "uint16", "float32", "float64")
SMALLEST_IMAGE = 16
REGION_MARGIN, REGION_REACH = 24.0, 1.5
"""A region about a predicted position reaches this many radii plus this margin, px."""
MOST_BAD = 0.5
"""Share of bad pixels from which an image is not searched."""

Box: TypeAlias = tuple[int, int, int, int]
"""(v0, v1, u0, u1): rows and columns of a part of an image."""


class Radiograph(Protocol):
    """One image whose parts can be read: what a lazy sequence gives for one index."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    def region(self, v0: int, v1: int, u0: int, u1: int) -> Array: ...


Image: TypeAlias = npt.ArrayLike | Radiograph
Mask: TypeAlias = npt.ArrayLike | None


class Pixels(NamedTuple):
    """A part of a radiograph: values [v, u], bad ones replaced; bad, bool [v, u], or None where all are good.

    corner: D coordinates (u, v) of pixel [0, 0]; quantum: step of the values; ceiling: the largest good one.
    """

    values: Array
    bad: npt.NDArray[np.bool_] | None
    corner: tuple[int, int]
    quantum: float
    ceiling: float
    eight_bit: bool


def region_about(
    at: Array, shape: tuple[int, int], scanner: Scanner, expected: float, reach: float = REGION_REACH
) -> Box:
    """The part of an image that is searched about a predicted position `at` (u, v) in it.

    expected: radius, px of size sqrt(p_u p_v); reach: in radii.  The part is empty where the position is out of view.
    """
    p = math.sqrt(scanner.p_u * scanner.p_v)
    half_u = (reach * expected + REGION_MARGIN) * p / scanner.p_u
    half_v = (reach * expected + REGION_MARGIN) * p / scanner.p_v
    return (
        max(int(at[1] - half_v), 0), min(int(at[1] + half_v) + 2, shape[0]),
        max(int(at[0] - half_u), 0), min(int(at[0] + half_u) + 2, shape[1]),
    )  # fmt: skip


def checked_shape(image: Image, scanner: Scanner, origin: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns), after checks that need no pixel; ShapeError where they do not suit the detector."""
    shape = tuple(getattr(image, "shape", None) or np.shape(image))
    if len(shape) != 2:
        hint = "; is it a colour image? Export the detector's grey values" if len(shape) == 3 else ""
        raise ShapeError(f"a radiograph [v, u] has two dimensions; this one has shape {shape}{hint}")
    rows, columns = int(shape[0]), int(shape[1])
    if min(rows, columns) < SMALLEST_IMAGE:
        raise ShapeError(f"the image has {columns} x {rows} px; at least {SMALLEST_IMAGE} a side are needed")
    u, v = origin
    if u < 0 or v < 0 or u + columns > scanner.n_u or v + rows > scanner.n_v:
        raise ShapeError(
            f"the image has {columns} x {rows} px from ({u}, {v}), beyond the detector's {scanner.n_u} x {scanner.n_v}"
        )
    if origin == (0, 0) and (rows, columns) != scanner.shape:
        factor = scanner.n_u / columns
        binned = factor >= 2 and scanner.n_u // round(factor) == columns and scanner.n_v // round(factor) == rows
        remedy = (
            f"a binned image? Use scanner.binned({round(factor)})"
            if binned
            else "a window? Give origin=(u, v) of its pixel [0, 0], or scanner.cropped(...) for one at (0, 0)"
        )
        raise ShapeError(f"the image has {columns} x {rows} px, the detector {scanner.n_u} x {scanner.n_v}: {remedy}")
    return rows, columns


def read_pixels(image: Image, box: Box, mask: Mask, origin: tuple[int, int]) -> Pixels:
    """Pixels [v0:v1, u0:u1] of an image whose pixel [0, 0] has the D coordinates `origin`.

    InputError where they are no numbers; BallNotFoundError where most of them are bad.
    """
    v0, _, u0, _ = box
    values = native_part(image, box)
    bad = _bad_pixels(values, mask, box)
    if bad is not None and bad.mean() > MOST_BAD:
        raise BallNotFoundError(f"{100 * bad.mean():.0f} % of the pixels are bad (masked or not finite)")
    ceiling = float(values.max() if bad is None else values[~bad].max())
    return Pixels(
        values=values if bad is None else filled(values, bad),
        bad=bad,
        corner=(u0 + origin[0], v0 + origin[1]),
        quantum=1.0 if values.dtype.kind in "ui" else 0.0,
        ceiling=ceiling,
        eight_bit=values.dtype.name == "uint8",
    )


def native_part(image: Image, box: Box) -> Array:
    """Pixels [v0:v1, u0:u1] in one of the native types, without a copy where possible."""
    v0, v1, u0, u1 = box
    part = image.region(v0, v1, u0, u1) if hasattr(image, "region") else np.asarray(image)[v0:v1, u0:u1]
    values = np.asarray(part)
    if values.dtype.kind not in "uif":
        raise InputError(f"the image holds {values.dtype}; counts or transmission are needed")
    if values.dtype.name not in NATIVE or not values.dtype.isnative:
        values = values.astype(values.dtype.name if values.dtype.name in NATIVE else np.float64)
    return values


def _bad_pixels(values: Array, mask: Mask, box: Box) -> npt.NDArray[np.bool_] | None:
    """Bool array of bad pixels, or None where all are good."""
    v0, v1, u0, u1 = box
    bad = None
    if values.dtype.kind == "f":
        # One sum shows whether all are finite, without an array of answers.
        with np.errstate(all="ignore"):
            if not math.isfinite(float(np.sum(values, dtype=np.float64))):
                bad = ~np.isfinite(values)
    if mask is not None:
        masked = np.asarray(mask)[v0:v1, u0:u1].astype(bool)
        if masked.shape != values.shape:
            raise ShapeError(f"the mask has shape {np.shape(mask)}; it must cover the image")
        if masked.any():
            bad = masked if bad is None else bad | masked
    return bad


@njit(cache=True)
def filled(values, bad):  # type: ignore[no-untyped-def]
    """A copy in which a bad pixel has the value of the nearest good one in its row, or else in the row before."""
    out = values.copy()
    rows, columns = values.shape
    for j in range(rows):
        last = -1
        for i in range(columns):
            if not bad[j, i]:
                for k in range(last + 1, i):
                    out[j, k] = values[j, last] if last >= 0 and k - last <= i - k else values[j, i]
                last = i
        if last >= 0:
            for k in range(last + 1, columns):
                out[j, k] = values[j, last]
        elif j > 0:
            out[j] = out[j - 1]
    for j in range(rows - 2, -1, -1):
        if np.all(bad[j]) and (j == 0 or np.all(bad[:j])):
            out[j] = out[j + 1]
    return out
