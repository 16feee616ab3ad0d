"""Normal equations of the fit: N = J' W J and g = J' W (image - model), sums over sectors of small blocks.

A sector's pixels see the shape, w and the two nodes at its sides: 14 parameters, whatever the number of nodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tomopose.detection.rim_fit.state import Indices, RimFit, Unknowns, active_parameters, jacobian_rows
from tomopose.detection.rim_model.ring import SHELLS
from tomopose.detection.rim_model.rows import FIRST_NODE, KAPPA, LOCAL, WHITE
from tomopose.kernel_cache import njit
from tomopose.units import Array


class Equations(NamedTuple):
    """blocks (k, 15, 14): each sector's part; N (p, p), upper triangle, and g (p,): their sum, without priors."""

    blocks: Array
    N: Array
    g: Array


def equations(fit: RimFit, unknowns: Unknowns) -> Equations:
    """Of all shells that have weight."""
    blocks = shell_blocks(fit, unknowns, 0, 1)
    if fit.shells > 1 and fit.pixels.bounds[-1] > 0:
        blocks = blocks + shell_blocks(fit, unknowns, 1, fit.shells)
    return summed(blocks)


def summed(blocks: Array, share: Array | None = None) -> Equations:
    """The equations of the sectors' blocks, each times its share."""
    N, g = _assembled(blocks, np.ones(len(blocks)) if share is None else share)
    return Equations(blocks, N, g)


def shell_blocks(fit: RimFit, unknowns: Unknowns, low: int, high: int) -> Array:
    """Each sector's part (k, 15, 14) of the shells from low to before high."""
    edge = low == 0 or fit.edge_shells > 1
    return np.asarray(
        _sector_blocks(
            fit.pixels.value, fit.model, fit.jacobian, fit.pixels.bounds, fit.weight,
            jacobian_rows(unknowns, edge=edge), low, high,
        )
    )  # fmt: skip


def with_gradient(fit: RimFit, unknowns: Unknowns, known: Equations) -> Equations:
    """The same matrix with the right side of the present residuals."""
    rows = jacobian_rows(unknowns, edge=True)
    g = _gradient(fit.pixels.value, fit.model, fit.jacobian, fit.pixels.bounds, fit.weight, rows, fit.shells)
    return known._replace(g=g)


def with_priors(fit: RimFit, of: Equations, unknowns: Unknowns) -> tuple[Array, Array]:
    """Rows and columns of N and g of what is fitted, priors added."""
    p, priors = fit.parameters, fit.priors
    N, g = _with_priors(
        of.N, of.g, active_parameters(unknowns, len(p.nodes)), p.shape, float(p.white), p.nodes, priors.kappa,
        priors.log_radius, priors.white, priors.nodes,
    )  # fmt: skip
    return N, g


def place_of(unknowns: Unknowns, nodes: int, index: Indices) -> Indices:
    """Where the parameters with those indices are among those that are fitted."""
    return np.searchsorted(active_parameters(unknowns, nodes), index)


@njit(cache=True, fastmath=True)
def _sector_blocks(image, value, jacobian, first, weight, columns, low, high):  # type: ignore[no-untyped-def]
    """(k, LOCAL + 1, LOCAL): each sector's part of N, lower triangle, and in the last row of g; shells low to high.

    first: (k SHELLS + 1,), RingPixels.bounds.  columns: rows of the Jacobian that count (the others are left 0).
    Within a sector every entry is one sum along the pixels, which runs in registers.
    """
    k = (first.shape[0] - 1) // SHELLS
    out = np.zeros((k, LOCAL + 1, LOCAL))
    longest = 0
    for node in range(k):
        longest = max(longest, first[node * SHELLS + high] - first[node * SHELLS + low])
    row = np.empty(longest)
    for node in range(k):
        start, stop = first[node * SHELLS + low], first[node * SHELLS + high]
        n = stop - start
        w, y, y_model = weight[start:stop], image[start:stop], value[start:stop]
        for i_p in range(columns.shape[0]):
            p = columns[i_p]
            a = jacobian[p, start:stop]
            total = 0.0
            for i in range(n):
                row[i] = a[i] * w[i]
                total += row[i] * (y[i] - y_model[i])
            out[node, LOCAL, p] = total
            for i_q in range(i_p + 1):
                q = columns[i_q]
                b = jacobian[q, start:stop]
                total = 0.0
                for i in range(n):
                    total += row[i] * b[i]
                out[node, p, q] = total
    return out


@njit(cache=True)
def _assembled(blocks, share):  # type: ignore[no-untyped-def]
    """(N (8 + 3k, 8 + 3k), upper triangle, g): the sum of the sectors' blocks, each times its `share` (k,)."""
    k = blocks.shape[0]
    size = FIRST_NODE + 3 * k
    N, g = np.zeros((size, size)), np.zeros(size)
    place = np.empty(LOCAL, np.int64)
    for node in range(k):
        for p in range(LOCAL):
            place[p] = _place(p, node, k)
        for p in range(LOCAL):
            g[place[p]] += share[node] * blocks[node, LOCAL, p]
            for q in range(p + 1):
                i, j = min(place[p], place[q]), max(place[p], place[q])
                N[i, j] += share[node] * blocks[node, p, q]
    return N, g


@njit(cache=True)
def _place(p, node, k):  # type: ignore[no-untyped-def]
    """Where parameter p of a sector's Jacobian is among all parameters."""
    if p < FIRST_NODE:
        return p
    if p < FIRST_NODE + 3:
        return p + 3 * node
    return p - 3 + 3 * (node + 1 if node + 1 < k else 0)


@njit(cache=True, fastmath=True)
def _gradient(image, value, jacobian, first, weight, columns, high):  # type: ignore[no-untyped-def]
    """g alone, of the shells before `high`."""
    k = (first.shape[0] - 1) // SHELLS
    g = np.zeros(FIRST_NODE + 3 * k)
    for node in range(k):
        start, stop = first[node * SHELLS], first[node * SHELLS + high]
        for p in columns:
            total = 0.0
            for i in range(start, stop):
                total += jacobian[p, i] * (weight[i] * (image[i] - value[i]))
            g[_place(p, node, k)] += total
    return g


@njit(cache=True)
def _with_priors(N, g, active, shape, white, nodes, kappa, log_radius, white_prior, precisions):  # type: ignore[no-untyped-def]
    """Rows and columns `active` of N (upper triangle) and g, with the fields of Priors added."""
    precision, pull = np.zeros(g.shape[0]), np.zeros(g.shape[0])
    if math.isfinite(shape[KAPPA]):
        precision[KAPPA] = 1.0 / kappa**2
        pull[KAPPA] = precision[KAPPA] * (kappa - shape[KAPPA])
    precision[2] = log_radius[1] / shape[2] ** 2
    pull[2] = precision[2] * shape[2] * (log_radius[0] - math.log(shape[2]))
    precision[WHITE] = white_prior[1]
    pull[WHITE] = white_prior[1] * (white_prior[0] - white)
    level = 0.0
    for j in range(nodes.shape[0]):
        level += nodes[j, 0] / nodes.shape[0]
    for j in range(nodes.shape[0]):
        for c in range(3):
            i = FIRST_NODE + 3 * j + c
            precision[i] = precisions[3 * j + c]
            pull[i] = precision[i] * ((level if c == 0 else 0.0) - nodes[j, c])
    n = active.shape[0]
    part, right = np.zeros((n, n)), np.empty(n)
    for i in range(n):
        right[i] = g[active[i]] + pull[active[i]]
        row = N[active[i]]
        for j in range(i, n):
            part[i, j] = row[active[j]]
        part[i, i] += precision[active[i]]
    return part, right
