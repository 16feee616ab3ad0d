"""Euler angles of the formats that write them, exact to rounding at and near the gimbal lock as well.

The first angle is taken from the matrix and undone; the other two follow from what is left.  Where the first angle is
ill determined its error so moves into the last one, and the product is the given rotation again.  All (n, 3, 3), rad.
"""

from __future__ import annotations

import numpy as np

from tomopose.geometry.rotations import R_z
from tomopose.units import Array


def _without_z(R: Array, a: Array) -> Array:
    return np.swapaxes(R_z(a), -1, -2) @ R


def zyz_angles(R: Array) -> Array:
    """(n, 3): a, b, c with R = R_z(a) R_y(b) R_z(c); b and c are 0 where R turns about z alone."""
    locked = np.hypot(R[:, 0, 2], R[:, 1, 2]) < 1e-12
    a = np.where(locked, np.arctan2(R[:, 1, 0], R[:, 0, 0]), np.arctan2(R[:, 1, 2], R[:, 0, 2]))
    rest = _without_z(R, a)
    b = np.arctan2(rest[:, 0, 2], rest[:, 2, 2])
    return np.stack([a, b, np.arctan2(rest[:, 1, 0], rest[:, 1, 1])], axis=1)


def zyx_angles(R: Array) -> Array:
    """(n, 3): a, b, c with R = R_z(a) R_y(b) R_x(c)."""
    a = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    rest = _without_z(R, a)
    return np.stack([a, np.arctan2(-rest[:, 2, 0], rest[:, 0, 0]), np.arctan2(-rest[:, 1, 2], rest[:, 1, 1])], axis=1)


def zxy_angles(R: Array) -> Array:
    """(n, 3): a, b, c with R = R_z(a) R_x(b) R_y(c)."""
    a = np.arctan2(-R[:, 0, 1], R[:, 1, 1])
    rest = _without_z(R, a)
    return np.stack([a, np.arctan2(rest[:, 2, 1], rest[:, 1, 1]), np.arctan2(rest[:, 0, 2], rest[:, 0, 0])], axis=1)
