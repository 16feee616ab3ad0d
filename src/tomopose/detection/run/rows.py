"""One image of a run as a row of plain numbers, which can pass the borders of processes and journals."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tomopose.detection.image import detect_image
from tomopose.detection.reading import Image, Mask
from tomopose.detection.result import BallImage
from tomopose.detection.run.checks import NO_FORM, Row
from tomopose.detection.run.input_faults import fault_of_input
from tomopose.detection.run.journal import fingerprint
from tomopose.detection.run.lag import NO_LAG, Ball, Lag, WithoutLag, measured_lag
from tomopose.detection.settings import DetectionSettings
from tomopose.errors import (
    AmbiguousBallError,
    BallNotFoundError,
    BallTruncatedError,
    DetectionError,
    InputError,
    TomoposeError,
)
from tomopose.geometry.scanner import Scanner
from tomopose.units import Array

LAG_SHIFT = 0.3
"""Shift of the centre, px per unit share of lag, that is allowed for where the corrected image cannot be measured.
Assumed from one reported case, in which a lag of about 3 % moved a centre by 0.0085 px; not measured here."""
UNREADABLE = (OSError, ValueError, EOFError)
"""What a sequence of images raises where a file is damaged, or where an entry is not an array of one shape."""


@contextlib.contextmanager
def reading_image() -> Iterator[None]:
    """What goes wrong while pixels are read is a fault of the image; what goes wrong later would be ours."""
    try:
        yield
    except TomoposeError:
        raise
    except UNREADABLE as error:
        raise InputError(f"{error or type(error).__name__}") from error


class LazyImage:
    """One image of a lazy sequence: read in the process that measures it, and only where needed."""

    def __init__(self, images: object, index: int) -> None:
        self.images, self.index = images, index

    @property
    def shape(self) -> tuple[int, ...]:
        shape = getattr(self.images, "shape", None)
        if shape is not None:
            return tuple(shape)[-2:]
        with reading_image():
            return tuple(np.shape(self.images[self.index]))  # type: ignore[index]

    def region(self, v0: int, v1: int, u0: int, u1: int) -> Array:
        with reading_image():
            return np.asarray(self.images.region(self.index, v0, v1, u0, u1))  # type: ignore[attr-defined]


@dataclass(frozen=True, kw_only=True)
class Task:
    """What is measured in one image: name of the row, the ball's diameter and that of others, mm, and where."""

    name: str
    ball_diameter: float
    other_diameters: tuple[float, ...]
    predicted: tuple[float, float] | None
    origin: tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Work:
    """What all images of a run share; keyed: whether a row carries the image's digest."""

    scanner: Scanner
    mask: Mask
    settings: DetectionSettings
    keyed: bool


def row_of(image: Image, task: Task, done: Row | None, *, work: Work) -> Row:
    """The image's row: measured, refused with the reason, or the one that was done before."""
    row: Row = {"name": task.name, "key": "", "form": list(NO_FORM)}
    try:
        if not isinstance(image, LazyImage):
            with reading_image():
                image = np.asarray(image)
        row["form"] = [list(image.shape), getattr(getattr(image, "dtype", None), "name", "")]
        if work.keyed and len(image.shape) == 2:
            row["key"] = fingerprint(image, task.predicted, task.origin)
            if done is not None and done.get("key") == row["key"]:
                return done
        return _measured(row, image, task, work)
    except TomoposeError as error:
        return _refused(row, error)


def _measured(row: Row, image: Image, task: Task, work: Work) -> Row:
    options = {
        "ball_diameter": task.ball_diameter, "other_diameters": task.other_diameters, "predicted": task.predicted,
        "origin": task.origin, "mask": work.mask, "settings": work.settings,
    }  # fmt: skip
    try:
        return row | _numbers(detect_image(image, work.scanner, **options))  # type: ignore[arg-type]
    except DetectionError as error:
        # no name here for what is found: it would hold this frame, and with it the image, until the next collection
        return _refused(row, fault_of_input(image, work.scanner, **options) or error)


class Before(NamedTuple):
    """The previous image of the same ball, its row, and what lag the run has shown so far."""

    row: Row
    image: Image
    usual: Lag


def with_lag(row: Row, image: Image, before: Before | None, task: Task, *, work: Work) -> tuple[Row, Lag]:
    """The row with "lag", the share that the previous ball left; measured again without it where there is some.

    And what was measured in this image itself.
    """
    row = {**row, "lag": 0.0}
    if before is None or "x_D" not in row or "x_D" not in before.row:
        return row, NO_LAG
    measured = _lag(image, row, before.row, task.origin, work)
    lag = before.usual if measured is None else measured
    if lag.share > 0:
        row = _corrected(row | {"lag": lag.share}, image, before.image, lag, task, work)
    return row, measured or NO_LAG


def _corrected(row: Row, image: Image, previous: Image, lag: Lag, task: Task, work: Work) -> Row:
    if tuple(np.shape(previous)) != tuple(np.shape(image)) and not isinstance(image, LazyImage):
        return _widened(row, LAG_SHIFT * lag.share * np.eye(2))
    try:
        corrected = detect_image(
            WithoutLag(image, previous, lag.share), work.scanner, ball_diameter=task.ball_diameter,
            other_diameters=task.other_diameters, predicted=row["x_D"], origin=task.origin, mask=work.mask,
            settings=work.settings,
        )  # fmt: skip
    except TomoposeError:
        return _widened(row, LAG_SHIFT * lag.share * np.eye(2))
    shift = np.asarray(row["x_D"]) - corrected.x_D
    row = row | _numbers(corrected) | {"flags": row["flags"]}
    return _widened(row, lag.sigma / lag.share * shift[:, None])


def _widened(row: Row, root: Array) -> Row:
    """The row with root root' added to its covariance."""
    return row | {"covariance": (np.asarray(row["covariance"]) + root @ root.T).tolist()}


def _lag(image: Image, row: Row, before: Row, origin: tuple[int, int], work: Work) -> Lag | None:
    scanner = work.scanner
    aspect = scanner.p_v / scanner.p_u
    here, previous = (Ball(r["x_D"][0], r["x_D"][1], r["radius"] * math.sqrt(aspect)) for r in (row, before))
    shape = tuple(image.shape)  # type: ignore[union-attr]
    u, v, reach = previous.u - origin[0], previous.v - origin[1], previous.radius + 7.0
    u0, v0 = max(int(u - reach), 0), max(int(v - reach / aspect), 0)
    u1, v1 = min(int(u + reach) + 2, shape[1]), min(int(v + reach / aspect) + 2, shape[0])
    if u1 - u0 < 8 or v1 - v0 < 8:
        return None
    part = image.region(v0, v1, u0, u1) if isinstance(image, LazyImage) else np.asarray(image)[v0:v1, u0:u1]
    return measured_lag(
        np.asarray(part, dtype=np.float64), (u0 + int(origin[0]), v0 + int(origin[1])), here, previous,
        contrast=row["contrast"], aspect=aspect, settings=work.settings.run,
    )  # fmt: skip


def _refused(row: Row, error: Exception) -> Row:
    return row | {"reason": _reason(error), "fault": type(error).__name__}


def _numbers(ball: BallImage) -> Row:
    return {
        "x_D": ball.x_D.tolist(),
        "covariance": ball.covariance.tolist(),
        "snr": ball.snr,
        "semi_major": ball.semi_major,
        "semi_minor": ball.semi_minor,
        "angle": ball.angle,
        "x_ellipse": ball.x_ellipse.tolist(),
        "radius": ball.radius,
        "blur": ball.blur,
        "contrast": ball.level - ball.white,
        "anisotropy": ball.anisotropy.tolist(),
        "anisotropy_covariance": ball.anisotropy_covariance.tolist(),
        "flags": list(ball.flags),
    }


def _reason(error: Exception) -> str:
    """Short word first, then the sentence."""
    message = str(error)
    if isinstance(error, BallNotFoundError):
        return f"not found: {message}"
    if isinstance(error, BallTruncatedError):
        return f"truncated: {message}"
    if isinstance(error, AmbiguousBallError):
        return f"ambiguous: {message}"
    if isinstance(error, DetectionError):
        return message
    return f"bad image: {message}"


def column(rows: list[Row], name: str, *shape: int) -> npt.NDArray[np.float64]:
    """(n, *shape) of the rows' values of that name, NaN where a row has none."""
    missing = np.full(shape, np.nan)
    return np.array([row.get(name, missing) for row in rows], dtype=np.float64).reshape(len(rows), *shape)
