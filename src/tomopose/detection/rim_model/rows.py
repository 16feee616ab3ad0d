r"""The radiograph around the rim, and its derivatives.

    I = sum_k hat_k(psi) (a_k O(s) + b_k R(s) + c_k Q(s)) + w (1 - O(s))

a_k, b_k, c_k are the background's level, slope and curvature at angular node k, w what the ball puts in its place
(scattered radiation, the detector's offset; white in an inverted image).  Every pixel sees two nodes, so that its row
of the Jacobian has 14 entries whatever the number of nodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tomopose.detection.rim_model.edge_profile import STRAIGHT
from tomopose.detection.rim_model.ring import SHELLS
from tomopose.kernel_cache import njit
from tomopose.units import Array

SHAPE = ("u", "v", "radius", "sigma", "kappa", "q_cos", "q_sin")
"""Nonlinear parameters: centre and radius (px), blur, total attenuation along the diameter, and the blur's anisotropy:
variance sigma^2 + q_cos cos 2 psi + q_sin sin 2 psi."""
N_SHAPE = len(SHAPE)
KAPPA, WHITE = SHAPE.index("kappa"), N_SHAPE
FIRST_NODE = N_SHAPE + 1
"""Parameters in order: shape (7), w, then a_k, b_k, c_k in turn."""
LOCAL = FIRST_NODE + 6
"""Parameters that one pixel sees, in the order of the Jacobian's rows: shape, w, and a, b, c of its two nodes."""


class Edge(NamedTuple):
    """What the rows need of the rim: table, first, step of its EdgeProfile; radius and blur, px; rad per px of radius.

    variance_u, variance_v: what the pixel's box and q_cos add to the blur's variance along u and v, px^2; q_sin.
    """

    table: Array
    first: float
    step: float
    radius: float
    sigma: float
    gamma_px: float
    variance_u: float
    variance_v: float
    q_sin: float


@njit(cache=True, fastmath=True)
def model_rows(distance, rim, share, bounds, near_shells, nodes, white, edge):  # type: ignore[no-untyped-def]
    """value (n,) and jacobian (14, n): the model and its derivatives at each pixel.

    distance: (n,) from the rim; rim, share, bounds: of RingPixels.  nodes: (k, 3).  near_shells: shells that the edge
    is felt in.  edge: Edge as a plain tuple.  Jacobian rows: shape (7), w, then a, b, c of the node on the left and of
    that on the right.
    """
    n, k = distance.shape[0], nodes.shape[0]
    value, jacobian = np.empty(n), np.empty((LOCAL, n))
    for node in range(k):
        left, right = nodes[node], nodes[node + 1 if node + 1 < k else 0]
        start, stop = bounds[node * SHELLS], bounds[(node + 1) * SHELLS]
        far = bounds[node * SHELLS + near_shells]
        _on_edge(distance, rim, share, start, far, left, right, white, edge, value, jacobian)
        _beyond(distance, rim, share, far, stop, left, right, edge, value, jacobian)
    return value, jacobian


@njit(cache=True, fastmath=True)
def _on_edge(distance, rim, share, start, stop, left, right, white, edge, value, jacobian):  # type: ignore[no-untyped-def]
    table, first, step, radius, sigma, gamma_px, variance_u, variance_v, q_sin = edge
    last, per_step, straight, least = table.shape[0] - 2, 1.0 / step, table.shape[1] == STRAIGHT, 0.1 * sigma
    for i in range(start, stop):
        x = (distance[i] - first) * per_step
        j = int(min(max(x, 0.0), float(last)))
        f = min(max(x - j, 0.0), 1.0)
        O = table[j, 0] + f * (table[j + 1, 0] - table[j, 0])
        O1 = table[j, 1] + f * (table[j + 1, 1] - table[j, 1])
        O2 = table[j, 2] + f * (table[j + 1, 2] - table[j, 2])
        R = table[j, 3] + f * (table[j + 1, 3] - table[j, 3])
        Q = table[j, 4] + f * (table[j + 1, 4] - table[j, 4])
        # Of an opaque ball with a straight rim R' = O, R'' = O' and Q' = R: half as much to look up.
        R1, R2, Ok, Rk, Q1, Or = O, O1, 0.0, 0.0, R, O1
        if not straight:
            R1 = table[j, 5] + f * (table[j + 1, 5] - table[j, 5])
            R2 = table[j, 6] + f * (table[j + 1, 6] - table[j, 6])
            Ok = table[j, 7] + f * (table[j + 1, 7] - table[j, 7])
            Rk = table[j, 8] + f * (table[j + 1, 8] - table[j, 8])
            Q1 = table[j, 9] + f * (table[j + 1, 9] - table[j, 9])
            Or = table[j, 10] + f * (table[j + 1, 10] - table[j, 10])
        c, s = rim[4, i], rim[5, i]
        extra = 0.5 * (variance_u * c * c + variance_v * s * s) + q_sin * c * s
        w = share[i]
        a = left[0] + w * (right[0] - left[0])
        b = left[1] + w * (right[1] - left[1])
        e = left[2] + w * (right[2] - left[2])
        along = b * R1 + e * Q1
        across = (a - white) * O1 + along
        bend = (a - white) * O2 + b * R2 + e * O
        Q += extra * O
        O += extra * O2
        R += extra * R2
        value[i] = a * O + b * R + e * Q + white * (1.0 - O)
        jacobian[0, i] = across * rim[1, i]
        jacobian[1, i] = across * rim[2, i]
        jacobian[2, i] = ((a - white) * Or + along) * rim[3, i] * gamma_px
        jacobian[3, i] = sigma * (bend + across / max(radius + distance[i], least))
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


@njit(cache=True, fastmath=True)
def _beyond(distance, rim, share, start, stop, left, right, edge, value, jacobian):  # type: ignore[no-untyped-def]
    """The same where the edge is over: O = 1, R = s, Q = (s^2 + variance) / 2."""
    _, _, _, _, sigma, gamma_px, variance_u, variance_v, q_sin = edge
    for i in range(start, stop):
        R, c, s, w = distance[i], rim[4, i], rim[5, i], share[i]
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
def influence(jacobian, sector, weight, rows, k):  # type: ignore[no-untyped-def]
    """(n, m): change of m parameters per standard deviation of each pixel's noise; rows (m, 8 + 3k) of the inverse."""
    n, m = jacobian.shape[1], rows.shape[0]
    out = np.zeros((n, m))
    for i in range(n):
        node = sector[i]
        right = node + 1 if node + 1 < k else 0
        root = math.sqrt(weight[i])
        for q in range(m):
            total = 0.0
            for p in range(FIRST_NODE):
                total += rows[q, p] * jacobian[p, i]
            for p in range(3):
                total += rows[q, FIRST_NODE + 3 * node + p] * jacobian[FIRST_NODE + p, i]
                total += rows[q, FIRST_NODE + 3 * right + p] * jacobian[FIRST_NODE + 3 + p, i]
            out[i, q] = total * root
    return out
