"""Time stamps of logs: date and time, time of day, or seconds of some counter."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from tomopose.io.foreign.pose_log import ABSOLUTE
from tomopose.units import Array

STAMP = re.compile(
    r"^\s*\[?(?P<stamp>(?:\d{4}-\d{2}-\d{2}[ T]|\d{2}\.\d{2}\.\d{4} )?\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?)\]?[,;\s]+"
)
"""A time stamp at the beginning of a line."""
TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)")
GERMAN_DATE = re.compile(r"(\d{2})\.(\d{2})\.(\d{4})([ T].*)")
UNIX_SECONDS = (9e8, 5e9)
"""Seconds since 1970 of the years 1998 to 2128."""
UNIX_MILLISECONDS = (9e11, 5e12)
DAY = 86400.0
HALF_DAY = DAY / 2


def seconds_of(words: Sequence[str]) -> tuple[Array, str] | None:
    """The stamps as seconds (n,) and their clock in words; None where one of them is no time.

    Times of day that pass midnight keep counting.
    """
    for read in (_dates, _times_of_day, _counts):
        found = read(words)
        if found is not None:
            return found
    return None


def iso_words(words: Sequence[str]) -> tuple[str, ...] | None:
    """The stamps as ISO 8601 text, where they carry their date."""
    out = []
    for word in words:
        moment = _moment(word)
        if moment is None:
            return None
        out.append(moment.isoformat())
    return tuple(out)


def _moment(word: str) -> datetime | None:
    word = word.strip().replace(",", ".")
    if german := GERMAN_DATE.fullmatch(word):
        word = f"{german[3]}-{german[2]}-{german[1]}{german[4]}"
    if not re.match(r"\d{4}-?\d{2}-?\d{2}[ T]", word):
        return None
    try:
        return datetime.fromisoformat(word)
    except ValueError:
        return None


def _dates(words: Sequence[str]) -> tuple[Array, str] | None:
    moments = [_moment(w) for w in words]
    known = [m for m in moments if m is not None]
    if len(known) < len(moments) or not known:
        return None
    if len({m.tzinfo is None for m in known}) > 1:
        return None
    aware = [m if m.tzinfo is not None else m.replace(tzinfo=UTC) for m in known]
    return np.array([m.timestamp() for m in aware]), ABSOLUTE


def _times_of_day(words: Sequence[str]) -> tuple[Array, str] | None:
    found = [TIME_OF_DAY.fullmatch(w.strip()) for w in words]
    if not found or any(m is None for m in found):
        return None
    day = np.array([3600 * int(m[1]) + 60 * int(m[2]) + float(m[3].replace(",", ".")) for m in found if m])
    passed = np.concatenate([[0], np.cumsum(np.diff(day) < -HALF_DAY)])
    return day + DAY * passed, "time of day"


def _counts(words: Sequence[str]) -> tuple[Array, str] | None:
    try:
        values = np.array([float(w.replace(",", ".")) for w in words])
    except ValueError:
        return None
    if not len(values) or not np.isfinite(values).all():
        return None
    if ((values > UNIX_SECONDS[0]) & (values < UNIX_SECONDS[1])).all():
        return values, "seconds since 1970"
    if ((values > UNIX_MILLISECONDS[0]) & (values < UNIX_MILLISECONDS[1])).all():
        return values / 1000.0, "milliseconds since 1970"
    return values, "seconds of a counter"
