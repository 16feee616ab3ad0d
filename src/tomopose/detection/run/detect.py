"""All radiographs of a calibration: one row each, measured or refused with the reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.detection.flags import MOTION, expected_radius, motion_length
from tomopose.detection.image import detect_image, region_about
from tomopose.detection.result import BallImage
from tomopose.detection.run.checks import (
    NO_FORM,
    RUN,
    Row,
    nominal_radius_is_off,
    of_one_size,
    refuse_another_form,
    refuse_unusable,
)
from tomopose.detection.run.executors import ordered_map
from tomopose.detection.run.input_faults import fault_of_input
from tomopose.detection.run.journal import append, fingerprint, read_journal
from tomopose.detection.run.lag import ghost_share
from tomopose.errors import (
    AmbiguousBallError,
    BallNotFoundError,
    BallTruncatedError,
    DetectionError,
    InputError,
    TomoposeError,
)
from tomopose.geometry.scanner import Scanner
from tomopose.observations import BallObservations
from tomopose.units import Array


class _Lazy:
    """One image of a lazy sequence: read in the process that measures it, and only where needed."""

    def __init__(self, images: Any, index: int) -> None:
        self.images, self.index = images, index

    @property
    def shape(self) -> tuple[int, ...]:
        shape = getattr(self.images, "shape", None)
        if shape is not None:
            return tuple(shape)[-2:]
        return tuple(np.shape(self.images[self.index]))

    def region(self, v0: int, v1: int, u0: int, u1: int) -> Array:
        return np.asarray(self.images.region(self.index, v0, v1, u0, u1))


def detect(
    images: Iterable[Any],
    scanner: Scanner,
    *,
    ball_diameter: float = 8.0,
    pose_id: Iterable[Any] | None = None,
    predicted: Any = None,
    origin: tuple[int, int] = (0, 0),
    workers: int = 1,
    executor: Any = None,
    progress: Callable[[int, int], None] | None = None,
    journal: str | Path | None = None,
) -> BallObservations:
    """Where the ball's centre is projected in each radiograph, with its covariance.

    Parameters
    ----------
    images:         arrays [v, u] (row index = v), counts or transmission, or a lazy sequence with `len`, `[i]` and
                    `region(i, v0, v1, u0, u1)` (and, if it has them, `names`, a bad-pixel `mask`, and `fetch(i, v0,
                    v1)` that asks the system for rows beforehand), which is read in the worker processes.  One image
                    is handled at a time.
    scanner:        intrinsic geometry.
    ball_diameter:  nominal, mm.
    pose_id:        names of the rows; without it, the images' indices.
    predicted:      (n, 2) px in D where the ball should be (NaN: not known): only that region is read and searched.
    origin:         D coordinates (u, v) of pixel [0, 0], for cropped images; or (n, 2), one for each image.
    workers:        processes.
    executor:       a concurrent.futures executor or a dask.distributed client to use instead.
    progress:       called with (done, total); total is 0 where the number of images is not known beforehand.
    journal:        file to which each finished image is added; images found in it unchanged are not measured again.

    Returns
    -------
    BallObservations: an image that cannot be measured has seen False and its status begins with the reason ("not
    found", "truncated", "ambiguous", "saturated rim", "too few photons", "bad pixels on the rim", "bad image"); a
    measured one is "ok" or names its flags (flags.FLAGS).  The numbers do not depend on workers or executor.

    Raises
    ------
    InputError  where the counts disagree; where an image has another shape or type than the first; where more than one
                image and more than 5 % of them, or all, are unusable (unreadable, of the wrong size, bytes or pitches
                exchanged); where the ball has 20 % more or less than its nominal size in every image.
    """
    lazy = hasattr(images, "region") and hasattr(images, "__len__")
    total = len(images) if hasattr(images, "__len__") else 0  # type: ignore[arg-type]
    names = getattr(images, "names", None)
    names = None if names is None else tuple(str(n) for n in names)
    ids = None if pose_id is None else tuple(str(i) for i in pose_id)
    where = None if predicted is None else np.asarray(predicted, dtype=np.float64).reshape(-1, 2)
    for name, column in (("pose ids", ids), ("predicted positions", where), ("image names", names)):
        if total and column is not None and len(column) != total:
            raise InputError(f"{total} images but {len(column)} {name}; one for each image is needed")
    settings = f"{scanner!r} {ball_diameter!r}"
    path = None if journal is None else Path(journal)
    done = read_journal(path)
    work = partial(_row, scanner=scanner, ball_diameter=ball_diameter, mask=getattr(images, "mask", None),
                   settings=settings, keyed=path is not None)  # fmt: skip

    def fetch(i: int) -> None:
        """Lets image i come from the disk while the one before is measured, where the images can be asked to."""
        if not (lazy and hasattr(images, "fetch") and i < total):
            return
        rows, columns = _Lazy(images, i).shape
        v0, v1 = 0, rows
        if where is not None and np.isfinite(where[i]).all():
            expected = expected_radius(scanner, ball_diameter)
            v0, v1, *_ = region_about(where[i] - _origin_of(origin, i), (rows, columns), scanner, expected)
        if v0 < v1:
            images.fetch(i, v0, v1)

    def tasks() -> Iterator[tuple[Any, ...]]:
        source = (_Lazy(images, i) for i in range(total)) if lazy else images
        for i, image in enumerate(source):
            fetch(i + 1)
            name = names[i] if names is not None else str(i)
            at = None if where is None else (where[i] if i < len(where) else None)
            yield image, name, None if at is None else tuple(at), _origin_of(origin, i), done.get(name)

    rows: list[Row] = []
    for task, row in ordered_map(work, tasks(), workers=workers, executor=executor):
        if path is not None and row is not done.get(row["name"]) and row != done.get(row["name"]):
            append(path, row)
        if rows and np.ndim(origin) == 1:
            refuse_another_form(rows[0], row)
        rows.append({**row, "lag": _lag(task[0], task[3], scanner, row, rows[-1] if rows else None)})
        if progress is not None:
            progress(len(rows), total)
    refuse_unusable(rows)
    rows = of_one_size(rows)
    off = nominal_radius_is_off(rows, expected_radius(scanner, ball_diameter), ball_diameter)
    return _observations(rows, ids, names, off)


def _origin_of(origin: Any, index: int) -> tuple[int, int]:
    pair = origin if np.ndim(origin) == 1 else origin[index]
    return pair[0], pair[1]


def _row(
    image: Any, name: str, predicted: tuple[float, float] | None, origin: tuple[int, int], done: Row | None, *,
    scanner: Scanner, ball_diameter: float, mask: Any, settings: str, keyed: bool,
) -> Row:  # fmt: skip
    """One image's row as plain numbers, for journal and process borders."""
    row: Row = {"name": name, "key": "", "form": list(NO_FORM)}
    options = {"ball_diameter": ball_diameter, "predicted": predicted, "origin": origin, "mask": mask}
    try:
        if not isinstance(image, _Lazy):
            image = np.asarray(image)
        row["form"] = [list(image.shape), getattr(getattr(image, "dtype", None), "name", "")]
        if keyed:
            row["key"] = fingerprint(image, f"{settings} {predicted} {origin}") if len(image.shape) == 2 else ""
            if done is not None and row["key"] and done.get("key") == row["key"]:
                return done
        try:
            return row | _numbers(detect_image(image, scanner, **options))
        except DetectionError as error:
            # no name here for what is found: it would hold this frame, and with it the image, until the next collection
            return _refused(row, fault_of_input(image, scanner, **options) or error)
    except (TomoposeError, OSError, ValueError, EOFError) as error:
        return _refused(row, error)


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


def _lag(image: Any, origin: tuple[int, int], scanner: Scanner, row: Row, previous: Row | None) -> float:
    """Share of the contrast that the previous ball left in this image."""
    if previous is None or "x_D" not in row or "x_D" not in previous:
        return 0.0
    before, aspect = np.asarray(previous["x_D"]), scanner.p_v / scanner.p_u
    radius = row["radius"] * math.sqrt(aspect)
    before_radius = previous["radius"] * math.sqrt(aspect)
    shape = tuple(image.shape)
    u, v, reach = before[0] - origin[0], before[1] - origin[1], before_radius + 7.0
    u0, v0 = max(int(u - reach), 0), max(int(v - reach / aspect), 0)
    u1, v1 = min(int(u + reach) + 2, shape[1]), min(int(v + reach / aspect) + 2, shape[0])
    if u1 - u0 < 8 or v1 - v0 < 8:
        return 0.0
    part = image.region(v0, v1, u0, u1) if isinstance(image, _Lazy) else np.asarray(image)[v0:v1, u0:u1]
    return ghost_share(
        np.asarray(part, dtype=np.float64), (u0 + int(origin[0]), v0 + int(origin[1])), np.asarray(row["x_D"]), radius,
        before, before_radius, row["contrast"], aspect,
    )  # fmt: skip


def _observations(
    rows: list[Row], ids: tuple[str, ...] | None, names: tuple[str, ...] | None, off: bool
) -> BallObservations:
    n = len(rows)
    if ids is not None and len(ids) != n:
        raise InputError(f"{n} images but {len(ids)} pose ids; one for each image is needed")
    seen = np.array(["x_D" in row for row in rows], dtype=bool)
    usual = np.zeros(2)
    if seen.sum() >= RUN:
        usual = np.median([row["anisotropy"] for row in rows if "x_D" in row], axis=0)

    def column(name: str, *shape: int) -> Array:
        missing = np.full(shape, np.nan)
        return np.array([row.get(name, missing) for row in rows], dtype=np.float64).reshape(n, *shape)

    return BallObservations(
        x_D=column("x_D", 2),
        covariance=column("covariance", 2, 2),
        pose_id=ids if ids is not None else tuple(str(i) for i in range(n)),
        seen=seen,
        status=tuple(_status(row, usual, off) for row in rows),
        image=names,
        snr=column("snr"),
        semi_major=column("semi_major"),
        semi_minor=column("semi_minor"),
        angle=column("angle"),
        x_ellipse=column("x_ellipse", 2),
    )


def _status(row: Row, usual: Array, off: bool) -> str:
    if "x_D" not in row:
        return str(row["reason"])
    flags = [f for f in row["flags"] if f != "moved"]
    if off and "radius off nominal" not in flags:
        flags.append("radius off nominal")
    if motion_length(np.asarray(row["anisotropy"]) - usual, np.asarray(row["anisotropy_covariance"])) > MOTION:
        flags.append("moved")
    if row["lag"] > 0:
        flags.append(f"lag {100 * row['lag']:.1f} %")
    return "; ".join(flags) if flags else "ok"
