"""What a scan's uncertainty is made of, and what would make it smaller: the sentence of the first screen.

The scan is one turn of the table with the plate tilted to and fro by 5 degrees, or, for a manipulator that turns the
object itself, its own calibration poses.  Points: the field of view's corners and centre.  Everything is what a volume
sees: a rigid motion of the whole object is taken out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.model.ball_projection import projection_blocks
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.unseen import PLATFORM_RAD
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array

TILT = np.radians(5.0)
VIEWS = 12
WORTH_NAMING = 0.5
"""Share of the variance from which an assumed value is named; a remedy is named where it halves the uncertainty."""


@dataclass(frozen=True, kw_only=True)
class ScanBudget:
    """px, root mean square over views, points and coordinates.

    total: with everything;  measured: if all that was assumed were exact;  shares: assumed name -> its part, largest
    first;  two_angles: the same poses, half of them at a second table angle; nan where that is no remedy.
    """

    total: float
    measured: float
    shares: tuple[tuple[str, float], ...] = ()
    two_angles: float = float("nan")


def reference_scan(poses: PoseSequence) -> PoseSequence:
    """The scan for which the first screen states an uncertainty."""
    R = poses.T_MH.R
    if np.linalg.norm(log_rotation(R[0].T @ R), axis=1).max() > PLATFORM_RAD:
        return poses.select(np.unique(np.linspace(0, len(poses) - 1, 2 * VIEWS).round().astype(int)))
    alpha = np.linspace(0.0, 2 * np.pi, VIEWS, endpoint=False)
    w = np.column_stack([TILT * np.sin(2 * alpha), TILT * np.cos(2 * alpha + 0.5), np.zeros(VIEWS)])
    T_MH = RigidTransform(
        R=exp_rotation(w), t=np.broadcast_to(poses.T_MH.t.mean(axis=0), (VIEWS, 3)), source=Frame.M, target=Frame.H
    )
    return PoseSequence(T_MH=T_MH, pose_id=tuple(str(k) for k in range(VIEWS)), alpha=alpha)


def shares_of(J: Array, covariance: Array, columns: dict[str, list[int]]) -> tuple[float, float, list[tuple[str, float]]]:
    """(total, measured, shares): J (k, c) px of the scan, covariance (c, c), columns of what was assumed, by name."""
    k = max(len(J), 1)

    def rms(C: Array) -> float:
        return float(np.sqrt(max(np.einsum("kc,cd,kd->", J, C, J, optimize=True) / k, 0.0)))

    def known(C: Array, which: list[int]) -> Array:
        """The covariance if those coordinates were exact."""
        S = C[np.ix_(which, which)]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
        G = C[:, which] * scale
        return np.asarray(C - G @ np.linalg.pinv(S * scale[:, None] * scale, rcond=1e-12) @ G.T)

    total = rms(covariance)
    everything = [j for which in columns.values() for j in which]
    measured = rms(known(covariance, everything)) if everything else total
    parts = [
        (name, float(np.sqrt(max(total**2 - rms(known(covariance, which)) ** 2, 0.0)))) for name, which in columns.items()
    ]
    return total, measured, sorted(parts, key=lambda p: -p[1])
