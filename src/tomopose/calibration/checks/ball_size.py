"""The ball as a gauge: does its silhouette have the size that the calibrated chain and its diameter give?

The magnification that a calibration finds comes from the manipulator's translations; a wrong scale of theirs moves the
centres as another mount would. The ball's diameter is a length of its own, and its silhouette shows the difference.
"""

from __future__ import annotations

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.geometry.silhouette import silhouette_ellipse
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

NOTED, WRONG = 0.005, 0.02
"""Relative differences of size from which one is told, and from which a value must be wrong."""


def size_ratio(
    calibration: Calibration, poses: PoseSequence, observations: BallObservations, ball_diameter: float
) -> float:
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


def require_ball_size(ratio: float, ball_diameter: float) -> str | None:
    """A sentence where the size is off by more than 0.5 %, else None.  InputError where it is off by more than 2 %."""
    if not abs(ratio - 1.0) > NOTED:
        return None
    words = (
        f"the ball's silhouettes are {100 * abs(ratio - 1.0):.1f} % {'larger' if ratio > 1 else 'smaller'} than a ball "
        f"of {ball_diameter:g} mm would throw from where the calibration places it; the diameter (--ball-diameter-mm), "
        "the scale of the poses' translations or a value in scanner.json is wrong"
    )
    if abs(ratio - 1.0) > WRONG:
        raise InputError(words)
    return words
