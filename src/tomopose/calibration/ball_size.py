"""The ball as a gauge: does its silhouette have the size that the calibrated chain and its diameter give?

The magnification that a calibration finds comes from the manipulator's translations; a wrong scale of theirs moves the
centres as another mount would. The ball's diameter is a length of its own, and its silhouette shows the difference.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array

NOTED, WRONG = 0.005, 0.02
"""Relative differences of size from which one is told, and from which a value must be wrong."""


def silhouette_size(scanner: Scanner, x_S: Any, radius: float) -> Array:
    """sqrt(a b), (n,) mm: semi-axes of the ellipse that a ball at x_S (n, 3) mm in S throws on the panel.

    A cone of half-angle gamma whose axis leans by theta against the panel's normal cuts the plane at distance D in
    a = D sin gamma cos gamma / (cos^2 theta - sin^2 gamma), b = D sin gamma / sqrt(cos^2 theta - sin^2 gamma).
    Panel tilts of some degrees change the product by their square and are left out.
    """
    x_S = np.asarray(x_S, dtype=np.float64)
    distance = np.linalg.norm(x_S, axis=-1)
    sin2 = (radius / distance) ** 2
    left = (x_S[..., 2] / distance) ** 2 - sin2
    ab = scanner.d_SD**2 * sin2 * np.sqrt(1.0 - sin2) / left**1.5
    return np.asarray(np.sqrt(ab), dtype=np.float64)


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
    a, b = (np.asarray(axis)[[row[name] for name in calibration.pose_id]]
            for axis in (observations.semi_major, observations.semi_minor))
    measured = np.sqrt(scanner.p_u * scanner.p_v * a * b)
    return float(np.nanmedian(measured / silhouette_size(scanner, T_MS.apply(ball), ball_diameter / 2.0)))


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
