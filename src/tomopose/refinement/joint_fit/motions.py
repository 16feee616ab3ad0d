r"""Motions of the object, one per view, and the directions in which no image shows them.

A motion q = (t, w) of a view takes a point x of W to c + exp(w)(x - c) + t, c a fixed middle; it acts before the view's
matrix: P' = P T(q).  Motions are composed, never added as angles: `log_motion(T(q) T(dq))`.
"""

from __future__ import annotations

import numpy as np

from tomopose.geometry.object_pose import point_jacobian
from tomopose.geometry.rotations import exp_rotation, log_rotation, skew
from tomopose.trajectory.completeness import source_path
from tomopose.units import Array


def transforms(q: Array, centre: Array) -> Array:
    """T(q) (n, 4, 4) of motions q (n, 6), mm and rad, about the point `centre` (3,)."""
    T = np.zeros((len(q), 4, 4))
    R = exp_rotation(q[:, 3:])
    T[:, :3, :3], T[:, 3, 3] = R, 1.0
    T[:, :3, 3] = q[:, :3] + centre - R @ centre
    return T


def motions_of(T: Array, centre: Array) -> Array:
    """The motions (n, 6) of rigid transforms T (n, 4, 4): the inverse of `transforms`."""
    R = T[:, :3, :3]
    return np.concatenate([T[:, :3, 3] - centre + R @ centre, log_rotation(R)], axis=1)


def composed(q: Array, dq: Array, centre: Array) -> Array:
    """The motion of T(q) T(dq): first dq, then q, each (n, 6)."""
    return motions_of(transforms(q, centre) @ transforms(dq, centre), centre)


def gauge(P: Array, centre: Array) -> Array:
    """(n, 6, 7): what the images cannot show.  Six columns: one rigid pose of the object, common to all views.  The
    seventh is its size: an object enlarged about each view's source gives the same images, which for one object is an
    enlargement about `centre` and, view by view, a shift away from the source."""
    n = len(P)
    G = np.zeros((n, 6, 7))
    G[:, :, :6] = np.eye(6)
    G[:, :3, 6] = centre - source_path(P)
    return G


def without_gauge(q: Array, G: Array, precision: Array) -> Array:
    """q (n, 6) with the part along the gauge G (n, 6, 7) taken out, at right angles in the prior's precision (6n, 6n):
    in those directions the prior's own value remains."""
    flat, g = q.ravel(), G.reshape(-1, G.shape[2])
    K = precision @ g
    # the size's column is a thousand times larger than the others
    scale = 1 / np.sqrt(np.maximum(np.einsum("ij,ij->j", g, K), 1e-300))
    inner = (g * scale).T @ (K * scale)
    return np.asarray(flat - (g * scale) @ np.linalg.lstsq(inner, (K * scale).T @ flat, rcond=1e-10)[0]).reshape(
        q.shape
    )


def pixel_jacobian(P: Array, points: Array, centre: Array) -> Array:
    """d(u, v)/d(t, w) (n, m, 2, 6), px per mm and rad, of points (m, 3) of W."""
    G = point_jacobian(P, points)
    return np.concatenate([G, -G @ skew(points - centre)], axis=3)
