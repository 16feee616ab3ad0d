"""The ball as a gauge: does its silhouette have the size that the calibrated chain and its diameter give?

The magnification that a calibration finds comes from the manipulator's translations; a wrong scale of theirs moves the
centres as another mount would.  With the table at one angle any scale fits: positions in centimetres leave the same
residuals as millimetres.  The ball's diameter is a length of its own, and its silhouette shows the difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from tomopose.calibration.checks.evidence.evidence import BallSize
from tomopose.calibration.model.problem import POSITION_UNITS, Problem, pair
from tomopose.calibration.model.silhouettes import chain_matrices, size_ratio_of
from tomopose.errors import InputError, UnitError
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array

WRONG = 0.02
"""Relative difference of size from which a value that was given must be wrong: two pixels at a radius of 100 px."""

UNIT_TOLERANCE = 0.05
"""A size that is off by the factor of a unit of length within this is off by that unit; the diameter may be wrong by a
few per cent besides.  The nearest factors, 10 and 25.4, are far apart."""


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


def measured_ball_size(problem: Problem, P: Array, centres: Array) -> BallSize | None:
    """The gauge of rows whose outline was measured; None without outlines or without the ball's diameter.

    P (n, 3, 4): from the balls' frame to pixels;  centres (n, 3): of the ball of each row.
    """
    diameter = problem.ball_diameter
    own = size_ratio_of(problem, P, centres)
    if diameter is None or own is None:
        return None

    def ratio(factor: float) -> float:
        # a scene in another unit throws the silhouettes of a ball that is smaller by this factor
        return size_ratio_of(problem, P, centres, diameter / factor) or np.nan

    agreeing = (u for u in POSITION_UNITS if abs(ratio(u[2]) - 1.0) < UNIT_TOLERANCE)
    unit = None if abs(own - 1.0) <= WRONG else next(agreeing, None)
    return BallSize(ratio=own, diameter=diameter, unit=unit)


def size_ratio(calibration: Placed, poses: PoseSequence, observations: BallObservations, ball_diameter: float) -> float:
    """Median over the poses used of the measured size of the silhouette over the calculated one; NaN without sizes.

    poses: those of the calibration's chain as commanded (inverse ones where the scanner moves).
    """
    used = observations.select(np.isin(observations.pose_id, calibration.pose_id))
    problem = pair(calibration.scanner, poses, used.with_ball_diameter(ball_diameter))
    centres = np.array([calibration.balls[i] for i in problem.ball_ids])[problem.ball]
    size = measured_ball_size(problem, chain_matrices(problem, problem.scanners, calibration.T_HT), centres)
    return float("nan") if size is None else size.ratio


def require_ball_size(size: BallSize | None) -> None:
    """InputError where the size is off by more than 2 %; UnitError where it is off by the factor of a unit."""
    if size is None or abs(size.ratio - 1.0) <= WRONG:
        return
    if size.unit is not None:
        name, symbol, factor = size.unit
        raise UnitError(
            f"the positions look like {name} ({symbol}), not millimetres: with millimetres the ball's silhouettes are "
            f"{100 * size.ratio:.2g} % of those of a ball of {size.diameter:g} mm where the calibration places it, "
            f"with {name} they agree; multiply x_mm, y_mm and z_mm of the pose table by {factor:g}"
        )
    raise InputError(size.words)
