"""One radiograph: checked, searched, fitted, judged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tomopose.detection.finder.find import Candidate, find_ball
from tomopose.detection.flags import expected_radius, flags_of, saturated_share
from tomopose.detection.reading import (
    REGION_REACH,
    SMALLEST_IMAGE,
    Box,
    Image,
    Mask,
    Pixels,
    checked_shape,
    read_pixels,
    region_about,
)
from tomopose.detection.result import BallImage
from tomopose.detection.rim_fit.covariance import ConeFit
from tomopose.detection.rim_fit.fit import fit_cone
from tomopose.detection.rim_model.ring import BallWindow, ball_window
from tomopose.detection.settings import DEFAULT, DetectionSettings
from tomopose.errors import AmbiguousBallError, BallNotFoundError, BallTruncatedError, DetectionError, InputError
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.silhouette import silhouette_ellipse
from tomopose.units import Array
from tomopose.values import require_types

ALIKE = math.log(1.2)
"""Ratio of two diameters, as a logarithm, below which size does not distinguish the balls: magnification varies by 10 %
over a run."""
WIDTHS_ABOUT = 14.0
"""The window reaches so many widths of the finder's blur beyond its circle: the ring's 10, and what the finder, which
takes a wide blur for a smaller ball, leaves out of both."""


@require_types
def detect_image(
    image: Image,
    scanner: Scanner,
    *,
    ball_diameter: float,
    other_diameters: Sequence[float] = (),
    predicted: npt.ArrayLike | None = None,
    origin: tuple[int, int] = (0, 0),
    mask: Mask = None,
    settings: DetectionSettings = DEFAULT,
) -> BallImage:
    """The ball in one radiograph.

    Parameters
    ----------
    image:          [v, u]; counts or transmission; NaN and infinite pixels count as bad.  An object with `shape` and
                    `region(v0, v1, u0, u1)` is read only where needed.
    scanner:        intrinsic geometry; it gives the ray of each pixel.
    ball_diameter:  nominal, mm: a preference, not a condition.
    other_diameters:  of further balls in the image, mm: without a prediction the size decides which one is meant.
    predicted:      (u, v) in D where the ball should be: only the region about it is read and searched.
    origin:         D coordinates (u, v) of pixel [0, 0].
    mask:           bool [v, u], true for bad pixels.
    settings:       thresholds, each with its origin.

    Raises
    ------
    InputError, ShapeError   not a valid image, or one of another size than the scanner's detector.
    BallNotFoundError, BallTruncatedError, AmbiguousBallError, DetectionError   no measurement, with the reason.
    """
    expected = expected_radius(scanner, checked_diameter(ball_diameter))
    others = [expected_radius(scanner, checked_diameter(d)) for d in other_diameters]
    if predicted is None and any(abs(math.log(r / expected)) < ALIKE for r in others):
        raise AmbiguousBallError(
            f"another ball of the image has almost the diameter of this one ({ball_diameter:g} mm), so that size does "
            "not identify it; give predicted positions"
        )
    corner = _whole_numbers(origin)
    shape = checked_shape(image, scanner, corner)

    def within(box: Box, at: Array | None) -> BallImage:
        pixels = read_pixels(image, box, mask, corner)
        near = None if at is None else (float(at[0]) - box[2], float(at[1]) - box[0])
        return _only_ball(pixels, scanner, expected, others, near, settings)

    place = None if predicted is None else np.asarray(predicted, dtype=np.float64)
    if place is None or not np.isfinite(place).all():
        return within((0, shape[0], 0, shape[1]), None)
    at = place - corner
    for reach in (REGION_REACH, 2 * REGION_REACH + 1):
        box = region_about(at, shape, scanner, expected, reach)
        if box[1] - box[0] < SMALLEST_IMAGE or box[3] - box[2] < SMALLEST_IMAGE:
            raise BallNotFoundError(f"the predicted position ({place[0]:.1f}, {place[1]:.1f}) is out of view")
        try:
            return within(box, at)
        except (BallNotFoundError, BallTruncatedError):
            if reach > REGION_REACH or box == (0, shape[0], 0, shape[1]):
                raise
    raise AssertionError("unreachable")


def checked_diameter(ball_diameter: float) -> float:
    """The diameter, mm; InputError where it is not a positive number."""
    if isinstance(ball_diameter, bool) or not isinstance(ball_diameter, int | float | np.floating | np.integer):
        raise InputError(f"ball_diameter must be a number of mm; a {type(ball_diameter).__name__} was given")
    if not (math.isfinite(ball_diameter) and ball_diameter > 0):
        raise InputError(f"ball_diameter is {ball_diameter!r} mm; a positive number is needed")
    return float(ball_diameter)


def _whole_numbers(origin: tuple[int, int]) -> tuple[int, int]:
    u, v = origin
    if int(u) != u or int(v) != v:
        raise InputError(f"origin is ({u}, {v}); whole pixels are needed")
    return int(u), int(v)


def _only_ball(
    pixels: Pixels, scanner: Scanner, expected: float, others: Sequence[float], near: tuple[float, float] | None,
    settings: DetectionSettings,
) -> BallImage:  # fmt: skip
    aspect = scanner.p_v / scanner.p_u
    stretch = math.sqrt(aspect)
    found, candidates = find_ball(
        pixels.values, expected * stretch, aspect, near=near, others=[r * stretch for r in others],
        settings=settings.finder,
    )  # fmt: skip
    return measured_ball(pixels, scanner, found, candidates, expected=expected, settings=settings)


def measured_ball(
    pixels: Pixels, scanner: Scanner, found: Candidate, candidates: Sequence[Candidate], *, expected: float,
    settings: DetectionSettings,
) -> BallImage:  # fmt: skip
    """The ball that the finder gives, in px of `pixels`, fitted and judged; candidates: what else it gave."""
    window, start, radius = _window_about(pixels, scanner, found)
    fit = fit_cone(window, start, radius, expected=expected, blur=found.blur, quantum=pixels.quantum, settings=settings)
    _require_a_ball(fit, start, radius, settings)
    saturated = saturated_share(window, pixels.ceiling, fit, settings.flags)
    flags = flags_of(
        fit, saturated=saturated, expected=expected, bright=found.bright, eight_bit=pixels.eight_bit,
        settings=settings,
    )  # fmt: skip
    u, v = pixels.corner
    others = tuple(replace(c, u=c.u + u, v=c.v + v) for c in candidates)
    return _ball_image(fit, scanner, flags, others)


def _window_about(pixels: Pixels, scanner: Scanner, found: Candidate) -> tuple[BallWindow, Array, float]:
    """The window that the fit may use, and where it begins: centre in D and radius, px."""
    aspect = scanner.p_v / scanner.p_u
    radius = found.radius / math.sqrt(aspect)
    reach = max(1.2 * found.radius + 32, found.radius + WIDTHS_ABOUT * found.blur)
    v0, u0 = max(int(found.v - reach / aspect), 0), max(int(found.u - reach), 0)
    rows, columns = slice(v0, int(found.v + reach / aspect) + 2), slice(u0, int(found.u + reach) + 2)
    values = pixels.values[rows, columns].astype(np.float64)
    good = np.ones(values.shape, dtype=bool)
    if pixels.bad is not None:
        good &= ~pixels.bad[rows, columns]
    start = np.array([found.u + pixels.corner[0], found.v + pixels.corner[1]])
    at = (pixels.corner[0] + u0, pixels.corner[1] + v0)
    return ball_window(values, good, at, scanner, start, radius), start, radius


def _require_a_ball(fit: ConeFit, start: Array, radius: float, settings: DetectionSettings) -> None:
    """The reason why what was fitted is no measurement, as an error."""
    limits, (u, v, fitted) = settings.flags, fit.shape[:3].tolist()
    shift = math.hypot(*(fit.shape[:2] - start))
    blurred = fit.shape[3] > settings.fit.size_from * radius
    if shift > 1.0 + 0.03 * radius + (fit.shape[3] / 3 if blurred else 0.0) or (
        abs(fitted / radius - 1) > 0.2 + 2.0 / radius + (0.4 if blurred else 0.0)
    ):
        raise BallNotFoundError(
            f"the shape at ({start[0]:.1f}, {start[1]:.1f}), radius {radius:.1f} px, is not a ball: the fit went "
            f"{shift:.1f} px away, to radius {fitted:.1f} px"
        )
    if fit.visible < limits.least_visible:
        raise BallTruncatedError(
            f"the ball at ({u:.1f}, {v:.1f}) shows only {100 * fit.visible:.0f} % of its rim; at least half is needed"
        )
    if fit.rim_rms > max(limits.worst_rim * fit.contrast, 5.0 * fit.noise_outside):
        raise BallNotFoundError(
            f"the shape at ({u:.1f}, {v:.1f}) is not a ball: its rim differs from a blurred circle by "
            f"{100 * fit.rim_rms / fit.contrast:.0f} % of its contrast"
        )
    sigma = math.sqrt(np.trace(fit.shape_covariance[:2, :2]))
    if not sigma < limits.worst_sigma:
        raise DetectionError(f"too few photons: the centre would be uncertain by {sigma:.2g} px; expose longer")


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
        anisotropy=fit.anisotropy.value,
        anisotropy_covariance=fit.anisotropy.covariance,
        correlated=fit.noise.correlated,
        level=fit.level,
        white=fit.white,
        flags=flags,
        candidates=candidates,
    )
