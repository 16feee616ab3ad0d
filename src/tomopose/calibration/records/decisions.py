"""Decisions of a person about detections, as lines of review.jsonl, and the observations that follow from them.

A line is one decision: about which pose, what was decided, who, when, why.  The lines are the only truth: a review is
replayed from them and from the detections alone, without images, to the same bytes.  To undo is to drop a line.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.files import plain, write_text
from tomopose.observations import OPTIONAL_COLUMNS, BallObservations
from tomopose.reading import read_text
from tomopose.units import Array, float_array

SCHEMA = "tomopose/review/1"
Action = Literal["accept", "leave-out", "measure-again"]
ACTIONS: tuple[Action, ...] = get_args(Action)
SAME_PX = 1e-3
"""A replay meets the detection that was judged: rounding on another processor moves a centre by less, another detection
of the same image by its noise, which is more."""
KEYS = ("schema", "pose_id", "action", "who", "when", "why", "judged_px", "start_px", "measured")
MEASURED_KEYS = ("x_px", "covariance_px2", "status", "x_ellipse_px", *OPTIONAL_COLUMNS)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What a second detection from a given start found.

    x: (2,) px;  covariance: (2, 2) px^2;  status: as of observations;  the rest as in BallObservations, NaN: unknown.
    """

    x: Array
    covariance: Array
    status: str = "ok"
    x_ellipse: Array | None = None
    snr: float = math.nan
    semi_major: float = math.nan
    semi_minor: float = math.nan
    angle: float = math.nan

    def __post_init__(self) -> None:
        x, covariance = float_array(self.x), float_array(self.covariance)
        if (
            x.shape != (2,)
            or covariance.shape != (2, 2)
            or not (np.isfinite(x).all() and np.isfinite(covariance).all())
        ):
            raise InputError("a measured centre needs two numbers and a covariance of two by two, all finite")
        if not (covariance[0, 0] > 0 and np.linalg.det(covariance) > 0 and covariance[0, 1] == covariance[1, 0]):
            raise InputError("the covariance of a measured centre is not symmetric and positive definite")
        object.__setattr__(self, "x", x)
        object.__setattr__(self, "covariance", covariance)


@dataclass(frozen=True, kw_only=True)
class Decision:
    """One decision.

    pose_id: of the detection;  who: a name;  when: ISO 8601 in UTC;  why: words, may be empty.
    judged:  (u, v) of the detection that was judged, px; None where nothing was measured.
    start:   (u, v) from which the image was measured again, and what that found: with "measure-again" alone.
    """

    pose_id: str
    action: Action
    who: str
    when: str
    why: str = ""
    judged: tuple[float, float] | None = None
    start: tuple[float, float] | None = None
    measured: Measured | None = None

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise InputError(
                f"decision about pose {self.pose_id!r}: {self.action!r} is not one of {', '.join(ACTIONS)}"
            )
        if (self.action == "measure-again") != (self.measured is not None):
            raise InputError(
                f"decision about pose {self.pose_id!r}: 'measure-again', and it alone, has a new measurement"
            )
        if not self.who.strip():
            raise InputError(f"decision about pose {self.pose_id!r}: nobody is named who decided")
        try:
            moment = datetime.fromisoformat(self.when)
        except ValueError:
            moment = None
        if moment is None or moment.tzinfo is None:
            raise InputError(
                f"decision about pose {self.pose_id!r}: {self.when!r} is not a time with its zone (ISO 8601)"
            )

    @property
    def words(self) -> str:
        """What was decided, for people."""
        done = {"accept": "accepted", "leave-out": "left out", "measure-again": "measured again"}[self.action]
        return f"{done} by {self.who}" + (f": {self.why}" if self.why else "")


def to_line(decision: Decision) -> str:
    """A decision as one line of JSON, floats with all their digits."""
    m = decision.measured
    measured = None if m is None else {
        "x_px": m.x, "covariance_px2": m.covariance, "status": m.status, "x_ellipse_px": m.x_ellipse,
        **{name: getattr(m, name) for name in OPTIONAL_COLUMNS},
    }  # fmt: skip
    content = {
        "schema": SCHEMA, "pose_id": decision.pose_id, "action": decision.action, "who": decision.who,
        "when": decision.when, "why": decision.why, "judged_px": decision.judged,
        **({"start_px": decision.start, "measured": measured} if m is not None else {}),
    }  # fmt: skip
    return json.dumps(plain(content), ensure_ascii=False, allow_nan=False)


def from_line(text: str, where: str) -> Decision:
    """A decision from its line.  FileError, InputError or SchemaVersionError, each with the place, where it is none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileError(f"{where}: not a line of JSON ({error})") from error
    if not isinstance(found, dict):
        raise FileError(f"{where}: not a JSON object")
    if found.get("schema") != SCHEMA:
        raise SchemaVersionError(f'{where}: schema is {found.get("schema")!r}; "{SCHEMA}" is needed')
    unknown = sorted(set(found) - set(KEYS))
    if unknown:
        raise InputError(f"{where}: unknown key {unknown[0]!r}; known are {', '.join(KEYS)}")
    try:
        return Decision(
            **{k: _text(found, k) for k in ("pose_id", "who", "when")},
            action=cast("Action", found.get("action")),
            why=_text({"why": "", **found}, "why"),
            judged=_pair(found.get("judged_px"), "judged_px"),
            start=_pair(found.get("start_px"), "start_px"),
            measured=_measured(found.get("measured")),
        )
    except (InputError, TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error


def _text(found: Mapping[str, object], key: str) -> str:
    value = found.get(key)
    if not isinstance(value, str):
        raise InputError(f"{key} is {value!r}; text is needed")
    return value


def _pair(value: object, key: str) -> tuple[float, float] | None:
    if value is None:
        return None
    pair = np.asarray(value, dtype=np.float64)
    if pair.shape != (2,) or not np.isfinite(pair).all():
        raise InputError(f"{key} is {value!r}; two numbers, px, are needed")
    return float(pair[0]), float(pair[1])


def _measured(value: object) -> Measured | None:
    if value is None:
        return None
    if not isinstance(value, dict) or set(value) - set(MEASURED_KEYS):
        raise InputError(f"measured is not an object of {', '.join(MEASURED_KEYS)}")
    numbers = {k: math.nan if value.get(k) is None else float(value[k]) for k in OPTIONAL_COLUMNS}
    ellipse = value.get("x_ellipse_px")
    return Measured(
        x=np.asarray(value.get("x_px"), dtype=np.float64),
        covariance=np.asarray(value.get("covariance_px2"), dtype=np.float64),
        status=_text(value, "status"),
        x_ellipse=None if ellipse is None else np.asarray(ellipse, dtype=np.float64),
        **numbers,
    )


def read_decisions(path: str | Path) -> tuple[Decision, ...]:
    """The decisions of review.jsonl, oldest first.  FileError where it cannot be read; InputError names a bad line."""
    path = Path(path)
    lines = read_text(path).split("\n")
    return tuple(from_line(line, f"{path}: line {k}") for k, line in enumerate(lines, 1) if line.strip())


def write_decisions(path: str | Path, decisions: Sequence[Decision]) -> None:
    """Write review.jsonl anew, atomically."""
    write_text(path, "".join(to_line(d) + "\n" for d in decisions))


def append_decision(path: str | Path, decision: Decision) -> None:
    """Add one line to review.jsonl: all of it, on the disk, or none of it."""
    line = (to_line(decision) + "\n").encode()
    file = os.open(path, os.O_WRONLY | os.O_APPEND)
    try:
        before = os.fstat(file).st_size
        try:
            if os.write(file, line) != len(line):
                raise OSError(errno.ENOSPC, "the line does not fit")
            os.fsync(file)
        except OSError as error:
            os.truncate(path, before)
            raise FileError(f"{path}: the decision cannot be written: {error}") from error
    finally:
        os.close(file)


def decided(observations: BallObservations, decisions: Sequence[Decision]) -> BallObservations:
    """The observations after the decisions, which are taken in their order; without any, the same observations.

    "leave-out": not seen, with who and why as status.  "accept": seen where it is measured, its status says by whom.
    "measure-again": the new measurement in place of the old.  Each is about what was detected, never about what an
    earlier decision made of it, so that the last decision about a pose counts.

    Raises InputError where a decision is about a pose that is not there, or about another detection of it.
    """
    if not decisions:
        return observations
    last = {d.pose_id: d for d in decisions}
    where = {p: k for k, p in enumerate(observations.pose_id)}
    x, covariance, seen = (np.array(a) for a in (observations.x_D, observations.covariance, observations.seen))
    status = list(observations.status or ())
    columns: dict[str, Any] = {
        name: np.array(c) for name in OPTIONAL_COLUMNS if (c := getattr(observations, name)) is not None
    }
    ellipse = None if observations.x_ellipse is None else np.array(observations.x_ellipse)
    usable = np.isfinite(x).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    for pose, decision in last.items():
        if pose not in where:
            raise InputError(f"the review decides about pose {pose!r}, which has no observation")
        k = where[pose]
        _require_same(decision, observations, k)
        if decision.action == "leave-out":
            seen[k] = False
            status[k] = decision.words
        elif decision.action == "accept":
            seen[k] = usable[k]
            status[k] = f"{status[k]}; {decision.words}" if seen[k] else status[k]
        elif decision.measured is not None:
            m = decision.measured
            x[k], covariance[k], seen[k] = m.x, m.covariance, True
            status[k] = f"{m.status}; {decision.words}"
            for name, column in columns.items():
                column[k] = getattr(m, name)
            if ellipse is not None:
                ellipse[k] = np.nan if m.x_ellipse is None else m.x_ellipse
    return replace(
        observations, x_D=x, covariance=covariance, seen=seen, status=tuple(status), x_ellipse=ellipse, **columns
    )


def _require_same(decision: Decision, observations: BallObservations, k: int) -> None:
    now, judged = observations.x_D[k], decision.judged
    measured = math.isfinite(now[0]) and math.isfinite(now[1])
    if measured != (judged is not None) or (
        judged is not None and max(abs(now[0] - judged[0]), abs(now[1] - judged[1])) > SAME_PX
    ):
        shown = "nothing was measured" if judged is None else f"u {judged[0]:.4f}, v {judged[1]:.4f} px"
        here = f"u {now[0]:.4f}, v {now[1]:.4f} px" if measured else "nothing is measured"
        raise InputError(
            f"the review's decision about pose {decision.pose_id!r} is about another detection ({shown}; here {here}): "
            "replay it on the detections that were reviewed, or review again"
        )
