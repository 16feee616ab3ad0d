r"""The silhouette of a ball: the cone that it subtends at the source.

A ray with direction d makes the angle theta with the cone's axis m; the cone's half-angle is gamma.  The axis meets
the detector at the projection of the ball's *centre*, x_D ~ K m, so that the silhouette needs neither an ellipse nor
a correction of its centre (paper ref. [19]).  Around the silhouette a pixel is described by

    s   = (theta - gamma) / |grad theta| / p        signed distance to the silhouette, outside positive, px
    psi = direction of grad theta on the detector   angle round the rim, rad

with the gradient taken on the detector in mm and p = sqrt(p_u p_v): in a square pixel's units, whatever the pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tomopose.geometry.scanner import Scanner
from tomopose.units import Array


def cone_radius(scanner: Scanner, x_D: Array, gamma: float) -> float:
    """Radius of the silhouette in px: gamma / |grad theta| at the centre, mean over directions."""
    G = _metric(scanner, x_D)
    return float(gamma / np.sqrt(np.sqrt(np.linalg.det(G))) / math.sqrt(scanner.p_u * scanner.p_v))


def cone_angle(scanner: Scanner, x_D: Array, radius: float) -> float:
    """Half-angle gamma, rad, of the cone about the centre x_D whose silhouette has about that radius, px."""
    return float(radius / cone_radius(scanner, x_D, 1.0))


def _metric(scanner: Scanner, x_D: Array) -> Array:
    """theta^2 near the axis as a quadratic form in detector mm, (2, 2)."""
    inverse = np.linalg.inv(scanner.K)
    m = inverse @ np.array([x_D[0], x_D[1], 1.0])
    length = np.linalg.norm(m)
    J = inverse[:, :2] / np.array([scanner.p_u, scanner.p_v]) / length
    J = J - np.outer(m, m @ J) / length**2
    return np.asarray(J.T @ J)


def silhouette_ellipse(scanner: Scanner, x_D: Array, gamma: float) -> tuple[Array, float, float, float]:
    """The silhouette as an ellipse in pixels: centre (2,), semi-major, semi-minor, angle of the major axis from u.

    x' (m m' - cos(gamma)^2 I) x = 0 with rays x = K^-1 [u, v, 1].
    """
    inverse = np.linalg.inv(scanner.K)
    m = inverse @ np.array([x_D[0], x_D[1], 1.0])
    m = m / np.linalg.norm(m)
    C = inverse.T @ (np.outer(m, m) - math.cos(gamma) ** 2 * np.eye(3)) @ inverse
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    value = C[2, 2] + C[:2, 2] @ centre
    eigenvalues, vectors = np.linalg.eigh(C[:2, :2])
    axes = np.sqrt(-value / eigenvalues)
    major = int(np.argmax(axes))
    angle = math.atan2(vectors[1, major], vectors[0, major]) % math.pi
    return centre, float(axes[major]), float(axes[1 - major]), angle


@njit(cache=True, fastmath=True)
def cone_coordinates(u, v, inverse_K, p_u, p_v, u_c, v_c, gamma):  # type: ignore[no-untyped-def]
    """(n, 6): s, ds/du_c, ds/dv_c, ds/dgamma, cos psi, sin psi for pixels u, v (n,).

    The derivatives leave out the change of |grad theta|, a factor 1 + O(s / radius) that vanishes on the rim.
    """
    n = u.shape[0]
    out = np.empty((n, 6))
    K = inverse_K
    p = math.sqrt(p_u * p_v)
    m0 = K[0, 0] * u_c + K[0, 1] * v_c + K[0, 2]
    m1 = K[1, 0] * u_c + K[1, 1] * v_c + K[1, 2]
    m2 = K[2, 0] * u_c + K[2, 1] * v_c + K[2, 2]
    m_length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    m0, m1, m2 = m0 / m_length, m1 / m_length, m2 / m_length
    mk_u = m0 * K[0, 0] + m1 * K[1, 0] + m2 * K[2, 0]
    mk_v = m0 * K[0, 1] + m1 * K[1, 1] + m2 * K[2, 1]
    for i in range(n):
        d0 = K[0, 0] * u[i] + K[0, 1] * v[i] + K[0, 2]
        d1 = K[1, 0] * u[i] + K[1, 1] * v[i] + K[1, 2]
        d2 = K[2, 0] * u[i] + K[2, 1] * v[i] + K[2, 2]
        d_length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        d0, d1, d2 = d0 / d_length, d1 / d_length, d2 / d_length
        c0, c1, c2 = d1 * m2 - d2 * m1, d2 * m0 - d0 * m2, d0 * m1 - d1 * m0
        sine = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2) + 1e-300
        cosine = d0 * m0 + d1 * m1 + d2 * m2
        dk_u = d0 * K[0, 0] + d1 * K[1, 0] + d2 * K[2, 0]
        dk_v = d0 * K[0, 1] + d1 * K[1, 1] + d2 * K[2, 1]
        g_u = -(mk_u - cosine * dk_u) / (d_length * sine) / p_u
        g_v = -(mk_v - cosine * dk_v) / (d_length * sine) / p_v
        slope = math.sqrt(g_u * g_u + g_v * g_v) + 1e-300
        scale = 1.0 / (slope * p)
        out[i, 0] = (math.atan2(sine, cosine) - gamma) * scale
        out[i, 1] = -(dk_u - cosine * mk_u) / (m_length * sine) * scale
        out[i, 2] = -(dk_v - cosine * mk_v) / (m_length * sine) * scale
        out[i, 3] = -scale
        out[i, 4] = g_u / slope
        out[i, 5] = g_v / slope
    return out


@njit(cache=True)
def ring_pixels(window, good, u_first, v_first, u_c, v_c, low, high, ratio_u, ratio_v):  # type: ignore[no-untyped-def]
    """u, v, value (n,) of the good pixels of a window at a distance in [low, high] (square px)."""
    rows, columns = window.shape
    size = 0
    for turn in range(2):
        if turn == 1:
            u, v, value = np.empty(size), np.empty(size), np.empty(size)
        size = 0
        for j in range(rows):
            dv = (j + v_first - v_c) * ratio_v
            rest = high * high - dv * dv
            if rest < 0.0:
                continue
            reach = math.sqrt(rest) / ratio_u
            first = max(0, math.ceil(u_c - u_first - reach))
            last = min(columns - 1, math.floor(u_c - u_first + reach))
            for i in range(first, last + 1):
                du = (i + u_first - u_c) * ratio_u
                if du * du + dv * dv >= low * low and good[j, i]:
                    if turn == 1:
                        u[size], v[size], value[size] = i + u_first, j + v_first, window[j, i]
                    size += 1
    return u, v, value
