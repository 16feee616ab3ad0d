r"""The radiograph around the rim and its normal equations.

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
WHITE = N_SHAPE
FIRST_NODE = N_SHAPE + 1
"""Parameters in order: shape (7), w, then a_k, b_k, c_k in turn."""


@njit(cache=True, fastmath=True)
def model_rows(  # type: ignore[no-untyped-def]
    rim, nodes, white, table, first, step, sigma, gamma_px, box_u, box_v, q_cos, q_sin, value, jacobian, left, share
):  # fmt: skip
    """Fills value (n,), jacobian (n, 14), left (n,) and share (n,): the model and its derivatives at each pixel.

    rim: (n, 6) of cone_coordinates.  nodes: (k, 3).  jacobian columns: shape (7), w, then a, b, c of the node on the
    left and of that on the right.  gamma_px: rad per px of radius.  box_u, box_v: variance of a pixel's box across a
    rim normal to u or v, less their mean.
    """
    n, k = rim.shape[0], nodes.shape[0]
    turn = k / (2.0 * math.pi)
    last = table.shape[0] - 2
    for i in range(n):
        x = (rim[i, 0] - first) / step
        j = min(max(int(x), 0), last)
        f = min(max(x - j, 0.0), 1.0)
        O = table[j, 0] + f * (table[j + 1, 0] - table[j, 0])
        O1 = table[j, 1] + f * (table[j + 1, 1] - table[j, 1])
        O2 = table[j, 2] + f * (table[j + 1, 2] - table[j, 2])
        R = table[j, 3] + f * (table[j + 1, 3] - table[j, 3])
        R1 = table[j, 4] + f * (table[j + 1, 4] - table[j, 4])
        R2 = table[j, 5] + f * (table[j + 1, 5] - table[j, 5])
        Ok = table[j, 6] + f * (table[j + 1, 6] - table[j, 6])
        Rk = table[j, 7] + f * (table[j + 1, 7] - table[j, 7])
        Q = table[j, 8] + f * (table[j + 1, 8] - table[j, 8])
        Q1 = table[j, 9] + f * (table[j + 1, 9] - table[j, 9])
        c, s = rim[i, 4], rim[i, 5]
        c2, s2 = c * c - s * s, 2.0 * c * s
        extra = 0.5 * (box_u * c * c + box_v * s * s + q_cos * c2 + q_sin * s2)
        O += extra * O2
        R += extra * R2
        Q += extra * O
        angle = math.atan2(s, c) * turn
        if angle < 0.0:
            angle += k
        node = int(angle)
        w = angle - node
        if node >= k:
            node, w = 0, 0.0
        right = node + 1 if node + 1 < k else 0
        a = (1.0 - w) * nodes[node, 0] + w * nodes[right, 0]
        b = (1.0 - w) * nodes[node, 1] + w * nodes[right, 1]
        e = (1.0 - w) * nodes[node, 2] + w * nodes[right, 2]
        left[i], share[i] = node, w
        value[i] = a * O + b * R + e * Q + white * (1.0 - O)
        across = (a - white) * O1 + b * R1 + e * Q1
        bend = (a - white) * O2 + b * R2 + e * O
        jacobian[i, 0] = across * rim[i, 1]
        jacobian[i, 1] = across * rim[i, 2]
        jacobian[i, 2] = across * rim[i, 3] * gamma_px
        jacobian[i, 3] = sigma * bend
        jacobian[i, 4] = (a - white) * Ok + b * Rk
        jacobian[i, 5] = 0.5 * bend * c2
        jacobian[i, 6] = 0.5 * bend * s2
        jacobian[i, 7] = 1.0 - O
        jacobian[i, 8] = (1.0 - w) * O
        jacobian[i, 9] = (1.0 - w) * R
        jacobian[i, 10] = (1.0 - w) * Q
        jacobian[i, 11] = w * O
        jacobian[i, 12] = w * R
        jacobian[i, 13] = w * Q


@njit(cache=True, fastmath=True)
def normal_equations(image, value, jacobian, left, weight, k):  # type: ignore[no-untyped-def]
    """(N, g): weighted normal matrix (8 + 3k, 8 + 3k) and right side J' W (image - value)."""
    size = 8 + 3 * k
    N = np.zeros((size, size))
    g = np.zeros(size)
    column = np.empty(14, np.int64)
    block = np.zeros((k, 14, 14))
    right_side = np.zeros((k, 14))
    for i in range(image.shape[0]):
        w = weight[i]
        if w == 0.0:
            continue
        r = image[i] - value[i]
        node = left[i]
        for p in range(14):
            jw = jacobian[i, p] * w
            right_side[node, p] += jw * r
            for q in range(14):
                block[node, p, q] += jw * jacobian[i, q]
    for node in range(k):
        right = node + 1 if node + 1 < k else 0
        for p in range(8):
            column[p] = p
        for p in range(3):
            column[8 + p] = 8 + 3 * node + p
            column[11 + p] = 8 + 3 * right + p
        for p in range(14):
            g[column[p]] += right_side[node, p]
            for q in range(p + 1):
                N[column[p], column[q]] += block[node, p, q]
                if p != q:
                    N[column[q], column[p]] += block[node, p, q]
    return N, g


@njit(cache=True)
def influence(jacobian, left, weight, rows, k):  # type: ignore[no-untyped-def]
    """(n, m): change of m parameters per standard deviation of each pixel's noise; rows (m, 8 + 3k) of the inverse."""
    n, m = jacobian.shape[0], rows.shape[0]
    out = np.zeros((n, m))
    for i in range(n):
        node = left[i]
        right = node + 1 if node + 1 < k else 0
        root = math.sqrt(weight[i])
        for q in range(m):
            total = 0.0
            for p in range(8):
                total += rows[q, p] * jacobian[i, p]
            for p in range(3):
                total += rows[q, 8 + 3 * node + p] * jacobian[i, 8 + p]
                total += rows[q, 8 + 3 * right + p] * jacobian[i, 11 + p]
            out[i, q] = total * root
    return out
