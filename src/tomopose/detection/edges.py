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
SHELL_EDGES = (7.0, 10.0, 14.0)
"""Distances from the rim, px, at which the ring is cut into shells."""
SHELLS = len(SHELL_EDGES) + 1


@njit(cache=True, fastmath=True)
def model_rows(  # type: ignore[no-untyped-def]
    rim, left, share, nodes, white, table, opaque, first, step, sigma, gamma_px, box_u, box_v, q_cos, q_sin, value,
    jacobian,
):  # fmt: skip
    """Fills value (n,) and jacobian (14, n): the model and its derivatives at each pixel.

    rim: (6, n) of cone_coordinates; left, share: (n,) of by_sector.  nodes: (k, 3).  jacobian rows: shape (7), w, then
    a, b, c of the node on the left and of that on the right.  gamma_px: rad per px of radius.  box_u, box_v: variance
    of a pixel's box across a rim normal to u or v, less their mean.  opaque: whether kappa is infinite.
    """
    n, k = rim.shape[1], nodes.shape[0]
    last = table.shape[0] - 2
    per_step = 1.0 / step
    for i in range(n):
        x = (rim[0, i] - first) * per_step
        j = min(max(int(x), 0), last)
        f = min(max(x - j, 0.0), 1.0)
        O = table[j, 0] + f * (table[j + 1, 0] - table[j, 0])
        O1 = table[j, 1] + f * (table[j + 1, 1] - table[j, 1])
        O2 = table[j, 2] + f * (table[j + 1, 2] - table[j, 2])
        R = table[j, 3] + f * (table[j + 1, 3] - table[j, 3])
        Q = table[j, 8] + f * (table[j + 1, 8] - table[j, 8])
        # Of an opaque ball R' = O, R'' = O' and Q' = R: half as much to look up.
        R1, R2, Ok, Rk, Q1 = O, O1, 0.0, 0.0, R
        if not opaque:
            R1 = table[j, 4] + f * (table[j + 1, 4] - table[j, 4])
            R2 = table[j, 5] + f * (table[j + 1, 5] - table[j, 5])
            Ok = table[j, 6] + f * (table[j + 1, 6] - table[j, 6])
            Rk = table[j, 7] + f * (table[j + 1, 7] - table[j, 7])
            Q1 = table[j, 9] + f * (table[j + 1, 9] - table[j, 9])
        c, s = rim[4, i], rim[5, i]
        c2, s2 = c * c - s * s, 2.0 * c * s
        extra = 0.5 * (box_u * c * c + box_v * s * s + q_cos * c2 + q_sin * s2)
        Q += extra * O
        O += extra * O2
        R += extra * R2
        node, w = left[i], share[i]
        right = node + 1 if node + 1 < k else 0
        a = (1.0 - w) * nodes[node, 0] + w * nodes[right, 0]
        b = (1.0 - w) * nodes[node, 1] + w * nodes[right, 1]
        e = (1.0 - w) * nodes[node, 2] + w * nodes[right, 2]
        value[i] = a * O + b * R + e * Q + white * (1.0 - O)
        across = (a - white) * O1 + b * R1 + e * Q1
        bend = (a - white) * O2 + b * R2 + e * O
        jacobian[0, i] = across * rim[1, i]
        jacobian[1, i] = across * rim[2, i]
        jacobian[2, i] = across * rim[3, i] * gamma_px
        jacobian[3, i] = sigma * bend
        jacobian[4, i] = (a - white) * Ok + b * Rk
        jacobian[5, i] = 0.5 * bend * c2
        jacobian[6, i] = 0.5 * bend * s2
        jacobian[7, i] = 1.0 - O
        jacobian[8, i] = (1.0 - w) * O
        jacobian[9, i] = (1.0 - w) * R
        jacobian[10, i] = (1.0 - w) * Q
        jacobian[11, i] = w * O
        jacobian[12, i] = w * R
        jacobian[13, i] = w * Q


@njit(cache=True, fastmath=True)
def normal_equations(image, value, jacobian, first, weight, columns, low, high):  # type: ignore[no-untyped-def]
    """(N, g): weighted normal matrix (8 + 3k, 8 + 3k) and right side J' W (image - value) of the shells low to high.

    first: (k SHELLS + 1,) of by_sector.  columns: rows of the Jacobian that count (the others are left 0).  Within a
    sector every entry is one sum along the pixels, which runs in registers.
    """
    k = (first.shape[0] - 1) // SHELLS
    size = FIRST_NODE + 3 * k
    N = np.zeros((size, size))
    g = np.zeros(size)
    longest = 0
    for node in range(k):
        longest = max(longest, first[node * SHELLS + high] - first[node * SHELLS + low])
    row = np.empty(longest)
    for node in range(k):
        start = first[node * SHELLS + low]
        n = first[node * SHELLS + high] - start
        if n == 0:
            continue
        w, y, y_model = weight[start : start + n], image[start : start + n], value[start : start + n]
        for i_p in range(columns.shape[0]):
            p = columns[i_p]
            at_p = _place(p, node, k)
            a = jacobian[p, start : start + n]
            total = 0.0
            for i in range(n):
                row[i] = a[i] * w[i]
                total += row[i] * (y[i] - y_model[i])
            g[at_p] += total
            for i_q in range(i_p + 1):
                q = columns[i_q]
                at_q = _place(q, node, k)
                b = jacobian[q, start : start + n]
                total = 0.0
                for i in range(n):
                    total += row[i] * b[i]
                N[at_p, at_q] += total
                if i_p != i_q:
                    N[at_q, at_p] += total
    return N, g


@njit(cache=True, inline="always")
def _place(p, node, k):  # type: ignore[no-untyped-def]
    """Where parameter p of a sector's Jacobian stands among all parameters."""
    if p < FIRST_NODE:
        return p
    if p < FIRST_NODE + 3:
        return p + 3 * node
    return p - 3 + 3 * (node + 1 if node + 1 < k else 0)


@njit(cache=True, fastmath=True)
def gradient(image, value, jacobian, first, weight, columns, high):  # type: ignore[no-untyped-def]
    """g alone of normal_equations, of the shells before `high`."""
    k = (first.shape[0] - 1) // SHELLS
    g = np.zeros(FIRST_NODE + 3 * k)
    for node in range(k):
        start, stop = first[node * SHELLS], first[node * SHELLS + high]
        for i_p in range(columns.shape[0]):
            p = columns[i_p]
            total = 0.0
            for i in range(start, stop):
                total += jacobian[p, i] * weight[i] * (image[i] - value[i])
            g[_place(p, node, k)] += total
    return g


@njit(cache=True)
def with_priors(N, g, precision, pull, active):  # type: ignore[no-untyped-def]
    """Rows and columns `active` of N and g, priors added: precision on the diagonal, pull on the right side."""
    n = active.shape[0]
    part, right = np.empty((n, n)), np.empty(n)
    for i in range(n):
        right[i] = g[active[i]] + pull[active[i]]
        for j in range(n):
            part[i, j] = N[active[i], active[j]]
        part[i, i] += precision[active[i]]
    return part, right


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
