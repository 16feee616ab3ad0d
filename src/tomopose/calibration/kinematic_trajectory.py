"""How far a scan's projections are off, once the pose of the object, which no measurement depends on, is removed.

The figure of merit of a trajectory: project points of the object with the estimated and with the true chain, let the
object take the rigid pose that explains most of the difference, and take the rms of what remains.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.geometry.projection import project
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.units import Array

POSE_STEPS = 12


def object_points(half: tuple[float, float, float] = (15.0, 15.0, 30.0)) -> Array:
    """The corners (8, 3) of a box about the origin, mm."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij")).reshape(3, -1).T
    return signs * np.asarray(half, dtype=np.float64)


def point_jacobian(P: Array, x: Array) -> Array:
    """d(u, v)/dx (n, m, 2, 3) of points x (m, 3) under matrices P (n, 3, 4)."""
    h = np.einsum("nij,mj->nmi", P[:, :, :3], x) + P[:, None, :, 3]
    w = h[..., 2:]
    return (P[:, None, :2, :3] - (h[..., :2] / w)[..., None] * P[:, None, 2:, :3]) / w[..., None]


def without_object_pose(P: Any, P_true: Any, points: Any) -> Array:
    """Differences (n, m, 2), px, of the points' pixels under P and P_true, the best rigid object pose removed.

    The pose is the one that minimises their sum of squares, found by Gauss-Newton.
    """
    P, P_true, x = np.asarray(P), np.asarray(P_true), np.asarray(points, dtype=np.float64)
    target = project(P_true, x)
    R, t = np.eye(3), np.zeros(3)
    for _ in range(POSE_STEPS):
        y = x @ R.T + t
        d = project(P, y) - target
        G = point_jacobian(P, y)
        J = np.concatenate([-G @ skew(y - t), G], axis=3).reshape(-1, 6)
        step = np.linalg.lstsq(J, -d.ravel(), rcond=None)[0]
        R, t = exp_rotation(step[:3]) @ R, t + step[3:]
        if np.abs(step).max() < 1e-12:
            break
    return project(P, x @ R.T + t) - target


def rms_px(d: Array) -> float:
    """Root mean square distance, px, of differences (..., 2)."""
    return float(np.sqrt(np.mean(np.sum(d**2, axis=-1))))
