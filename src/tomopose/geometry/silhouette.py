"""The outline of a ball on the detector: an ellipse, whose centre is not that of the ball (paper ref. [19])."""

from __future__ import annotations

import math

import numpy as np

from tomopose.geometry.scanner import Scanner
from tomopose.units import Array


def principal_axes(M: Array) -> tuple[float, float, float]:
    """Eigenvalues of a symmetric (2, 2), the smaller first, and the direction of the smaller's vector in [0, pi)."""
    (uu, uv), (_, vv) = M.tolist()
    mean, half = (uu + vv) / 2, math.hypot((uu - vv) / 2, uv)
    return mean - half, mean + half, (math.atan2(2 * uv, uu - vv) / 2 + math.pi / 2) % math.pi


def silhouette_ellipse(scanner: Scanner, x_D: Array, gamma: float) -> tuple[Array, float, float, float]:
    """The silhouette as an ellipse in pixels: centre (2,), semi-major, semi-minor, angle of the major axis from u.

    x' (cos(gamma)^2 I - m m') x = 0 with rays x = K^-1 [u, v, 1].
    """
    inverse = np.linalg.inv(scanner.K)
    m = inverse @ (x_D[0], x_D[1], 1.0)
    n = inverse.T @ m / math.sqrt(m @ m)
    C = math.cos(gamma) ** 2 * (inverse.T @ inverse) - n[:, None] * n
    (uu, uv, u), (_, vv, v), (_, _, one) = C.tolist()
    determinant = uu * vv - uv * uv
    centre = np.array([(uv * v - vv * u) / determinant, (uv * u - uu * v) / determinant])
    value = -(one + u * centre[0] + v * centre[1])
    small, large, angle = principal_axes(C[:2, :2])
    return centre, math.sqrt(value / small), math.sqrt(value / large), angle
