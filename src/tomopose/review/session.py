"""A review as a value: the detections, the decisions about them, and the calibration that follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property

import numpy as np

from tomopose.calibration.records.decisions import Action, Decision, Measured, decided
from tomopose.calibration.result import Calibration
from tomopose.detection import detect
from tomopose.errors import DetectionError, InputError
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.io.images import ImageSequence
from tomopose.manipulator.error_models import TwinErrors, corrected_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array

Solve = Callable[[BallObservations], Calibration]


@dataclass(frozen=True, kw_only=True)
class Review:
    """What was detected, what was decided, and what follows.

    detected:     the observations before any decision;  poses: of the same run.
    decisions:    oldest first;  calibration: of the observations after them.
    solve:        the calibration of observations, by the options of the run under review.
    """

    detected: BallObservations
    poses: PoseSequence
    decisions: tuple[Decision, ...]
    calibration: Calibration
    solve: Solve

    @cached_property
    def observations(self) -> BallObservations:
        """After the decisions."""
        return decided(self.detected, self.decisions)

    def with_decision(self, decision: Decision) -> Review:
        """The review with one decision more, solved again."""
        return self._after((*self.decisions, decision))

    def without_last(self) -> Review:
        """The review without its last decision, solved again.  InputError where there is none."""
        if not self.decisions:
            raise InputError("there is no decision to undo")
        return self._after(self.decisions[:-1])

    def _after(self, decisions: tuple[Decision, ...]) -> Review:
        """After other decisions; solved again where they change what the fit takes."""
        before, after = self.observations, decided(self.detected, decisions)
        calibration = self.calibration if _same_to_a_fit(before, after) else self.solve(after)
        return replace(self, decisions=decisions, calibration=calibration)


def _same_to_a_fit(a: BallObservations, b: BallObservations) -> bool:
    """Whether two tables of one run give one calibration: the words of rows that are used play no part."""
    unseen = [[s for s, seen in zip(o.status or (), o.seen, strict=False) if not seen] for o in (a, b)]
    columns = ("x_D", "covariance", "seen", "semi_major", "semi_minor", "x_ellipse")
    pairs = [(getattr(a, c), getattr(b, c)) for c in columns]
    return unseen[0] == unseen[1] and all(
        (x is None and y is None) or np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs
    )


def begin(detected: BallObservations, poses: PoseSequence, decisions: Sequence[Decision], solve: Solve) -> Review:
    """A review of these detections after these decisions."""
    calibration = solve(decided(detected, decisions))
    return Review(detected=detected, poses=poses, decisions=tuple(decisions), calibration=calibration, solve=solve)


def now() -> str:
    """The time of a decision, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def decision_about(
    review: Review,
    k: int,
    action: Action,
    *,
    who: str,
    why: str = "",
    start: tuple[float, float] | None = None,
    measured: Measured | None = None,
) -> Decision:
    """A decision about row k of the detections, made now."""
    x = review.detected.x_D[k]
    return Decision(
        pose_id=review.detected.pose_id[k],
        action=action,
        who=who,
        when=now(),
        why=why,
        judged=(float(x[0]), float(x[1])) if np.isfinite(x).all() else None,
        start=start,
        measured=measured,
    )


def measured_again(
    images: ImageSequence, k: int, scanner: Scanner, *, ball_diameter: float, start: tuple[float, float]
) -> Measured:
    """The ball of image k, searched from a start (u, v), px.  DetectionError, with the reason, where none is found."""
    found = detect(images.select([k]), scanner, ball_diameter=ball_diameter, predicted=[start], pose_id=["again"])
    status = "" if found.status is None else found.status[0]
    if not found.seen[0]:
        raise DetectionError(f"measured again from u {start[0]:.1f}, v {start[1]:.1f}: {status}")

    def of(column: Array | None) -> float:
        return float("nan") if column is None else float(column[0])

    return Measured(
        x=found.x_D[0],
        covariance=found.covariance[0],
        status=status,
        x_ellipse=None if found.x_ellipse is None else found.x_ellipse[0],
        snr=of(found.snr),
        semi_major=of(found.semi_major),
        semi_minor=of(found.semi_minor),
        angle=of(found.angle),
    )


def predicted_centres(calibration: Calibration, poses: PoseSequence) -> Array:
    """(n, 2) px: where the calibration expects each pose's ball; NaN where it cannot say.

    Where the scanner moves, only the poses that were used have one: observed minus residual.
    """
    if calibration.inverse or isinstance(calibration.errors, TwinErrors) or poses.alpha is None:
        out = np.full((len(poses), 2), np.nan)
        there = [k for k, p in enumerate(calibration.pose_id) if p in set(poses.pose_id)]
        ids = [calibration.pose_id[k] for k in there]
        out[poses.index_of(ids)] = (calibration.x_D - calibration.residuals)[there]
        return out
    moved = corrected_poses(calibration.errors, poses)
    t = np.array([calibration.balls.get(int(b), calibration.t) for b in poses.ball_id])
    return project_ball(calibration.scanner, T_HT=calibration.T_HT, T_MH=moved.T_MH, t=t, alpha=poses.alpha)
