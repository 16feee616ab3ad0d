"""All radiographs of a calibration: one row each, measured or refused with the reason."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tomopose.detection.flags import expected_radius, motion_length
from tomopose.detection.image import checked_diameter
from tomopose.detection.reading import Image, region_about
from tomopose.detection.run.checks import (
    Row,
    nominal_radius_is_off,
    of_one_size,
    refuse_another_form,
    refuse_unusable,
)
from tomopose.detection.run.executors import ordered_map
from tomopose.detection.run.journal import append, open_journal
from tomopose.detection.run.lag import Lag, usual_lag
from tomopose.detection.run.rows import Before, LazyImage, Task, Work, column, row_of, with_lag
from tomopose.detection.settings import DEFAULT, DetectionSettings
from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.kept import key_of
from tomopose.observations import BallObservations
from tomopose.units import Array
from tomopose.values import require_types


@require_types
def detect(
    images: Iterable[Image],
    scanner: Scanner,
    *,
    ball_diameter: float | Mapping[int, float],
    ball_id: Sequence[int] | npt.NDArray[np.int64] | None = None,
    pose_id: Iterable[str | int] | None = None,
    predicted: npt.ArrayLike | None = None,
    origin: tuple[int, int] | Sequence[tuple[int, int]] = (0, 0),
    workers: int = 1,
    executor: object = None,
    progress: Callable[[int, int], None] | None = None,
    journal: str | Path | None = None,
    settings: DetectionSettings = DEFAULT,
) -> BallObservations:
    """Where the ball's centre is projected in each radiograph, with its covariance.

    Parameters
    ----------
    images:         arrays [v, u] (row index = v), counts or transmission, or a lazy sequence with `len`, `[i]` and
                    `region(i, v0, v1, u0, u1)` (and, if it has them, `names`, a bad-pixel `mask`, and `fetch(i, v0,
                    v1)` that asks the system for rows beforehand), which is read in the worker processes.  One image
                    is handled at a time.
    scanner:        intrinsic geometry.
    ball_diameter:  nominal, mm; or, where each image shows several balls, ball id -> mm of all of them.
    ball_id:        (n,) which ball each row is for, with several balls: an image that shows two of them comes twice.
                    They are identified by `predicted`, or by their size where diameters differ by 20 %.
    pose_id:        names of the rows; without it, the images' indices.
    predicted:      (n, 2) px in D where the ball should be (NaN: not known): only that region is read and searched.
    origin:         D coordinates (u, v) of pixel [0, 0], for cropped images; or (n, 2), one for each image.
    workers:        processes.
    executor:       a concurrent.futures executor or a dask.distributed client to use instead.
    progress:       called with (done, total); total is 0 where the number of images is not known beforehand.
    journal:        file to which each finished image is added; images found in it unchanged are not measured again.
    settings:       thresholds, each with its origin.

    Returns
    -------
    BallObservations: an image that cannot be measured has seen False and its status begins with the reason ("not
    found", "truncated", "ambiguous", "saturated rim", "too few photons", "bad pixels on the rim", "bad image"); a
    measured one is "ok" or names its flags (flags.FLAGS); `ball_id` is that of the rows, where it was given.  The
    numbers do not depend on workers or executor.

    Raises
    ------
    InputError  where the counts disagree; where an image has another shape or type than the first; where more than one
                image and more than 5 % of them, or all, are unusable (unreadable, of the wrong size, bytes or pitches
                exchanged); where the ball has 20 % more or less than its nominal size in every image.
    """
    run = _run(
        images, scanner, diameters=_Diameters(ball_diameter, ball_id), pose_id=pose_id, predicted=predicted,
        origin=origin, journal=journal, settings=settings,
    )  # fmt: skip
    rows = _measured(run, workers=workers, executor=executor, progress=progress)
    refuse_unusable(rows, settings.run)
    found = _observations(run.diameters.judged(rows, scanner, settings), run.ids, run.names, settings)
    found = found.with_ball_diameter(run.diameters.common)
    balls = run.diameters.ball_id
    return found if balls is None else replace(found, ball_id=balls)


@dataclass(frozen=True, kw_only=True)
class _Run:
    """The images in order, with what is known of each beforehand.

    total: number of images, 0 where it is not known.  names, ids, predicted (n, 2) px: one for each image, or None.
    done: rows of an earlier run by name, from the journal.
    """

    images: Iterable[Image]
    total: int
    work: Work
    diameters: _Diameters
    names: tuple[str, ...] | None
    ids: tuple[str, ...] | None
    predicted: Array | None
    origin: tuple[int, int] | Sequence[tuple[int, int]]
    journal: Path | None
    done: Mapping[str, Row]

    def task(self, i: int) -> Task:
        where = self.predicted
        at = None if where is None or i >= len(where) else (float(where[i, 0]), float(where[i, 1]))
        own, others = self.diameters.at(i)
        name = self.names[i] if self.names is not None else str(i)
        if self.diameters.given_ids is not None:
            name = f"{name} ball {self.diameters.given_ids[i]}"
        return Task(
            name=name, ball_diameter=own, other_diameters=others, predicted=at, origin=_origin_of(self.origin, i)
        )  # fmt: skip

    def tasks(self) -> Iterator[tuple[Image, Task, Row | None]]:
        """(image, its task, its row of an earlier run); the next lazy image comes from the disk meanwhile."""
        images = self.images
        lazy = hasattr(images, "region") and hasattr(images, "__len__")
        source = (LazyImage(images, i) for i in range(self.total)) if lazy else images
        for i, image in enumerate(source):
            if lazy and hasattr(images, "fetch") and i + 1 < self.total:
                _fetch(images, i + 1, self.task(i + 1), self.work.scanner)
            task = self.task(i)
            yield image, task, self.done.get(task.name)


def _run(
    images: Iterable[Image], scanner: Scanner, *, diameters: _Diameters, pose_id: Iterable[Any] | None,
    predicted: npt.ArrayLike | None, origin: tuple[int, int] | Sequence[tuple[int, int]], journal: str | Path | None,
    settings: DetectionSettings,
) -> _Run:  # fmt: skip
    """The run that `detect` is asked for; InputError where the counts disagree.  Opens the journal."""
    total = len(images) if isinstance(images, Sized) else 0
    names = getattr(images, "names", None)
    names = None if names is None else tuple(str(n) for n in names)
    ids = None if pose_id is None else tuple(str(i) for i in pose_id)
    where = None if predicted is None else np.asarray(predicted, dtype=np.float64).reshape(-1, 2)
    columns = {"pose ids": ids, "predicted positions": where, "image names": names, "ball ids": diameters.given_ids}
    for name, given in columns.items():
        if total and given is not None and len(given) != total:
            raise InputError(f"{total} images but {len(given)} {name}; one for each image is needed")
    work = Work(scanner=scanner, mask=getattr(images, "mask", None), settings=settings, keyed=journal is not None)
    path = None if journal is None else Path(journal)
    done: dict[str, Row] = {}
    if path is not None:
        key = key_of("detection-journal", scanner=scanner, balls=diameters.words, mask=work.mask, settings=settings)
        done = open_journal(path, key)
    return _Run(
        images=images, total=total, work=work, diameters=diameters, names=names, ids=ids, predicted=where,
        origin=origin, journal=path, done=done,
    )  # fmt: skip


def _measured(
    run: _Run, *, workers: int, executor: Any, progress: Callable[[int, int], None] | None
) -> list[Row]:  # fmt: skip
    """The row of each image, in order, freed of the share that the previous ball left; kept in the journal."""
    rows: list[Row] = []
    before: dict[float, Before] = {}
    lags: list[Lag] = []
    measure = partial(row_of, work=run.work)
    for (image, task, _), row in ordered_map(measure, run.tasks(), workers=workers, executor=executor):
        if run.journal is not None and row != run.done.get(row["name"]):
            append(run.journal, row)
        if rows and np.ndim(run.origin) == 1:
            refuse_another_form(rows[0], row)
        held = np.asarray(image) if not isinstance(image, LazyImage) and "x_D" in row else image
        row, lag = with_lag(row, held, before.get(task.ball_diameter), task, work=run.work)
        rows.append(row)
        lags += [lag] if lag.share > 0 else []
        before[task.ball_diameter] = Before(row, held if "x_D" in row else NOTHING, usual_lag(lags))
        if progress is not None:
            progress(len(rows), run.total)
    return rows


NOTHING = np.zeros((0, 0))
"""In place of an image in which no ball was measured, so that it is freed."""


class _Diameters:
    """The nominal diameters of each row's ball, and of the others in its image."""

    def __init__(
        self, given: float | Mapping[int, float], ball_id: Sequence[int] | npt.NDArray[np.int64] | None
    ) -> None:  # fmt: skip
        self.given_ids = ball_id
        if isinstance(given, Mapping):
            self.by_ball = {int(b): checked_diameter(d) for b, d in given.items()}
            if ball_id is None and len(self.by_ball) != 1:
                raise InputError(f"{len(self.by_ball)} diameters but no ball_id; say which ball each row is for")
            unknown = sorted({int(b) for b in (() if ball_id is None else ball_id)} - set(self.by_ball))
            if unknown:
                raise InputError(f"ball {unknown[0]} has no diameter; given are those of {sorted(self.by_ball)}")
        else:
            self.by_ball = {0: checked_diameter(given)}
            ball_id = None
        self.ball_id = ball_id

    @property
    def common(self) -> float | None:
        """mm, of every ball; None where they differ."""
        return next(iter(self.by_ball.values())) if len(set(self.by_ball.values())) == 1 else None

    @property
    def words(self) -> str:
        return repr((sorted(self.by_ball.items()), None if self.ball_id is None else [int(b) for b in self.ball_id]))

    def at(self, i: int) -> tuple[float, tuple[float, ...]]:
        ball = next(iter(self.by_ball)) if self.ball_id is None else int(self.ball_id[i])
        return self.by_ball[ball], tuple(d for b, d in self.by_ball.items() if b != ball)

    def judged(self, rows: list[Row], scanner: Scanner, settings: DetectionSettings) -> list[Row]:
        """The rows after the rules that need all rows of one ball: sizes that agree, and with the nominal one."""
        out = list(rows)
        for ball, diameter in self.by_ball.items():
            at = [i for i in range(len(rows)) if self.ball_id is None or int(self.ball_id[i]) == ball]
            own = of_one_size([rows[i] for i in at], settings.run)
            off = nominal_radius_is_off(own, expected_radius(scanner, diameter), diameter, settings.run)
            for i, row in zip(at, own, strict=True):
                out[i] = {**row, "off": off}
        return out


def _fetch(images: Any, i: int, task: Task, scanner: Scanner) -> None:
    """Lets image i come from the disk while the one before is measured."""
    rows, columns = LazyImage(images, i).shape
    v0, v1 = 0, rows
    if task.predicted is not None and np.isfinite(task.predicted).all():
        expected = expected_radius(scanner, task.ball_diameter)
        at = np.asarray(task.predicted) - task.origin
        v0, v1, *_ = region_about(at, (rows, columns), scanner, expected)
    if v0 < v1:
        images.fetch(i, v0, v1)


def _origin_of(origin: tuple[int, int] | Sequence[tuple[int, int]], index: int) -> tuple[int, int]:
    pair: Any = origin if np.ndim(origin) == 1 else origin[index]
    return pair[0], pair[1]


def _observations(
    rows: list[Row], ids: tuple[str, ...] | None, names: tuple[str, ...] | None, settings: DetectionSettings
) -> BallObservations:
    n = len(rows)
    if ids is not None and len(ids) != n:
        raise InputError(f"{n} images but {len(ids)} pose ids; one for each image is needed")
    seen = np.array(["x_D" in row for row in rows], dtype=bool)
    usual = np.zeros(2)
    if seen.sum() >= settings.run.enough:
        usual = np.median([row["anisotropy"] for row in rows if "x_D" in row], axis=0)
    return BallObservations(
        x_D=column(rows, "x_D", 2),
        covariance=column(rows, "covariance", 2, 2),
        pose_id=ids if ids is not None else tuple(str(i) for i in range(n)),
        seen=seen,
        status=tuple(_status(row, usual, settings) for row in rows),
        image=names,
        snr=column(rows, "snr"),
        semi_major=column(rows, "semi_major"),
        semi_minor=column(rows, "semi_minor"),
        angle=column(rows, "angle"),
        x_ellipse=column(rows, "x_ellipse", 2),
    )


def _status(row: Row, usual: Array, settings: DetectionSettings) -> str:
    if "x_D" not in row:
        return str(row["reason"])
    flags = [f for f in row["flags"] if f != "moved"]
    if row["off"] and "radius off nominal" not in flags:
        flags.append("radius off nominal")
    anisotropy, covariance = np.asarray(row["anisotropy"]) - usual, np.asarray(row["anisotropy_covariance"])
    if motion_length(anisotropy, covariance, row["blur"], settings) > 0:
        flags.append("moved")
    if row["lag"] > 0:
        flags.append(f"lag {100 * row['lag']:.1f} %")
    return "; ".join(flags) if flags else "ok"
