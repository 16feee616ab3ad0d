r"""The radiograph around the rim, and its derivatives.

    I = sum_k hat_k(psi) (a_k O(s) + b_k R(s) + c_k Q(s)) + w (1 - O(s))

a_k, b_k, c_k are the background's level, slope and curvature at angular node k, w what the ball puts in its place
(scattered radiation, the detector's offset; white in an inverted image).  Every pixel sees two nodes, so that its row
of the Jacobian has 14 entries whatever the number of nodes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

SHAPE = ("u", "v", "radius", "sigma", "kappa", "q_cos", "q_sin")
"""Nonlinear parameters: centre and radius (px), blur, total attenuation along the diameter, and the blur's anisotropy:
variance sigma^2 + q_cos cos 2 psi + q_sin sin 2 psi."""
N_SHAPE = len(SHAPE)
KAPPA, WHITE = SHAPE.index("kappa"), N_SHAPE
FIRST_NODE = N_SHAPE + 1
"""Parameters in order: shape (7), w, then a_k, b_k, c_k in turn."""
SHELL_EDGES = (7.0, 10.0, 14.0)
"""Distances from the rim, px, at which the ring is cut into shells."""
SHELLS = len(SHELL_EDGES) + 1


@njit(cache=True, fastmath=True, error_model="numpy")
def model_rows(  # type: ignore[no-untyped-def]
    rim, share, bounds, near_shells, nodes, white, profile, opaque, first, step, sigma, gamma_px, box_u, box_v, q_cos,
    q_sin, value, jacobian,
):  # fmt: skip
    """Fills value (n,) and jacobian (14, n): the model and its derivatives at each pixel.

    rim: (6, n) of cone_coordinates; share, bounds: of by_sector.  nodes: (k, 3).  jacobian rows: shape (7), w, then
    a, b, c of the node on the left and of that on the right.  near_shells: shells that the edge is felt in.  profile,
    first, step: of edge_profile; opaque: whether kappa is infinite.  gamma_px: rad per px of radius.  box_u, box_v:
    variance of a pixel's box across a rim normal to u or v, less their mean.
    """
    k = nodes.shape[0]
    variance_u, variance_v = box_u + q_cos, box_v - q_cos
    for node in range(k):
        left, right = nodes[node], nodes[node + 1 if node + 1 < k else 0]
        start, stop = bounds[node * SHELLS], bounds[(node + 1) * SHELLS]
        far = bounds[node * SHELLS + near_shells]
        _on_edge(rim, share, start, far, left, right, white, profile, opaque, first, 1.0 / step, sigma, gamma_px,
                 variance_u, variance_v, q_sin, value, jacobian)  # fmt: skip
        _beyond(rim, share, far, stop, left, right, sigma, gamma_px, variance_u, variance_v, q_sin, value, jacobian)


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _on_edge(  # type: ignore[no-untyped-def]
    rim, share, start, stop, left, right, white, profile, opaque, first, per_step, sigma, gamma_px, variance_u,
    variance_v, q_sin, value, jacobian,
):  # fmt: skip
    last = profile.shape[0] - 2
    for i in range(start, stop):
        x = (rim[0, i] - first) * per_step
        j = int(min(max(x, 0.0), float(last)))
        f = min(max(x - j, 0.0), 1.0)
        O = profile[j, 0] + f * (profile[j + 1, 0] - profile[j, 0])
        O1 = profile[j, 1] + f * (profile[j + 1, 1] - profile[j, 1])
        O2 = profile[j, 2] + f * (profile[j + 1, 2] - profile[j, 2])
        R = profile[j, 3] + f * (profile[j + 1, 3] - profile[j, 3])
        Q = profile[j, 4] + f * (profile[j + 1, 4] - profile[j, 4])
        # Of an opaque ball R' = O, R'' = O' and Q' = R: half as much to look up.
        R1, R2, Ok, Rk, Q1 = O, O1, 0.0, 0.0, R
        if not opaque:
            R1 = profile[j, 5] + f * (profile[j + 1, 5] - profile[j, 5])
            R2 = profile[j, 6] + f * (profile[j + 1, 6] - profile[j, 6])
            Ok = profile[j, 7] + f * (profile[j + 1, 7] - profile[j, 7])
            Rk = profile[j, 8] + f * (profile[j + 1, 8] - profile[j, 8])
            Q1 = profile[j, 9] + f * (profile[j + 1, 9] - profile[j, 9])
        c, s = rim[4, i], rim[5, i]
        extra = 0.5 * (variance_u * c * c + variance_v * s * s) + q_sin * c * s
        Q += extra * O
        O += extra * O2
        R += extra * R2
        w = share[i]
        a = left[0] + w * (right[0] - left[0])
        b = left[1] + w * (right[1] - left[1])
        e = left[2] + w * (right[2] - left[2])
        value[i] = a * O + b * R + e * Q + white * (1.0 - O)
        across = (a - white) * O1 + b * R1 + e * Q1
        bend = (a - white) * O2 + b * R2 + e * O
        jacobian[0, i] = across * rim[1, i]
        jacobian[1, i] = across * rim[2, i]
        jacobian[2, i] = across * rim[3, i] * gamma_px
        jacobian[3, i] = sigma * bend
        jacobian[4, i] = (a - white) * Ok + b * Rk
        jacobian[5, i] = 0.5 * bend * (c * c - s * s)
        jacobian[6, i] = bend * c * s
        jacobian[7, i] = 1.0 - O
        jacobian[8, i] = (1.0 - w) * O
        jacobian[9, i] = (1.0 - w) * R
        jacobian[10, i] = (1.0 - w) * Q
        jacobian[11, i] = w * O
        jacobian[12, i] = w * R
        jacobian[13, i] = w * Q


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _beyond(  # type: ignore[no-untyped-def]
    rim, share, start, stop, left, right, sigma, gamma_px, variance_u, variance_v, q_sin, value, jacobian
):  # fmt: skip
    """The same where the edge is over: O = 1, R = s, Q = (s^2 + variance) / 2."""
    for i in range(start, stop):
        R, c, s, w = rim[0, i], rim[4, i], rim[5, i], share[i]
        Q = 0.5 * (R * R + sigma * sigma + variance_u * c * c + variance_v * s * s) + q_sin * c * s
        a = left[0] + w * (right[0] - left[0])
        b = left[1] + w * (right[1] - left[1])
        e = left[2] + w * (right[2] - left[2])
        value[i] = a + b * R + e * Q
        across = b + e * R
        jacobian[0, i] = across * rim[1, i]
        jacobian[1, i] = across * rim[2, i]
        jacobian[2, i] = across * rim[3, i] * gamma_px
        jacobian[3, i] = sigma * e
        jacobian[4, i] = 0.0
        jacobian[5, i] = 0.5 * e * (c * c - s * s)
        jacobian[6, i] = e * c * s
        jacobian[7, i] = 0.0
        jacobian[8, i] = 1.0 - w
        jacobian[9, i] = (1.0 - w) * R
        jacobian[10, i] = (1.0 - w) * Q
        jacobian[11, i] = w
        jacobian[12, i] = w * R
        jacobian[13, i] = w * Q


@njit(cache=True)
def influence(jacobian, left, weight, rows, k):  # type: ignore[no-untyped-def]
    """(n, m): change of m parameters per standard deviation of each pixel's noise; rows (m, 8 + 3k) of the inverse."""
    n, m = jacobian.shape[1], rows.shape[0]
    out = np.zeros((n, m))
    for i in range(n):
        node = left[i]
        right = node + 1 if node + 1 < k else 0
        root = math.sqrt(weight[i])
        for q in range(m):
            total = 0.0
            for p in range(8):
                total += rows[q, p] * jacobian[p, i]
            for p in range(3):
                total += rows[q, 8 + 3 * node + p] * jacobian[8 + p, i]
                total += rows[q, 8 + 3 * right + p] * jacobian[11 + p, i]
            out[i, q] = total * root
    return out
