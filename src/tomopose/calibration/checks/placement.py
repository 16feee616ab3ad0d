"""Where a fit places the balls between focal spot and panel, and whether a ball can be there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.model.problem import Problem
from tomopose.calibration.rigid.estimate import LIKELY
from tomopose.errors import InputError

OUTSIDE = 1.0
"""Of the panel's larger side.  A simulated or predicted table may reach beyond the panel and is right all the same;
other units, another binning or another scanner put centres farther away than a whole panel."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Distances of the balls from the focal spot along the beam, mm: nearest, median, farthest.

    d_SD, d_SR: of the scanner, mm.
    """

    nearest: float
    median: float
    farthest: float
    d_SD: float
    d_SR: float

    @property
    def possible(self) -> bool:
        """Between focal spot and panel in every pose."""
        return self.nearest > 0.0 and self.farthest < self.d_SD

    @property
    def off_axis(self) -> float:
        """|ln| of the median distance over d_SR; inf where the ball cannot be there at all."""
        return float(abs(np.log(self.median / self.d_SR))) if self.median > 0 else float("inf")

    @property
    def likely(self) -> bool:
        return self.possible and self.off_axis < np.log(LIKELY)


def require_on_panel(problem: Problem) -> None:
    """InputError for a centre that is farther outside the panel than a ball that is partly seen can be."""
    for r, scanner in enumerate(problem.scanners):
        size = np.array([scanner.n_u, scanner.n_v], dtype=np.float64)
        x = problem.x_D
        outside = np.maximum(-x, x - (size - 1.0)).max(axis=1)
        off = np.flatnonzero((problem.run == r) & (outside > OUTSIDE * size.max()))
        if off.size:
            k = int(off[0])
            raise InputError(
                f"{off.size} of {len(problem)} centres are not on the panel: that of pose {problem.pose_id[k]!r} is "
                f"({x[k, 0]:.6g}, {x[k, 1]:.6g}) px, the panel has {scanner.n_u} x {scanner.n_v} pixels; check n_u_px, "
                "n_v_px and binning in scanner.json, and that u_px and v_px are pixels"
            )


def better_placed(other: Placement, declared: Placement) -> bool:
    """Whether `other` has the ball near the rotation axis where `declared` has it far from there."""
    return other.possible and not declared.likely and other.off_axis < declared.off_axis
