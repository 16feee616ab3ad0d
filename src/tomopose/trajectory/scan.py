"""Pose sequences of scans: what manipulator and table are commanded while the radiographs are taken."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.trajectory.tilt import R_HT_MOUNTED, eq10_rotation
from tomopose.units import Array
from tomopose.values import require_types

Wave = Callable[[Array], Array]


def table_angles(n: int, *, turn: float = 2 * math.pi, start: float = 0.0, direction: Literal[1, -1] = 1) -> Array:
    """alpha_j (n,), rad: start + direction (j - 1) turn / n for j = 1 .. n; the last view is one step before the end.

    Paper sec. 3: alpha_j = (j - 1) 2 pi / n.
    """
    if int(n) != n or n < 1:
        raise InputError(f"a scan has {n!r} views; a whole number from 1 is needed")
    if direction not in (1, -1):
        raise InputError(f"direction is {direction!r}; 1 (mathematically positive about z_W) or -1 is needed")
    return np.float64(start) + direction * np.arange(int(n)) * (turn / n)


def scan(
    alpha: Array, R_MH: Array | None = None, t_MH: Array | None = None, *, pivot: Array | None = None
) -> PoseSequence:
    """Any scan: table angles (n,), rad, with rotations (n, 3, 3) and positions (n, 3), mm, of the manipulator.

    A rotation or position that is left out is that of the zero pose.  Set poses; ids count from 0.
    """
    alpha = np.atleast_1d(np.asarray(alpha, dtype=np.float64))
    n = len(alpha)
    R = np.broadcast_to(np.eye(3) if R_MH is None else np.asarray(R_MH, dtype=np.float64), (n, 3, 3))
    t = np.broadcast_to(np.zeros(3) if t_MH is None else np.asarray(t_MH, dtype=np.float64), (n, 3))
    return PoseSequence(
        T_MH=RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H),
        pose_id=tuple(str(j) for j in range(n)),
        alpha=alpha,
        pivot=pivot,
        source="set",
    )


@require_types
def circular_scan(n: int, *, direction: Literal[1, -1] = 1) -> PoseSequence:
    """One turn of the table with the manipulator at zero: the reference scan of paper sec. 6.1."""
    return scan(table_angles(n, direction=direction))


@require_types
def tilted_scan(
    n: int,
    tilt: Wave,
    *,
    R_HT: Array = R_HT_MOUNTED,
    turn: float = 2 * math.pi,
    direction: Literal[1, -1] = 1,
    pivot: Array | None = None,
) -> PoseSequence:
    """A turn of the table while the object is tilted about y_W by tilt(alpha), rad.  Eq. (10).

    tilt: any function of the table angles (n,): `eq11_triangle` (eq. 11), `sine_tilt`, or your own.
    R_HT: from a calibration (`cal.T_HT.R`), or the paper's R_z(pi).
    The positions stay at zero, as in the paper.
    """
    alpha = table_angles(n, turn=turn, direction=direction)
    phi_tilt = np.asarray(tilt(alpha), dtype=np.float64)
    if phi_tilt.shape != alpha.shape:
        raise ShapeError(f"the tilt function gave shape {phi_tilt.shape} for {n} table angles; one tilt each is needed")
    if not np.isfinite(phi_tilt).all():
        k = int(np.flatnonzero(~np.isfinite(phi_tilt))[0])
        raise InputError(f"the tilt at table angle {alpha[k]:g} rad (view {k}) is not finite")
    return scan(alpha, eq10_rotation(alpha, phi_tilt, R_HT), pivot=pivot)
