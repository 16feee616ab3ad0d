"""Normal equations of the fit: N = J' W J and g = J' W (image - model), sums over sectors of small blocks.

A sector's pixels see the shape, w and the two nodes at its sides: 14 parameters, whatever the number of nodes.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numba import njit

from tomopose.detection.rim_fit.state import Indices, RimFit, Unknowns, active_parameters, jacobian_rows
from tomopose.detection.rim_model.ring import SHELLS
from tomopose.detection.rim_model.rows import FIRST_NODE, KAPPA, LOCAL, WHITE
from tomopose.units import Array

LOWER = np.tril_indices(LOCAL)
"""Of a sector's block: its lower triangle."""


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
    p, priors, shape = fit.parameters, fit.priors, fit.parameters.shape
    precision, pull = np.zeros(len(of.g)), np.zeros(len(of.g))
    if math.isfinite(shape[KAPPA]):
        precision[KAPPA] = 1.0 / priors.kappa**2
        pull[KAPPA] = precision[KAPPA] * (priors.kappa - shape[KAPPA])
    precision[2] = priors.log_radius[1] / shape[2] ** 2
    pull[2] = precision[2] * shape[2] * (priors.log_radius[0] - math.log(shape[2]))
    precision[WHITE] = priors.white[1]
    pull[WHITE] = priors.white[1] * (priors.white[0] - p.white)
    precision[FIRST_NODE:] = priors.nodes
    off = -p.nodes
    off[:, 0] += p.nodes[:, 0].mean()
    pull[FIRST_NODE:] = priors.nodes * off.ravel()
    active = active_parameters(unknowns, len(p.nodes))
    part = of.N[active[:, None], active]
    part[np.diag_indices(len(active))] += precision[active]
    return part, (of.g + pull)[active]


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


def _assembled(blocks: Array, share: Array) -> tuple[Array, Array]:
    """(N (8 + 3k, 8 + 3k), upper triangle, g): the sum of the sectors' blocks, each times its `share` (k,)."""
    place, pairs, size = _places(len(blocks))
    weighted = blocks * share[:, None, None]
    N = np.bincount(pairs, weighted[:, LOWER[0], LOWER[1]].ravel(), size * size)
    g = np.bincount(place, weighted[:, LOCAL].ravel(), size)
    return np.asarray(N, np.float64).reshape(size, size), np.asarray(g, np.float64)


@functools.lru_cache(maxsize=8)
def _places(k: int) -> tuple[Indices, Indices, int]:
    """(where the sectors' parameters are among all, where the pairs of LOWER are in N, number of all parameters)."""
    node, size = FIRST_NODE + 3 * np.arange(k)[:, None] + np.arange(3), FIRST_NODE + 3 * k
    shared = np.tile(np.arange(FIRST_NODE), (k, 1))
    place = np.concatenate([shared, node, np.roll(node, -1, axis=0)], axis=1)
    p, q = place[:, LOWER[0]], place[:, LOWER[1]]
    return place.ravel(), (np.minimum(p, q) * size + np.maximum(p, q)).ravel(), size


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
