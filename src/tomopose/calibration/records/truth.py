"""Eq. (9): detections held against the truth, where a simulation knows it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array
from tomopose.values import require_types

Centres = ArrayLike | Mapping[int, ArrayLike]


def d_exact(
    scanner: Scanner, poses: PoseSequence, observations: BallObservations, *, T_HT: RigidTransform, t: Centres
) -> Array:
    """d_k (m,), px, of the m observations that count as seen: their distance from the exact centres.  Eq. (9).

    T_HT, t: the exact values; t (3,) in mm, or a mapping ball_id -> (3,).
    Raises InputError for observations of unknown poses, or a ball without an exact centre.
    """
    used = observations.used
    rows = poses.select(poses.index_of(used.pose_id))
    if isinstance(t, Mapping):
        missing = sorted({int(b) for b in rows.ball_id} - {int(b) for b in t})
        if missing:
            raise InputError(f"no exact centre is given for ball {missing[0]}")
        t = np.array([t[int(b)] for b in rows.ball_id])
    exact = project_ball(scanner, T_HT=T_HT, T_MH=rows.T_MH, t=t, alpha=rows.alpha)
    result: Array = np.linalg.norm(used.x_D - exact, axis=1)
    return result


@require_types
def d_rms_exact(
    scanner: Scanner, poses: PoseSequence, observations: BallObservations, *, T_HT: RigidTransform, t: Centres
) -> float:
    """Error of the detection itself, px, rms over the seen poses.  Eq. (9)."""
    d = d_exact(scanner, poses, observations, T_HT=T_HT, t=t)
    if d.size == 0:
        raise InputError("no observation counts as seen")
    return float(np.sqrt(np.mean(d**2)))
