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

from tomopose.geometry.scanner import Scanner
from tomopose.geometry.silhouette import principal_axes, silhouette_ellipse
from tomopose.kernel_cache import njit
from tomopose.units import Array


def cone_radius(scanner: Scanner, x_D: Array, gamma: float) -> float:
    """Radius of the silhouette in px: gamma / |grad theta| at the centre, mean over directions."""
    (uu, uv), (_, vv) = _metric(scanner, x_D).tolist()
    return float(gamma / math.sqrt(math.sqrt(uu * vv - uv * uv)) / math.sqrt(scanner.p_u * scanner.p_v))


def cone_angle(scanner: Scanner, x_D: Array, radius: float) -> float:
    """Half-angle gamma, rad, of the cone about the centre x_D whose silhouette has about that radius, px."""
    return float(radius / cone_radius(scanner, x_D, 1.0))


def cone_eccentricity(scanner: Scanner, x_D: Array, gamma: float) -> float:
    """By how much, px, the silhouette may deviate from the circle about x_D: its axes differ, its centre is not x_D."""
    small, large, _ = principal_axes(_metric(scanner, x_D))
    away = silhouette_ellipse(scanner, x_D, gamma)[0] - x_D
    off = math.hypot(away[0] * scanner.p_u, away[1] * scanner.p_v)
    return (gamma / math.sqrt(small) - gamma / math.sqrt(large) + off) / math.sqrt(scanner.p_u * scanner.p_v)


def _metric(scanner: Scanner, x_D: Array) -> Array:
    """theta^2 near the axis as a quadratic form in detector mm, (2, 2)."""
    inverse = np.linalg.inv(scanner.K)
    m = inverse @ (x_D[0], x_D[1], 1.0)
    square = m @ m
    J = inverse[:, :2] / (scanner.p_u, scanner.p_v)
    along = m @ J
    return np.asarray((J.T @ J - along[:, None] * along / square) / square)


@njit(cache=True, fastmath=True)
def cone_coordinates(u, v, inverse_K, p_u, p_v, u_c, v_c, gamma):  # type: ignore[no-untyped-def]
    """(6, n): s, ds/du_c, ds/dv_c, ds/dgamma, cos psi, sin psi for pixels u, v (n,).

    With d = K^-1 [u, v, 1] and the axis m of unit length: theta = atan2(|d x m|, d.m), and tan(theta - gamma) is small.
    The derivatives leave out the change of |grad theta|, a factor 1 + O(s / radius) that vanishes on the rim.
    """
    n = u.shape[0]
    out = np.empty((6, n))
    U0, U1, U2 = inverse_K[0, 0], inverse_K[1, 0], inverse_K[2, 0]
    V0, V1, V2 = inverse_K[0, 1], inverse_K[1, 1], inverse_K[2, 1]
    W0, W1, W2 = inverse_K[0, 2], inverse_K[1, 2], inverse_K[2, 2]
    m0, m1, m2 = U0 * u_c + V0 * v_c + W0, U1 * u_c + V1 * v_c + W1, U2 * u_c + V2 * v_c + W2
    length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    m0, m1, m2 = m0 / length, m1 / length, m2 / length
    mU, mV = m0 * U0 + m1 * U1 + m2 * U2, m0 * V0 + m1 * V1 + m2 * V2
    per_p, per_length = 1.0 / math.sqrt(p_u * p_v), 1.0 / length
    cos_gamma, sin_gamma = math.cos(gamma), math.sin(gamma)
    for i in range(n):
        d0, d1, d2 = U0 * u[i] + V0 * v[i] + W0, U1 * u[i] + V1 * v[i] + W1, U2 * u[i] + V2 * v[i] + W2
        along = d0 * m0 + d1 * m1 + d2 * m2
        a0, a1, a2 = d0 - along * m0, d1 - along * m1, d2 - along * m2
        across_square = a0 * a0 + a1 * a1 + a2 * a2 + 1e-300
        across = math.sqrt(across_square)
        per_across = 1.0 / across
        aU, aV = a0 * U0 + a1 * U1 + a2 * U2, a0 * V0 + a1 * V1 + a2 * V2
        # grad theta = (along grad across - across grad along) / |d|^2, times across |d|^2.
        g_u, g_v = (along * aU - across_square * mU) / p_u, (along * aV - across_square * mV) / p_v
        per_g = 1.0 / math.sqrt(g_u * g_u + g_v * g_v + 1e-300)
        scale = across * (across_square + along * along) * per_g * per_p
        t = (across * cos_gamma - along * sin_gamma) / (along * cos_gamma + across * sin_gamma)
        x = t * t
        series = 1 / 3 - x * (1 / 5 - x * (1 / 7 - x * (1 / 9 - x * (1 / 11 - x / 13))))
        out[0, i] = scale * t * (1.0 - x * series)
        out[1, i] = -aU * (per_across * scale * per_length)
        out[2, i] = -aV * (per_across * scale * per_length)
        out[3, i] = -scale
        out[4, i] = g_u * per_g
        out[5, i] = g_v * per_g
    return out


@njit(cache=True, fastmath=True)
def followed(distance, rim, du, dv, dgamma):  # type: ignore[no-untyped-def]
    """(n,) the distances after a small move of the cone, to first order; rim: (6, n) of cone_coordinates."""
    out = np.empty(distance.shape[0])
    for i in range(out.shape[0]):
        out[i] = distance[i] + rim[1, i] * du + rim[2, i] * dv + rim[3, i] * dgamma
    return out


@njit(cache=True, fastmath=True)
def direction_angle(c, s):  # type: ignore[no-untyped-def]
    """Angle of (c, s) in [0, 2 pi] to 1e-5 rad: where angular nodes lie need not be exact.

    Arc tangent: Abramowitz & Stegun, Handbook of Mathematical Functions, 4.4.49.
    """
    x, y = abs(c), abs(s)
    t = min(x, y) / max(x, y, 1e-300)
    q = t * t
    angle = t * (0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351))))
    if y > x:
        angle = 0.5 * math.pi - angle
    if c < 0.0:
        angle = math.pi - angle
    return 2.0 * math.pi - angle if s < 0.0 else angle
