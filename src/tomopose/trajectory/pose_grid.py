"""Calibration poses on a grid of positions: the paper's (sec. 5, fig. 5), and ours, which shows what that cannot."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import rotation_from_angles
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array
from tomopose.values import require_types

HALF_RANGE_MM = 10.0
TILT = math.radians(5.0)


def seven_orientations(tilt: float | Sequence[float] = TILT) -> Array:
    """Angles (7, 3), rad: none, then +tilt and -tilt about x, about y, about z.  Paper sec. 5."""
    by_axis = np.broadcast_to(np.asarray(tilt, dtype=np.float64), (3,))
    angles = np.zeros((7, 3))
    for axis in range(3):
        angles[1 + 2 * axis, axis], angles[2 + 2 * axis, axis] = by_axis[axis], -by_axis[axis]
    return angles


def compound_orientations(tilt: float | Sequence[float] = TILT) -> Array:
    """Angles (7, 3), rad: none, then six turns about all three axes together, no two in the same sense.

    Turns about one axis at a time leave the order of the three rotations unknown; these show it.
    """
    by_axis = np.broadcast_to(np.asarray(tilt, dtype=np.float64), (3,))
    senses = [(0, 0, 0), (1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1), (-1, -1, -1), (1, 1, -1)]
    return np.array(senses, dtype=np.float64) * by_axis


def grid_positions(n: int | Sequence[int], half_range: float | Sequence[float] = HALF_RANGE_MM) -> Array:
    """Positions (n_x n_y n_z, 3), mm, evenly spaced from -half_range to +half_range; x runs slowest, z fastest.

    An axis with n = 1 stays at 0.
    """
    counts = np.broadcast_to(np.asarray(n), (3,))
    half = np.broadcast_to(np.asarray(half_range, dtype=np.float64), (3,))
    if (counts != np.round(counts)).any() or (counts < 1).any():
        raise InputError(f"the grid has {n!r} positions along its axes; whole numbers from 1 are needed")
    if not np.isfinite(half).all() or (half < 0).any():
        raise InputError(f"the grid reaches {half_range!r} mm; a range of 0 or more is needed")
    axes = [np.linspace(-h, h, int(k)) if k > 1 else np.zeros(1) for k, h in zip(counts, half, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@require_types
def pose_grid(
    n: int | Sequence[int] = 3,
    *,
    half_range: float | Sequence[float] = HALF_RANGE_MM,
    tilt: float | Sequence[float] = TILT,
    orientations: Array | None = None,
    table_angles: Sequence[float] = (0.0,),
    pivot: Array | None = None,
) -> PoseSequence:
    """n x n x n x 7 calibration poses.  Paper sec. 5, fig. 5: +-10 mm, +-5 deg; n = 3 gives 189 poses.

    Parameters
    ----------
    n, half_range:  positions along each axis (one number or three), and how far they reach, mm.
    tilt:           of the seven orientations, rad (one number or three).
    orientations:   angles (m, 3), rad, of R_x R_y R_z to take in place of the seven.
    table_angles:   rad; the whole grid is repeated at each.  The paper holds the table at 0; more angles are what makes
                    d_SR, u_0 and the detector's roll observable.
    pivot:          (3,) mm, to be kept with the poses.

    Returns
    -------
    PoseSequence of set poses: all orientations at a position, then the next position (z fastest), then the next table
    angle; ids count from 0.
    """
    angles = seven_orientations(tilt) if orientations is None else np.asarray(orientations, dtype=np.float64)
    if angles.ndim != 2 or angles.shape[1] != 3 or len(angles) == 0:
        raise InputError(f"orientations have shape {angles.shape}; angles (m, 3) in rad are needed")
    table = np.atleast_1d(np.asarray(table_angles, dtype=np.float64))
    positions = grid_positions(n, half_range)
    m, k, a = len(angles), len(positions), len(table)
    T_MH = RigidTransform(
        R=np.tile(rotation_from_angles(angles), (k * a, 1, 1)),
        t=np.tile(np.repeat(positions, m, axis=0), (a, 1)),
        source=Frame.M,
        target=Frame.H,
    )
    return PoseSequence(
        T_MH=T_MH,
        pose_id=tuple(str(i) for i in range(k * m * a)),
        alpha=np.repeat(table, k * m),
        pivot=pivot,
        source="set",
    )


def calibration_grid(
    n: int | Sequence[int] = 3,
    *,
    half_range: float | Sequence[float] = HALF_RANGE_MM,
    tilt: float | Sequence[float] = TILT,
    table_angles: Sequence[float] = (0.0, math.pi / 2),
    pivot: Array | None = None,
) -> PoseSequence:
    """n x n x n x 7 + 1 calibration poses that determine the scanner too: compound rotations, the table at two angles.

    Every position is taken at one of the table angles, in turn along the grid, so that there are as many images as in
    the paper's plan; all positions of one angle come before those of the next.  The first pose is taken again at the
    end: what has moved in between shows.  Parameters as of `pose_grid`.
    """
    table = np.atleast_1d(np.asarray(table_angles, dtype=np.float64))
    angles, positions = compound_orientations(tilt), grid_positions(n, half_range)
    turn = np.arange(len(positions)) % len(table)
    order = np.argsort(turn, kind="stable")
    k = np.append(np.repeat(order, len(angles)), order[0])
    j = np.append(np.tile(np.arange(len(angles)), len(order)), 0)
    T_MH = RigidTransform(R=rotation_from_angles(angles[j]), t=positions[k], source=Frame.M, target=Frame.H)
    return PoseSequence(
        T_MH=T_MH,
        pose_id=tuple(str(i) for i in range(len(k))),
        alpha=table[turn[k]],
        pivot=pivot,
        source="set",
    )
