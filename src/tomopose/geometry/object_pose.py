"""The rigid pose of an object, on which no measurement depends: found from images of its points, and taken out."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.geometry.rotations import skew
from tomopose.geometry.transforms import moved
from tomopose.least_squares import least_squares
from tomopose.units import Array

STEPS, STILL = 50, 1e-12
"""Steps at the most; px, rms: a step that moves the images by less ends the iteration."""


def pixels(P: Array, x: Array) -> Array:
    """Pixels (n, m, 2) of points x (m, 3), whatever the sign of P: the W origin of a robot's home may lie behind the
    source, and `canonical` then turns the sign of w for the object."""
    h = np.einsum("nij,mj->nmi", P[:, :, :3], x) + P[:, None, :, 3]
    result: Array = h[..., :2] / h[..., 2:]
    return result


def pixels_and_jacobian(P: Array, x: Array) -> tuple[Array, Array]:
    """Pixels (n, m, 2) of points x (m, 3) under matrices P (n, 3, 4), and d(u, v)/dx (n, m, 2, 3)."""
    h = np.einsum("nij,mj->nmi", P[:, :, :3], x) + P[:, None, :, 3]
    u, w = h[..., :2] / h[..., 2:], h[..., 2:]
    return u, (P[:, None, :2, :3] - u[..., None] * P[:, None, 2:, :3]) / w[..., None]


def point_jacobian(P: Array, x: Array) -> Array:
    """d(u, v)/dx (n, m, 2, 3) of points x (m, 3) under matrices P (n, 3, 4)."""
    return pixels_and_jacobian(P, x)[1]


def object_pose(P: ArrayLike, target: ArrayLike, points: ArrayLike) -> tuple[Array, Array]:
    """(R (3, 3), t (3,)): the motion x -> R x + t of points (m, 3) of W, mm, that brings their images under P (n, 3, 4)
    nearest to `target` (n, m, 2), px, by the sum of squares."""
    P, seen, x = np.asarray(P), np.asarray(target), np.asarray(points, dtype=np.float64)
    middle = x.mean(axis=0)

    def rows(pose: tuple[Array, Array]) -> tuple[Array, Array]:
        R, t = pose
        y = (x - middle) @ R.T + t
        u, G = pixels_and_jacobian(P, y)
        J = np.concatenate([-G @ skew(y - t), G], axis=3)
        return (seen - u).ravel(), J.reshape(-1, 6)

    start = (np.eye(3), middle)
    R, t = least_squares(rows, lambda pose, step: moved(*pose, step), start, steps=STEPS, tolerance=STILL).state
    return R, t - R @ middle


def without_object_pose(P: ArrayLike, P_true: ArrayLike, points: ArrayLike) -> Array:
    """Differences (n, m, 2), px, of the points' pixels under P and P_true, the best rigid object pose removed."""
    P, x = np.asarray(P), np.asarray(points, dtype=np.float64)
    target = pixels(np.asarray(P_true), x)
    R, t = object_pose(P, target, x)
    return pixels(P, x @ R.T + t) - target
