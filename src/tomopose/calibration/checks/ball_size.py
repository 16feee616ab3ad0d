"""The ball as a gauge: does its silhouette have the size that the calibrated chain and its diameter give?

The magnification that a calibration finds comes from the manipulator's translations; a wrong scale of theirs moves the
centres as another mount would. The ball's diameter is a length of its own, and its silhouette shows the difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from tomopose.calibration.checks.rules import BallSize, Evidence, ball_size_rules, findings
from tomopose.calibration.checks.verdict import Finding
from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.silhouette import silhouette_ellipse
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array

WRONG = 0.02
"""Relative difference of size from which a value that was given must be wrong: two pixels at a radius of 100 px."""


class Placed(Protocol):
    """Where a calibration puts the balls."""

    @property
    def scanner(self) -> Scanner: ...
    @property
    def T_HT(self) -> RigidTransform: ...
    @property
    def balls(self) -> Mapping[int, Array]: ...
    @property
    def pose_id(self) -> tuple[str, ...]: ...
    @property
    def model(self) -> str: ...
    @property
    def arrangement(self) -> str: ...


def size_ratio(calibration: Placed, poses: PoseSequence, observations: BallObservations, ball_diameter: float) -> float:
    """Median over the poses used of the measured size of the silhouette over the calculated one; NaN without sizes.

    calibration: of one ball.  poses: those of its chain as commanded (inverse ones where the scanner moves).
    """
    if observations.semi_major is None or observations.semi_minor is None:
        return float("nan")
    chain = poses.select(poses.index_of(calibration.pose_id))
    scanner, row = calibration.scanner, {name: k for k, name in enumerate(observations.pose_id)}
    (ball,) = calibration.balls.values()
    T_MS = scanner.T_WS @ scanner.T_TW(np.asarray(chain.alpha)) @ calibration.T_HT @ chain.T_MH
    sizes = []
    for x_S, name in zip(T_MS.apply(ball), calibration.pose_id, strict=True):
        x = scanner.K @ x_S
        gamma = np.arcsin(ball_diameter / 2.0 / np.linalg.norm(x_S))
        _, major, minor, _ = silhouette_ellipse(scanner, x[:2] / x[2], gamma)
        k = row[name]
        sizes.append(observations.semi_major[k] * observations.semi_minor[k] / (major * minor))
    return float(np.sqrt(np.nanmedian(sizes)))


def ball_size_findings(
    calibration: Placed, poses: PoseSequence, observations: BallObservations, ball_diameter: float
) -> tuple[Finding, ...]:
    """What the silhouettes say, by the rules; arguments as of `size_ratio`.

    InputError where the size is off by more than 2 %.
    """
    size = BallSize(ratio=size_ratio(calibration, poses, observations, ball_diameter), diameter=ball_diameter)
    found = findings(
        Evidence.of_ball_size(size, model=calibration.model, arrangement=calibration.arrangement), ball_size_rules()
    )
    if abs(size.ratio - 1.0) > WRONG:
        raise InputError(size.words)
    return found
