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


def cone_eccentricity(scanner: Scanner, x_D: Array, gamma: float) -> float:
    """By how much, px, the silhouette may deviate from the circle about x_D: its axes differ, its centre is not x_D."""
    p = np.array([scanner.p_u, scanner.p_v])
    axes = gamma / np.sqrt(np.linalg.eigvalsh(_metric(scanner, x_D)))
    away = (silhouette_ellipse(scanner, x_D, gamma)[0] - x_D) * p
    return float(axes[0] - axes[1] + np.hypot(*away)) / math.sqrt(scanner.p_u * scanner.p_v)


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
    """(6, n): s, ds/du_c, ds/dv_c, ds/dgamma, cos psi, sin psi for pixels u, v (n,).

    The derivatives leave out the change of |grad theta|, a factor 1 + O(s / radius) that vanishes on the rim.
    """
    n = u.shape[0]
    out = np.empty((6, n))
    K = inverse_K
    p = math.sqrt(p_u * p_v)
    m0 = K[0, 0] * u_c + K[0, 1] * v_c + K[0, 2]
    m1 = K[1, 0] * u_c + K[1, 1] * v_c + K[1, 2]
    m2 = K[2, 0] * u_c + K[2, 1] * v_c + K[2, 2]
    m_length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    m0, m1, m2 = m0 / m_length, m1 / m_length, m2 / m_length
    mk_u = m0 * K[0, 0] + m1 * K[1, 0] + m2 * K[2, 0]
    mk_v = m0 * K[0, 1] + m1 * K[1, 1] + m2 * K[2, 1]
    cos_gamma, sin_gamma = math.cos(gamma), math.sin(gamma)
    for i in range(n):
        d0 = K[0, 0] * u[i] + K[0, 1] * v[i] + K[0, 2]
        d1 = K[1, 0] * u[i] + K[1, 1] * v[i] + K[1, 2]
        d2 = K[2, 0] * u[i] + K[2, 1] * v[i] + K[2, 2]
        shorter = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        d0, d1, d2 = d0 * shorter, d1 * shorter, d2 * shorter
        c0, c1, c2 = d1 * m2 - d2 * m1, d2 * m0 - d0 * m2, d0 * m1 - d1 * m0
        sine = math.sqrt(c0 * c0 + c1 * c1 + c2 * c2) + 1e-300
        cosine = d0 * m0 + d1 * m1 + d2 * m2
        dk_u = d0 * K[0, 0] + d1 * K[1, 0] + d2 * K[2, 0]
        dk_v = d0 * K[0, 1] + d1 * K[1, 1] + d2 * K[2, 1]
        per_sine = 1.0 / sine
        g_u = -(mk_u - cosine * dk_u) * (shorter * per_sine / p_u)
        g_v = -(mk_v - cosine * dk_v) * (shorter * per_sine / p_v)
        flatter = 1.0 / (math.sqrt(g_u * g_u + g_v * g_v) + 1e-300)
        scale = flatter / p
        out[0, i] = _angle(sine * cos_gamma - cosine * sin_gamma, cosine * cos_gamma + sine * sin_gamma) * scale
        out[1, i] = -(dk_u - cosine * mk_u) * (per_sine * scale / m_length)
        out[2, i] = -(dk_v - cosine * mk_v) * (per_sine * scale / m_length)
        out[3, i] = -scale
        out[4, i] = g_u * flatter
        out[5, i] = g_v * flatter
    return out


@njit(cache=True, fastmath=True, inline="always")
def _angle(sine, cosine):  # type: ignore[no-untyped-def]
    """The angle of that sine and cosine; near 0 by the arc sine's series, which is exact to 1e-16 there."""
    x = sine * sine
    if x > 1e-3 or cosine < 0.0:
        return math.atan2(sine, cosine)
    return sine * (1.0 + x * (1 / 6 + x * (3 / 40 + x * (15 / 336 + x * (105 / 3456 + x * (945 / 42240))))))


@njit(cache=True, fastmath=True, inline="always")
def _direction(c, s):  # type: ignore[no-untyped-def]
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


@njit(cache=True)
def ring_pixels(window, good, u_first, v_first, u_c, v_c, low, high, ratio_u, ratio_v, every):  # type: ignore[no-untyped-def]
    """u, v, value (n,) of the good pixels of a window at a distance in [low, high] (square px).

    every: one pixel in so many is taken, on a lattice that has as large a share in each row and column.
    """
    rows, columns = window.shape
    n = 0
    for turn in range(2):
        if turn == 1:
            u, v, value = np.empty(n), np.empty(n), np.empty(n)
        n = 0
        for j in range(rows):
            dv = (j + v_first - v_c) * ratio_v
            rest = high * high - dv * dv
            if rest < 0.0:
                continue
            middle, reach = u_c - u_first, math.sqrt(rest) / ratio_u
            gap = low * low - dv * dv if low > 0.0 else -1.0
            hole = math.sqrt(gap) / ratio_u if gap > 0.0 else -1.0
            first, last = max(0, math.ceil(middle - reach)), min(columns - 1, math.floor(middle + reach))
            i = first
            while i <= last:
                if abs(i - middle) < hole:
                    i = max(i + 1, math.ceil(middle + hole))
                    continue
                if good[j, i] and (every == 1 or (i + 2 * j) % every == 0):
                    if turn == 1:
                        u[n], v[n], value[n] = i + u_first, j + v_first, window[j, i]
                    n += 1
                i += 1
    return u, v, value


@njit(cache=True, fastmath=True)
def by_sector(u, v, value, rim, low, high, thin_from, k, edges):  # type: ignore[no-untyped-def]
    """The pixels with s in (low, high), by sector and in it by shell: u, v, value, rim, left (n,), share (n,), first.

    Sector j reaches from angular node j to the next; left is that j, share how far a pixel lies towards the next node.
    Its shells are cut at the distances `edges` (m,); shell i of it begins at first[j (m + 1) + i], first has
    k (m + 1) + 1 entries.  Every second pixel with s > thin_from is left out.
    """
    turn, shells = k / (2.0 * math.pi), edges.shape[0] + 1
    cell, part = np.empty(u.shape[0], np.int64), np.empty(u.shape[0])
    first = np.zeros(k * shells + 1, np.int64)
    for i in range(u.shape[0]):
        s = rim[0, i]
        cell[i] = -1
        if s > low and s < high and (s < thin_from or (int(u[i]) + int(v[i])) % 2 == 0):
            angle = _direction(rim[4, i], rim[5, i]) * turn
            node = min(int(angle), k - 1)
            shell = 0
            while shell < shells - 1 and s > edges[shell]:
                shell += 1
            cell[i], part[i] = node * shells + shell, angle - node
            first[cell[i] + 1] += 1
    for j in range(k * shells):
        first[j + 1] += first[j]
    n = first[k * shells]
    place = first.copy()
    new_u, new_v, new_value, share, left = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.int64)
    new_rim = np.empty((6, n))
    source = np.empty(n, np.int64)
    for i in range(u.shape[0]):
        if cell[i] >= 0:
            source[place[cell[i]]] = i
            place[cell[i]] += 1
    for at in range(n):
        i = source[at]
        new_u[at], new_v[at], new_value[at], share[at] = u[i], v[i], value[i], part[i]
        left[at] = cell[i] // shells
    for c in range(6):
        for at in range(n):
            new_rim[c, at] = rim[c, source[at]]
    return new_u, new_v, new_value, new_rim, left, share, first
