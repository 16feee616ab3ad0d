"""Path lengths of all rays of a view: through a closed mesh by its triangles, through balls on shafts in closed form.

A ray is x = s + w d(u, v) with d = M^-1 (u, v, 1) for P = [M | p], so that w is the depth along the optical axis.  Over
a triangle 1/w is linear in (u, v): every triangle that covers a pixel adds its depth there, exits positive and entries
negative, and |d| times the sum is the path.  A pixel whose entries and exits do not balance lies on an edge to within
rounding; the view is then cast again a millionth of a pixel aside.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from tomopose.errors import EngineFailedError
from tomopose.units import Array

ASIDE_PX, ATTEMPTS = 1e-6, 8


def fine_matrices(P: Array, samples: int) -> Array:
    """Matrices (..., 3, 4) to pixels cut into samples x samples: u becomes samples (u + 1/2) - 1/2."""
    shift = (samples - 1) / 2
    B = np.array([[samples, 0, shift], [0, samples, shift], [0, 0, 1.0]])
    return np.asarray(B @ P)


def ray_lengths(P: Array, n_u: int, n_v: int) -> tuple[Array, Array]:
    """(source (3,), |d| (n_v, n_u)) of the rays through pixel centres."""
    inverse = np.linalg.inv(P[:, :3])
    u, v = np.arange(n_u, dtype=np.float64), np.arange(n_v, dtype=np.float64)[:, None]
    squares = [(row[0] * u + row[1] * v + row[2]) ** 2 for row in inverse]
    return -inverse @ P[:, 3], np.asarray(np.sqrt(squares[0] + squares[1] + squares[2]))


def mesh_paths(P: Array, vertices: Array, faces: Any, n_u: int, n_v: int) -> Array:
    """Path lengths (n_v, n_u), mm, in the view with P (3, 4) through a closed mesh: vertices (n, 3), mm in W, and faces
    (m, 3), counter-clockwise from outside.

    EngineFailedError where the mesh is not closed.
    """
    for attempt in range(ATTEMPTS):
        moved = P.copy()
        moved[:2] += attempt * ASIDE_PX * np.outer([1.0, 0.618], P[2])
        depth, balance = np.zeros((n_v, n_u)), np.zeros((n_v, n_u), dtype=np.int8)
        _add_triangles(moved, vertices, faces, depth, balance)
        if not balance.any():
            # A matrix of negative determinant shows a mirror image, in which triangles run the other way.
            return np.sign(np.linalg.det(P[:, :3])) * depth * ray_lengths(P, n_u, n_v)[1]
    bad = int(np.count_nonzero(balance))
    raise EngineFailedError(f"entries and exits of {bad} rays do not balance: the mesh has a hole")


@njit(cache=True, nogil=True)
def _inside(e: float, low_side: bool) -> bool:
    """Whether a pixel with edge function e, taken from the lower to the higher vertex number, lies on the triangle's
    side; on the edge itself one of two neighbours has it."""
    return (e >= 0.0) if low_side else (e < 0.0)


@njit(cache=True, nogil=True)
def _add_triangles(P: Any, x: Any, faces: Any, depth: Any, balance: Any) -> None:
    n_v, n_u = depth.shape
    n = len(x)
    h = np.empty((n, 3))
    for i in range(n):
        w = P[2, 0] * x[i, 0] + P[2, 1] * x[i, 1] + P[2, 2] * x[i, 2] + P[2, 3]
        h[i, 0] = (P[0, 0] * x[i, 0] + P[0, 1] * x[i, 1] + P[0, 2] * x[i, 2] + P[0, 3]) / w
        h[i, 1] = (P[1, 0] * x[i, 0] + P[1, 1] * x[i, 1] + P[1, 2] * x[i, 2] + P[1, 3]) / w
        h[i, 2] = w
    order = np.empty(3, dtype=np.int64)
    for f in range(len(faces)):
        order[0], order[1], order[2] = faces[f, 0], faces[f, 1], faces[f, 2]
        # Vertices in ascending order, so that a common edge is computed from the same numbers in both triangles.
        turned = False
        for a, b in ((0, 1), (1, 2), (0, 1)):
            if order[a] > order[b]:
                order[a], order[b] = order[b], order[a]
                turned = not turned
        i, j, k = order[0], order[1], order[2]
        u_1, v_1, u_2, v_2, u_3, v_3 = h[i, 0], h[i, 1], h[j, 0], h[j, 1], h[k, 0], h[k, 1]
        area = (u_2 - u_1) * (v_3 - v_1) - (v_2 - v_1) * (u_3 - u_1)
        if area == 0.0:
            continue
        up = area > 0.0
        # Counter-clockwise from outside: seen from the source a front face runs one way, a back face the other.
        sign = 1.0 if up != turned else -1.0
        # 1 / w is linear in (u, v).
        q_1, q_2, q_3 = 1.0 / h[i, 2], 1.0 / h[j, 2], 1.0 / h[k, 2]
        low_w, high_w = min(h[i, 2], h[j, 2], h[k, 2]), max(h[i, 2], h[j, 2], h[k, 2])
        u_low, u_high = max(int(np.ceil(min(u_1, u_2, u_3))), 0), min(int(np.floor(max(u_1, u_2, u_3))), n_u - 1)
        v_low, v_high = max(int(np.ceil(min(v_1, v_2, v_3))), 0), min(int(np.floor(max(v_1, v_2, v_3))), n_v - 1)
        for v in range(v_low, v_high + 1):
            for u in range(u_low, u_high + 1):
                e_12 = (u_2 - u_1) * (v - v_1) - (v_2 - v_1) * (u - u_1)
                if not _inside(e_12, up):
                    continue
                e_23 = (u_3 - u_2) * (v - v_2) - (v_3 - v_2) * (u - u_2)
                if not _inside(e_23, up):
                    continue
                e_13 = (u_3 - u_1) * (v - v_1) - (v_3 - v_1) * (u - u_1)
                if not _inside(e_13, not up):
                    continue
                q = (e_23 * q_1 - e_13 * q_2 + e_12 * q_3) / area
                depth[v, u] += sign * min(max(1.0 / q, low_w), high_w)
                balance[v, u] += 1 if sign > 0 else -1


def ball_paths(
    P: Array, centres: Array, radii: Array, shaft_radius: float, bottom: Array, n_u: int, n_v: int
) -> Array:
    """Path lengths (n_v, n_u), mm, through balls, centres (m, 3), mm in W, and radii (m,), each on an upright shaft
    from the height `bottom` (m,); what a ball and its own shaft share counts once."""
    out = np.zeros((n_v, n_u))
    _add_balls(P, np.linalg.inv(P[:, :3]), centres, radii, shaft_radius, bottom, out)
    return out


@njit(cache=True, nogil=True)
def _add_balls(P: Any, inverse: Any, centres: Any, radii: Any, shaft: float, bottom: Any, out: Any) -> None:
    n_v, n_u = out.shape
    s = -(inverse @ np.ascontiguousarray(P[:, 3]))
    for m in range(len(centres)):
        c, r = centres[m], radii[m]
        # The shaft ends at the ball's centre: the hidden part changes nothing.
        u_low, u_high, v_low, v_high = 1e30, -1e30, 1e30, -1e30
        for corner in range(8):
            x = c[0] + (r if corner & 1 else -r)
            y = c[1] + (r if corner & 2 else -r)
            z = c[2] + r if corner & 4 else min(bottom[m], c[2] - r)
            w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
            u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w
            v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w
            u_low, u_high, v_low, v_high = min(u_low, u), max(u_high, u), min(v_low, v), max(v_high, v)
        o_x, o_y, o_z = s[0] - c[0], s[1] - c[1], s[2] - c[2]
        for v in range(max(int(v_low), 0), min(int(v_high) + 2, n_v)):
            for u in range(max(int(u_low), 0), min(int(u_high) + 2, n_u)):
                d_x = inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]
                d_y = inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2]
                d_z = inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]
                length = np.sqrt(d_x * d_x + d_y * d_y + d_z * d_z)
                d_x, d_y, d_z = d_x / length, d_y / length, d_z / length
                b = o_x * d_x + o_y * d_y + o_z * d_z
                # Distances from the point nearest to the ball, so that no small number is a difference of large ones.
                n_x, n_y, n_z = o_x - b * d_x, o_y - b * d_y, o_z - b * d_z
                under = r * r - (n_x * n_x + n_y * n_y + n_z * n_z)
                ball = np.sqrt(under) if under > 0.0 else 0.0
                path = 2.0 * ball
                a = d_x * d_x + d_y * d_y
                e = n_x * d_x + n_y * d_y
                under = e * e - a * (n_x * n_x + n_y * n_y - shaft * shaft)
                if under > 0.0 and a > 0.0 and bottom[m] < c[2]:
                    root = np.sqrt(under)
                    low, high = (-e - root) / a, (-e + root) / a
                    if d_z != 0.0:
                        end_1, end_2 = (bottom[m] - c[2] - n_z) / d_z, -n_z / d_z
                        low, high = max(low, min(end_1, end_2)), min(high, max(end_1, end_2))
                    elif n_z > 0.0 or n_z < bottom[m] - c[2]:
                        high = low
                    if high > low:
                        path += high - low - max(min(high, ball) - max(low, -ball), 0.0)
                out[v, u] += path
