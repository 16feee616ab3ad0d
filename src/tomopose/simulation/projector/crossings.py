"""Where a ray crosses each kind of primitive, in closed form (the torus: by bracketing), in float64.

Before any quadratic is solved, the ray's origin is moved to the point nearest to the primitive, so that no small number
is the difference of two large ones: the error of a path stays below 1 nm even at grazing incidence.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from tomopose.kernel_cache import njit

FAR = 1.0e12
"""Where a crossing lies that a half-space or an unbounded slab does not have, mm."""


SIDE, FACE_1, FACE_3, FACE_5 = (cast(int, np.int64(k)) for k in (0, 1, 3, 5))
"""Numbers of faces.  numba compiles a function anew for each plain number that it is called with, not for these."""


@njit(cache=True, nogil=True, inline="always")
def _put(T: np.ndarray, S: np.ndarray, row: int, t_0: float, t_1: float, s_0: int, s_1: int) -> int:
    """Write one interval into a row of crossings; returns how many crossings that are (0 or 2)."""
    if t_1 > t_0:
        T[row, 0], T[row, 1], S[row, 0], S[row, 1] = t_0, t_1, s_0, s_1
        return 2
    return 0


@njit(cache=True, nogil=True)
def _slab(o: float, d: float, h: float, face: int, lo: float, hi: float, s_lo: int, s_hi: int) -> Any:
    """Cut the interval (lo, hi) with |o + t d| <= h; faces `face` (at -h) and `face` + 1 (at +h)."""
    if d == 0.0:
        if abs(o) > h:
            return 1.0, 0.0, 0, 0
        return lo, hi, s_lo, s_hi
    a, b, f_a, f_b = (-h - o) / d, (h - o) / d, face, face + 1
    if d < 0:
        a, b, f_a, f_b = b, a, f_b, f_a
    if a > lo:
        lo, s_lo = a, f_a
    if b < hi:
        hi, s_hi = b, f_b
    return lo, hi, s_lo, s_hi


@njit(cache=True, nogil=True)
def _root(c: np.ndarray, n: int, lo: float, hi: float) -> float:
    """The root of the polynomial c[0] + c[1] t + ... of degree n between lo and hi, where its sign changes."""
    f_lo = c[n]
    for k in range(n - 1, -1, -1):
        f_lo = f_lo * lo + c[k]
    t = 0.5 * (lo + hi)
    for _ in range(80):
        f, g = c[n], 0.0
        for k in range(n - 1, -1, -1):
            g = g * t + f
            f = f * t + c[k]
        if (f < 0) == (f_lo < 0):
            lo = t
        else:
            hi = t
        new = t - f / g if g != 0 else lo - 1.0
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
        if abs(new - t) < 1e-15 * (1 + abs(t)) or hi - lo < 1e-15:
            return new
        t = new
    return t


@njit(cache=True, nogil=True)
def _torus(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    ring: float,
    tube: float,
    T: np.ndarray,
    S: np.ndarray,
    row: int,
) -> int:
    """Crossings of a torus, from an origin near it: the quartic's roots between its derivatives' roots."""
    b = ox * dx + oy * dy + oz * dz
    c = ox * ox + oy * oy + oz * oz - ring * ring - tube * tube
    k = 4 * ring * ring
    reach = ring + tube
    q = np.empty((4, 5))
    q[3, 4] = 1.0
    q[3, 3] = 4 * b
    q[3, 2] = 2 * c + 4 * b * b + k * dz * dz
    q[3, 1] = 4 * b * c + 2 * k * oz * dz
    q[3, 0] = c * c - k * (tube * tube - oz * oz)
    for i in (2, 1, 0):
        for j in range(i + 2):
            q[i, j] = (j + 1) * q[i + 1, j + 1]
    lo, hi = -b - reach - 1.0, -b + reach + 1.0
    roots = np.empty(6)
    edges = np.empty(6)
    m = 0
    for degree in range(1, 5):
        edges[0] = lo
        for j in range(m):
            edges[j + 1] = roots[j]
        edges[m + 1] = hi
        n = 0
        for j in range(m + 1):
            f_0 = f_1 = q[degree - 1, degree]
            for i in range(degree - 1, -1, -1):
                f_0 = f_0 * edges[j] + q[degree - 1, i]
                f_1 = f_1 * edges[j + 1] + q[degree - 1, i]
            if (f_0 < 0) != (f_1 < 0):
                roots[n] = _root(q[degree - 1], degree, edges[j], edges[j + 1])
                n += 1
        m = n
    if m % 2:
        m -= 1
    for j in range(m):
        T[row, j], S[row, j] = roots[j], 0
    return m


@njit(cache=True, nogil=True)
def crossings(
    primitives: np.ndarray,
    q: int,
    o: tuple[float, float, float],
    d: tuple[float, float, float],
    T: np.ndarray,
    S: np.ndarray,
    row: int,
) -> int:
    """Crossings of primitive q with the ray o + t d: into row `row` of T (distances) and S (faces); how many (even).

    primitives (n, 16): numbers p (3), place t (3), directions R (9, by rows) and kind.
    """
    # The ray's origin moves to the point nearest to the primitive's own origin; `shift` brings distances back.
    at = primitives[q]
    dx, dy, dz = d
    ex, ey, ez = o[0] - at[3], o[1] - at[4], o[2] - at[5]
    shift = -(ex * dx + ey * dy + ez * dz)
    ex, ey, ez = ex + shift * dx, ey + shift * dy, ez + shift * dz
    n = 0
    what, a, b = int(at[15]), at[0], at[1]
    if what == 0:
        inside = a * a - (ex * ex + ey * ey + ez * ez)
        if inside > 0:
            half = np.sqrt(inside)
            n = _put(T, S, row, -half, half, 0, 0)
    else:
        lx = at[6] * ex + at[9] * ey + at[12] * ez
        ly = at[7] * ex + at[10] * ey + at[13] * ez
        lz = at[8] * ex + at[11] * ey + at[14] * ez
        gx = at[6] * dx + at[9] * dy + at[12] * dz
        gy = at[7] * dx + at[10] * dy + at[13] * dz
        gz = at[8] * dx + at[11] * dy + at[14] * dz
        if what == 1:
            n = _cylinder(lx, ly, lz, gx, gy, gz, a, b, T, S, row)
        elif what == 2:
            n = _cone(lx, ly, lz, gx, gy, gz, a, b, at[2], T, S, row)
        elif what == 3:
            lo, hi, s_lo, s_hi = _slab(lx, gx, a, FACE_1, -FAR, FAR, SIDE, SIDE)
            lo, hi, s_lo, s_hi = _slab(ly, gy, b, FACE_3, lo, hi, s_lo, s_hi)
            lo, hi, s_lo, s_hi = _slab(lz, gz, at[2], FACE_5, lo, hi, s_lo, s_hi)
            n = _put(T, S, row, lo, hi, s_lo, s_hi)
        elif what == 4:
            if ex * ex + ey * ey + ez * ez < (a + b) ** 2:
                n = _torus(lx, ly, lz, gx, gy, gz, a, b, T, S, row)
        elif gz == 0.0:
            n = _put(T, S, row, -FAR, FAR, 0, 0) if lz <= 0 else 0
        elif gz > 0:
            n = _put(T, S, row, -FAR, -lz / gz, 1, 0)
        else:
            n = _put(T, S, row, -lz / gz, FAR, 0, 1)
    for k in range(n):
        T[row, k] += shift
        S[row, k] += 8 * q
    return n


@njit(cache=True, nogil=True)
def _cylinder(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    r: float,
    h: float,
    T: np.ndarray,
    S: np.ndarray,
    row: int,
) -> int:
    a = dx * dx + dy * dy
    lo, hi = -FAR, FAR
    if a < 1e-28:
        if ox * ox + oy * oy >= r * r:
            return 0
    else:
        # The nearest point to the axis, again, keeps the discriminant exact.
        k = -(ox * dx + oy * dy) / a
        nx, ny = ox + k * dx, oy + k * dy
        inside = r * r - (nx * nx + ny * ny)
        if inside <= 0:
            return 0
        half = np.sqrt(inside / a)
        lo, hi = k - half, k + half
    lo, hi, s_lo, s_hi = _slab(oz, dz, h, FACE_1, lo, hi, SIDE, SIDE)
    return _put(T, S, row, lo, hi, s_lo, s_hi)


@njit(cache=True, nogil=True)
def _cone(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    r: float,
    h: float,
    slope: float,
    T: np.ndarray,
    S: np.ndarray,
    row: int,
) -> int:
    """Truncated cone, radius r + slope z for |z| <= h: convex, so one interval at most."""
    lo, hi, s_lo, s_hi = _slab(oz, dz, h, FACE_1, -FAR, FAR, SIDE, SIDE)
    if not hi > lo:
        return 0
    # x^2 + y^2 - (r + slope z)^2 = a t^2 + 2 b t + c, inside where negative; on |z| <= h the radius is not negative.
    rho, drho = r + slope * oz, slope * dz
    a = dx * dx + dy * dy - drho * drho
    b = ox * dx + oy * dy - rho * drho
    c = ox * ox + oy * oy - rho * rho
    if abs(a) < 1e-14:
        if b == 0.0:
            return _put(T, S, row, lo, hi, s_lo, s_hi) if c < 0 else 0
        root = -c / (2 * b)
        if b > 0 and root < hi:
            hi, s_hi = root, 0
        elif b < 0 and root > lo:
            lo, s_lo = root, 0
        return _put(T, S, row, lo, hi, s_lo, s_hi)
    disc = b * b - a * c
    if disc <= 0:
        return 0 if a > 0 else _put(T, S, row, lo, hi, s_lo, s_hi)
    q = -(b + np.sqrt(disc)) if b > 0 else -b + np.sqrt(disc)
    t_0, t_1 = q / a, c / q if q != 0.0 else 0.0
    if t_0 > t_1:
        t_0, t_1 = t_1, t_0
    if a > 0:
        if t_0 > lo:
            lo, s_lo = t_0, 0
        if t_1 < hi:
            hi, s_hi = t_1, 0
        return _put(T, S, row, lo, hi, s_lo, s_hi)
    # a < 0: inside before t_0 and after t_1; the nappe with positive radius is the one that meets |z| <= h.
    if drho > 0:
        if t_1 > lo:
            lo, s_lo = t_1, 0
    elif t_0 < hi:
        hi, s_hi = t_0, 0
    return _put(T, S, row, lo, hi, s_lo, s_hi)
