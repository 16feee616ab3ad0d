"""What the figures of a calibration need, joined by pose id: residuals, poses, detection noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from tomopose.calibration.result import Calibration
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.report.style import COMPOUND, NO_ROTATION
from tomopose.units import Array

SMALL_ROTATION = 0.02
"""Below this share of the largest rotation of the run a component counts as not rotated (encoders never read 0)."""

MOST_DRAWN, WORST_DRAWN, MOST_LISTED = 500, 100, 500
"""Rows that a page draws at most, how many of these are the worst, and rows that one of its tables lists: a page of
10 000 rows had 21 MB."""


@dataclass(frozen=True, kw_only=True)
class Joined:
    """One row per pose that the calibration used.

    number:   (n,) place in the pose table, from 1; in the calibration itself where no table is given.
    r, d:     residuals (n, 2) and their lengths (n,), px.
    z:        (n, 2) residuals divided by the square root of the detection covariance, or by their own rms.
    predicted: whether z uses the detection's own uncertainty.
    poses:    the same rows of the pose table, or None;  group: n words, rotation axis and sign, or None.
    """

    pose_id: tuple[str, ...]
    number: Array
    x_D: Array
    r: Array
    d: Array
    z: Array
    predicted: bool
    poses: PoseSequence | None
    group: tuple[str, ...] | None

    @cached_property
    def drawn(self) -> Joined:
        """The rows that a page draws, in their order: all, or the worst and evenly many of the others over the run."""
        n = len(self.pose_id)
        if n <= MOST_DRAWN:
            return self
        worst_first = np.argsort(-self.d, kind="stable")
        others = np.sort(worst_first[WORST_DRAWN:])
        k = np.sort(np.concatenate([worst_first[:WORST_DRAWN], others[evenly(len(others), MOST_DRAWN - WORST_DRAWN)]]))
        return replace(
            self,
            pose_id=tuple(self.pose_id[i] for i in k),
            number=self.number[k],
            x_D=self.x_D[k],
            r=self.r[k],
            d=self.d[k],
            z=self.z[k],
            poses=None if self.poses is None else self.poses.select(k),
            group=None if self.group is None else tuple(self.group[i] for i in k),
        )

    @property
    def drawn_words(self) -> str:
        """Says which rows are drawn, after a figure's own words; "" where all are."""
        n, drawn = len(self.pose_id), len(self.drawn.pose_id)
        if drawn == n:
            return ""
        return (
            f" Drawn are {drawn} of {n} poses: the {WORST_DRAWN} with the largest residuals, and evenly many of the "
            "others over the run."
        )


def evenly(n: int, most: int) -> npt.NDArray[np.int64]:
    """Places of at most `most` of n things, evenly over them, the first and the last among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def listed_words(n: int, which: str, all_of_them: str) -> str:
    """Says which of n rows a table lists, after its own words, and where the others are; "" where it lists all."""
    return "" if n <= MOST_LISTED else f" Listed are {which} {MOST_LISTED} of {n}; {all_of_them} holds all."


def rotation_groups(poses: PoseSequence) -> tuple[str, ...]:
    """For each pose "none", "+x" ... "−z" where it turns about one axis of H only, else "compound"."""
    w = poses.rotation_vectors()
    largest = float(np.abs(w).max(initial=0.0))
    if largest == 0.0:
        return (NO_ROTATION,) * len(poses)
    turned = np.abs(w) > SMALL_ROTATION * largest
    words = []
    for row, axes in zip(w, turned, strict=True):
        if axes.sum() == 1:
            k = int(np.flatnonzero(axes)[0])
            words.append(("+" if row[k] > 0 else "−") + "xyz"[k])
        else:
            words.append(COMPOUND if axes.any() else NO_ROTATION)
    return tuple(words)


def join(calibration: Calibration, *, observations: BallObservations | None, poses: PoseSequence | None) -> Joined:
    """Join by pose id.  Poses or observations that lack a used pose count as not given."""
    ids = calibration.pose_id
    r = np.asarray(calibration.residuals)
    rows = None
    if poses is not None and set(ids) <= set(poses.pose_id):
        index = poses.index_of(ids)
        number, rows = index + 1.0, poses.select(index)
    else:
        number = np.arange(1.0, len(ids) + 1.0)
    z, predicted = _normalised(r, ids, observations)
    return Joined(
        pose_id=ids,
        number=number,
        x_D=np.asarray(calibration.x_D),
        r=r,
        d=calibration.d,
        z=z,
        predicted=predicted,
        poses=rows,
        group=None if rows is None else rotation_groups(rows),
    )


def _normalised(r: Array, ids: tuple[str, ...], observations: BallObservations | None) -> tuple[Array, bool]:
    if observations is not None and set(ids) <= set(observations.pose_id):
        where = {p: k for k, p in enumerate(observations.pose_id)}
        covariance = observations.covariance[[where[p] for p in ids]]
        if np.isfinite(covariance).all():
            return np.linalg.solve(np.linalg.cholesky(covariance), r[..., None])[..., 0], True
    rms = float(np.sqrt(np.mean(r**2))) if r.size else 1.0
    return r / (rms or 1.0), False


def minutes(time_utc: tuple[str, ...] | None) -> Array | None:
    """Minutes since the first pose, from ISO 8601 times; None where they are absent or cannot be read."""
    if time_utc is None:
        return None
    try:
        times = [datetime.fromisoformat(t.replace("Z", "+00:00")) for t in time_utc]
        return np.array([(t - times[0]).total_seconds() / 60.0 for t in times])
    except (ValueError, TypeError):
        return None


def finite_or_none(values: ArrayLike) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in np.asarray(values, dtype=np.float64)]
