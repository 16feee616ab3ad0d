"""One radiograph: checked, searched, fitted, judged."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numba import njit

from tomopose.detection.finder.find import Candidate, find_ball
from tomopose.detection.flags import expected_radius, flags_of, saturated_share
from tomopose.detection.result import BallImage
from tomopose.detection.rim_fit.fit import ConeFit, fit_cone
from tomopose.errors import BallNotFoundError, BallTruncatedError, DetectionError, InputError, ShapeError
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.silhouette import silhouette_ellipse
from tomopose.units import Array

NATIVE = ("uint8", "uint16", "float32", "float64")
SMALLEST_IMAGE = 16
WORST_SIGMA = 0.5
"""A centre less certain than this, px, is no measurement."""
WORST_RIM = 0.3
"""Residual on the rim, in contrasts, of what still counts as a ball."""
REGION_MARGIN, REGION_REACH = 24.0, 1.5
"""A region about a predicted position reaches this many radii plus this margin, px."""


class Radiograph(Protocol):
    """One image whose parts can be read: what a lazy sequence gives for one index."""

    @property
    def shape(self) -> tuple[int, int]: ...
    def region(self, v0: int, v1: int, u0: int, u1: int) -> Array: ...


def detect_image(
    image: Any,
    scanner: Scanner,
    *,
    ball_diameter: float = 8.0,
    predicted: Any = None,
    origin: tuple[int, int] = (0, 0),
    mask: Any = None,
) -> BallImage:
    """The ball in one radiograph.

    Parameters
    ----------
    image:          [v, u]; counts or transmission; NaN and infinite pixels count as bad.  An object with `shape` and
                    `region(v0, v1, u0, u1)` is read only where needed.
    scanner:        intrinsic geometry; it gives the ray of each pixel.
    ball_diameter:  nominal, mm: a preference, not a condition.
    predicted:      (u, v) in D where the ball should be: only the region about it is read and searched.
    origin:         D coordinates (u, v) of pixel [0, 0].
    mask:           bool [v, u], true for bad pixels.

    Raises
    ------
    InputError, ShapeError   an image that is none, or of another size than the scanner's detector.
    BallNotFoundError, BallTruncatedError, AmbiguousBallError, DetectionError   no measurement, with the reason.
    """
    if not (math.isfinite(ball_diameter) and ball_diameter > 0):
        raise InputError(f"ball_diameter is {ball_diameter!r} mm; a positive number is needed")
    u_0, v_0 = _whole_numbers(origin)
    shape = _checked_shape(image, scanner, (u_0, v_0))
    expected = expected_radius(scanner, ball_diameter)
    if predicted is None or not np.isfinite(np.asarray(predicted, dtype=np.float64)).all():
        return _in_region(image, scanner, (0, shape[0], 0, shape[1]), (u_0, v_0), mask, expected, None)
    at = np.asarray(predicted, dtype=np.float64) - (u_0, v_0)
    for reach in (REGION_REACH, 2 * REGION_REACH + 1):
        box = region_about(at, shape, scanner, expected, reach)
        if box[1] - box[0] < SMALLEST_IMAGE or box[3] - box[2] < SMALLEST_IMAGE:
            raise BallNotFoundError(f"the predicted position ({predicted[0]:.1f}, {predicted[1]:.1f}) is out of view")
        try:
            return _in_region(image, scanner, box, (u_0, v_0), mask, expected, at)
        except (BallNotFoundError, BallTruncatedError):
            if reach > REGION_REACH or box == (0, shape[0], 0, shape[1]):
                raise
    raise AssertionError("unreachable")


def region_about(
    at: Array, shape: tuple[int, int], scanner: Scanner, expected: float, reach: float = REGION_REACH
) -> tuple[int, int, int, int]:  # fmt: skip
    """(v0, v1, u0, u1) of the part of an image that is searched about a predicted position `at` (u, v) in it.

    expected: radius, px of size sqrt(p_u p_v); reach: in radii.  The part is empty where the position is out of view.
    """
    p = math.sqrt(scanner.p_u * scanner.p_v)
    half_u = (reach * expected + REGION_MARGIN) * p / scanner.p_u
    half_v = (reach * expected + REGION_MARGIN) * p / scanner.p_v
    return (
        max(int(at[1] - half_v), 0), min(int(at[1] + half_v) + 2, shape[0]),
        max(int(at[0] - half_u), 0), min(int(at[0] + half_u) + 2, shape[1]),
    )  # fmt: skip


def _whole_numbers(origin: tuple[int, int]) -> tuple[int, int]:
    u, v = origin
    if int(u) != u or int(v) != v:
        raise InputError(f"origin is ({u}, {v}); whole pixels are needed")
    return int(u), int(v)


def _checked_shape(image: Any, scanner: Scanner, origin: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns), after checks that need no pixel."""
    shape = tuple(getattr(image, "shape", np.shape(image)))
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
        cure = (
            f"a binned image? Use scanner.binned({round(factor)})"
            if binned
            else "a window? Give origin=(u, v) of its pixel [0, 0], or scanner.cropped(...) for one at (0, 0)"
        )
        raise ShapeError(f"the image has {columns} x {rows} px, the detector {scanner.n_u} x {scanner.n_v}: {cure}")
    return rows, columns


def _pixels(image: Any, box: tuple[int, int, int, int]) -> Array:
    """Pixels [v0:v1, u0:u1] in one of the native types, without a copy where possible."""
    v0, v1, u0, u1 = box
    values = np.asarray(image.region(v0, v1, u0, u1) if hasattr(image, "region") else np.asarray(image)[v0:v1, u0:u1])
    if values.dtype.kind not in "uif":
        raise InputError(f"the image holds {values.dtype}; counts or transmission are needed")
    if values.dtype.name not in NATIVE or not values.dtype.isnative:
        values = values.astype(values.dtype.name if values.dtype.name in NATIVE else np.float64)
    return values


def _in_region(
    image: Any, scanner: Scanner, box: tuple[int, int, int, int], origin: tuple[int, int], mask: Any, expected: float,
    at: Array | None,
) -> BallImage:  # fmt: skip
    values = _pixels(image, box)
    v0, _v1, u0, _u1 = box
    bad = _bad_pixels(values, mask, box)
    quantum = 1.0 if values.dtype.kind in "ui" else 0.0
    eight_bit = values.dtype.name == "uint8"
    if bad is not None and bad.mean() > 0.5:
        raise BallNotFoundError(f"{100 * bad.mean():.0f} % of the pixels are bad (masked or not finite)")
    ceiling = float(values.max() if bad is None else values[~bad].max())
    if bad is not None:
        values = filled(values, bad)
    aspect = scanner.p_v / scanner.p_u
    expected_u = expected * math.sqrt(aspect)
    found, candidates = find_ball(
        values, expected_u, aspect, near=None if at is None else (float(at[0]) - u0, float(at[1]) - v0)
    )
    fit, window, corner = _fitted(values, bad, found, scanner, (u0 + origin[0], v0 + origin[1]), quantum, aspect)
    saturated = saturated_share(window, ceiling, fit, corner)
    flags = flags_of(fit, saturated=saturated, expected=expected, bright=found.bright, eight_bit=eight_bit)
    moved = tuple(replace(c, u=c.u + u0 + origin[0], v=c.v + v0 + origin[1]) for c in candidates)
    return _ball_image(fit, scanner, flags, moved)


def _bad_pixels(values: Array, mask: Any, box: tuple[int, int, int, int]) -> Any:
    """Bool array of bad pixels, or None where all are good."""
    v0, v1, u0, u1 = box
    bad = None
    if values.dtype.kind == "f":
        # One sum tells whether all are finite, without an array of answers.
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


def _fitted(
    values: Array, bad: Any, found: Candidate, scanner: Scanner, corner: tuple[int, int], quantum: float,
    aspect: float,
) -> tuple[ConeFit, Array, tuple[int, int]]:  # fmt: skip
    """The fit about the candidate (found in px of `values`), the window it used, and that window's corner in D."""
    reach = 1.2 * found.radius + 32
    v0, u0 = max(int(found.v - reach / aspect), 0), max(int(found.u - reach), 0)
    rows, columns = slice(v0, int(found.v + reach / aspect) + 2), slice(u0, int(found.u + reach) + 2)
    window = values[rows, columns].astype(np.float64)
    good = np.ones(window.shape, dtype=bool) if bad is None else ~bad[rows, columns]
    at = (corner[0] + u0, corner[1] + v0)
    start = np.array([found.u + corner[0], found.v + corner[1]])
    radius = found.radius / math.sqrt(aspect)
    fit = fit_cone(window, good, at, scanner, start, radius, quantum)
    shift = math.hypot(*(fit.shape[:2] - start))
    if shift > 1.0 + 0.03 * radius or abs(fit.shape[2] / radius - 1) > 0.2 + 2.0 / radius:
        raise BallNotFoundError(
            f"the shape at ({start[0]:.1f}, {start[1]:.1f}), radius {radius:.1f} px, is no ball: the fit went "
            f"{shift:.1f} px away, to radius {fit.shape[2]:.1f} px"
        )
    if fit.visible < 0.5:
        raise BallTruncatedError(
            f"the ball at ({fit.shape[0]:.1f}, {fit.shape[1]:.1f}) shows only {100 * fit.visible:.0f} % of its rim; "
            "at least half is needed"
        )
    contrast = abs(fit.level - fit.white)
    if fit.rim_rms > max(WORST_RIM * contrast, 5.0 * fit.noise_out):
        raise BallNotFoundError(
            f"the shape at ({fit.shape[0]:.1f}, {fit.shape[1]:.1f}) is no ball: its rim differs from a blurred circle "
            f"by {100 * fit.rim_rms / contrast:.0f} % of its contrast"
        )
    sigma = math.sqrt(np.trace(fit.shape_covariance[:2, :2]))
    if not sigma < WORST_SIGMA:
        raise DetectionError(f"too few photons: the centre would be uncertain by {sigma:.2g} px; expose longer")
    return fit, window, at


def _ball_image(fit: ConeFit, scanner: Scanner, flags: tuple[str, ...], candidates: tuple[Candidate, ...]) -> BallImage:
    x_D = fit.shape[:2].copy()
    centre, major, minor, angle = silhouette_ellipse(scanner, x_D, fit.gamma)
    return BallImage(
        x_D=x_D,
        covariance=fit.shape_covariance[:2, :2].copy(),
        radius=float(fit.shape[2]),
        sigma_radius=float(math.sqrt(fit.shape_covariance[2, 2])),
        x_ellipse=centre,
        semi_major=major,
        semi_minor=minor,
        angle=angle,
        snr=fit.snr,
        blur=float(fit.shape[3]),
        kappa=float(fit.shape[4]),
        visible=fit.visible,
        lost=fit.lost,
        misfit=fit.misfit,
        anisotropy=fit.anisotropy,
        anisotropy_covariance=fit.anisotropy_covariance,
        correlated=bool(np.count_nonzero(fit.rho) > 1),
        level=fit.level,
        white=fit.white,
        flags=flags,
        candidates=candidates,
    )
