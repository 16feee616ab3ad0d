"""A log with a clock of its own, joined by time with images or with another recording.

Between two rows of the log the position is interpolated linearly and the rotation along the shortest turn.  A gap that
is longer than allowed, or a time outside the log, is refused: a pose that nobody recorded is not invented.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tomopose.errors import InputError
from tomopose.geometry.rotations import convention_from_rotation, exp_rotation, log_rotation
from tomopose.io.foreign.clock_words import seconds_of
from tomopose.io.foreign.column_roles import columns_of, plain_role
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.number_words import number_word
from tomopose.io.foreign.pose_log import ABSOLUTE, PoseLog, some
from tomopose.io.foreign.table_cells import read_cells
from tomopose.units import Array

Indices = npt.NDArray[np.intp]

LONGEST_GAP_S = 1.0
"""s; default of the longest time between two rows of the log across which is interpolated."""
STANDSTILL_S = 1e-9


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Times (m,), s, at which poses are wanted, with what was recorded then."""

    seconds: Array
    clock: str
    stamps: tuple[str, ...]
    pose_id: tuple[str, ...] | None
    image: tuple[str, ...] | None
    alpha: tuple[str, ...] | None


def read_moments(path: Path) -> Moments:
    """The moments of a table with a time column, or of the images of a folder that carry their time (TIFF DateTime).

    InputError where there is no time, or a time that cannot be read.
    """
    if path.is_dir():
        return _image_times(path)
    cells = read_cells(ForeignFile(path), fewest=2)
    columns = columns_of(cells.headers, cells.units_row)
    time = plain_role(columns, "time")
    if time is None:
        raise InputError(f"{path} has no time column; there are {', '.join(cells.headers)}")

    def words(role: str) -> tuple[str, ...] | None:
        column = plain_role(columns, role)
        return None if column is None else tuple(row[column.index] for row in cells.rows)

    stamps = words("time") or ()
    timed = seconds_of(stamps)
    if timed is None:
        raise InputError(f"{path}: the column {time.header} holds no times ({some(stamps)})")
    alpha = words("alpha")
    return Moments(
        seconds=timed[0],
        clock=timed[1],
        stamps=stamps,
        pose_id=words("pose_id"),
        image=words("image"),
        alpha=None if alpha is None else tuple(number_word(w.replace(",", "."), f"{path}: alpha") for w in alpha),
    )


def _image_times(folder: Path) -> Moments:
    from tomopose.io.images.formats.tiff import date_time
    from tomopose.io.images.opening import find_files

    files = find_files(folder)
    stamps = [date_time(f) for f in files]
    without = [f.name for f, s in zip(files, stamps, strict=True) if s is None]
    if without:
        raise InputError(
            f"{folder}: {len(without)} images carry no time (TIFF DateTime), the first is {without[0]}; give a table "
            "with the columns image and time instead"
        )
    known = tuple(s for s in stamps if s is not None)
    timed = seconds_of(known)
    if timed is None:
        raise InputError(f"{folder}: the images' times cannot be read ({some(known)})")
    return Moments(
        seconds=timed[0],
        clock=timed[1],
        stamps=known,
        pose_id=None,
        image=tuple(f.name for f in files),
        alpha=None,
    )


def joined(log: PoseLog, moments: Moments, *, longest_gap_s: float = LONGEST_GAP_S, offset_s: float = 0.0) -> PoseLog:
    """The poses of a log at given moments.

    Parameters
    ----------
    log:           poses with their times.
    moments:       when poses are wanted.
    longest_gap_s: longest time between two rows of the log across which is interpolated.
    offset_s:      added to the moments' times: how far the log's clock is ahead.

    Raises
    ------
    InputError where the log has no clock, the clocks are of different kinds, a moment lies outside the log, or the log
    has a gap there; the first moment is named.
    """
    t, where = _clock_of(log)
    at = moments.seconds + offset_s
    kinds = {ABSOLUTE: "date", "time of day": "day"}
    if kinds.get(log.clock, "count") != kinds.get(moments.clock, "count"):
        raise InputError(
            f"{log.path}: its clock is {log.clock}, that of the moments is {moments.clock}; give both on one clock"
        )
    outside = np.flatnonzero((at < t[0] - STANDSTILL_S) | (at > t[-1] + STANDSTILL_S))
    if outside.size:
        k = int(outside[0])
        raise InputError(
            f"{log.path}: {_name(moments, k)} (time {moments.stamps[k]}) lies outside the log, by "
            f"{max(t[0] - at[k], at[k] - t[-1]):.3g} s ({outside.size} of {len(at)}); do the clocks differ? "
            "--clock-offset-s shifts them"
        )
    right = np.clip(np.searchsorted(t, at, side="left"), 1, len(t) - 1)
    left = right - 1
    exact = np.isclose(t[right], at, rtol=0, atol=STANDSTILL_S) | np.isclose(t[left], at, rtol=0, atol=STANDSTILL_S)
    gap = t[right] - t[left]
    wide = np.flatnonzero((gap > longest_gap_s) & ~exact)
    if wide.size:
        k = int(wide[0])
        raise InputError(
            f"{log.path}: no row of the log lies near {_name(moments, k)} (time {moments.stamps[k]}): the gap there is "
            f"{gap[k]:.3g} s long, {longest_gap_s:g} s are allowed ({wide.size} of {len(at)}); --longest-gap-s allows "
            "more"
        )
    share = np.clip((at - t[left]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
    rows = _at(log, where, left, right, share)
    speed = _largest_step(log, where, left, right, exact)
    notes = (
        f"{len(at)} poses were joined by time ({log.clock}); between rows of the log positions are interpolated "
        f"linearly, rotations along the shortest turn; the plate moves by up to {speed:.3g} mm between the two rows "
        "used",
    )
    return replace(
        log,
        rows=rows,
        set_rows=None,
        joints=None,
        pose_id=moments.pose_id,
        image=moments.image,
        alpha=moments.alpha,
        ball_id=None,
        times=moments.stamps if moments.clock == ABSOLUTE else None,
        seconds=at,
        clock=moments.clock,
        lines=None,
        notes=(*log.notes, *notes),
    )


def _name(moments: Moments, k: int) -> str:
    if moments.image is not None:
        return f"image {moments.image[k]}"
    return f"pose {moments.pose_id[k]}" if moments.pose_id is not None else f"row {k + 1}"


def _clock_of(log: PoseLog) -> tuple[Array, Indices]:
    """Rising times of the log and the rows that they belong to."""
    if log.seconds is None or len(log.seconds) < 2 or not log.rows:
        raise InputError(f"{log.path} has no clock (no time stamp or time column): it cannot be joined by time")
    back = np.flatnonzero(np.diff(log.seconds) < 0)
    if back.size:
        raise InputError(f"{log.path}: the clock runs backwards after row {back[0] + 1}; split the log there")
    rows = np.concatenate([[True], np.diff(log.seconds) > 0])
    kept = np.flatnonzero(rows)
    if len(kept) < 2:
        raise InputError(f"{log.path}: all rows carry one time ({log.seconds[0]:g}); it cannot be joined by time")
    return log.seconds[kept], kept


def _at(log: PoseLog, where: Indices, left: Indices, right: Indices, share: Array) -> tuple[tuple[str, ...], ...]:
    """Rows at a share of the way from one row to the next; rows of the log itself keep their digits."""
    T = log.poses(units_confirmed=True).T_MH[where]
    x = T.t[left] + share[:, None] * (T.t[right] - T.t[left])
    turn = log_rotation(np.swapaxes(T.R[left], -1, -2) @ T.R[right])
    a = convention_from_rotation(T.R[left] @ exp_rotation(share[:, None] * turn), log.convention)
    words = np.hstack([x, a]).tolist()
    out = []
    for k, row in enumerate(words):
        if share[k] in (0.0, 1.0):
            out.append(log.rows[int(where[left[k] if share[k] == 0 else right[k]])])
        else:
            out.append(tuple(repr(v) for v in row))
    return tuple(out)


def _largest_step(log: PoseLog, where: Indices, left: Indices, right: Indices, exact: npt.NDArray[np.bool_]) -> float:
    t = log.poses(units_confirmed=True).T_MH.t[where]
    steps = np.linalg.norm(t[right] - t[left], axis=1)
    return float(np.where(exact, 0.0, steps).max(initial=0.0))
