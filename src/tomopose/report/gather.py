"""What the figures of a calibration need, joined by pose id: residuals, poses, detection noise."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.result import Calibration
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.report.style import COMPOUND, NO_ROTATION
from tomopose.units import Array

SMALL_ROTATION = 0.02
"""Below this share of the largest rotation of the run a component counts as not rotated (encoders never read 0)."""


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
