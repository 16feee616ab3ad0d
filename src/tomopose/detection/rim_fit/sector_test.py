"""How far round the rim the background is to be believed: the fit held against one without its misfitting sectors.

Where a holder's edge is no smooth background, residuals of neighbouring pixels have one sign.  Their sums over cells
of a few pixels, the size over which an edge is felt, tell how many times the noise they amount to; a second fit gives
each sector so much less weight.  With D its centre less that of the first fit and V the difference of their
covariances, the first is unbiased if D ~ N(0, V); otherwise D ~ N(0, (1 + s) V).  Of the centre x given s,

    E x = x_first + s / (1 + s) D,    cov x = C_first + s / (1 + s) V,

and the data's own s is max(D' V^-1 D / 2 - 1, 0): the shrinkage of an estimate that may be biased and one that is not
(E. J. Green, W. E. Strawderman, J. Am. Stat. Assoc. 86 (1991) 1001).  Where every sector fits, nothing changes.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from tomopose.detection.rim_fit.cholesky import solve
from tomopose.detection.rim_fit.model import FIRST_NODE
from tomopose.detection.rim_fit.noise import evident
from tomopose.detection.rim_fit.rim import Rim
from tomopose.units import Array

CELL, PARTS = 3.0, 3
"""Height of a cell, px from the rim, and cells that share a sector's width of some 9 px."""
TRUSTED = 0.6
"""Where every sector keeps this share of its weight, there is no second fit."""
TURNS = 2
"""A sector that misfits spoils its neighbours: they are judged once more without it."""
NEGLIGIBLE = 0.02
"""Share of the first covariance, added to V, below which a D D' proves nothing."""


def rounder(rim: Rim, active: npt.NDArray[np.intp], doubt: Array, *, parameters: float, noise: float) -> Array:
    """Moves the rim's centre to the estimate above; (2, 2) to add to its covariance.

    doubt: (2, 2), in the first fit's covariance already.  parameters: linear ones that a sector's pixels determine.
    noise: variance of a sum of pixels over that of as many independent ones.
    """
    residual = rim.residual

    def kept(residual: Array) -> Array:
        """Share of its weight that these residuals leave each sector."""
        return np.asarray(trust(rim.rim[0], rim.left, rim.share, residual, rim.weight, rim.n_nodes, parameters, noise))

    share = kept(residual)
    if share.min() > TRUSTED:
        return np.zeros((2, 2))
    blocks = rim.all_blocks()
    unit, step = np.eye(active.size, 3), np.zeros(FIRST_NODE + 3 * rim.n_nodes)
    for turn in range(TURNS):
        if turn > 0:
            share = kept(residual - changes(rim.jacobian, rim.left, step, rim.n_nodes))
        N, unit[:, 2] = rim.with_priors(*rim.sum_of(blocks, share), active)
        X = solve(N, unit)
        step[active] = X[:, 2]
    first = solve(rim.normal(active)[0], unit[:, :2])[:2]
    D, V = X[:2, 2], noise * (X[:2, :2] - first) - doubt
    values, axes = np.linalg.eigh((V + V.T) / 2 + NEGLIGIBLE * noise * (first + first.T) / 2)
    V = (axes * np.maximum(values, NEGLIGIBLE * noise * values.max())) @ axes.T
    s = max(float(D @ np.linalg.solve(V, D)) / 2 - 1.0, 0.0)
    rim.shape = rim.shape.copy()
    rim.shape[:2] += s / (1.0 + s) * D
    return np.asarray(s / (1.0 + s) * V)


@njit(cache=True)
def trust(s, left, share, residual, weight, k, parameters, noise):  # type: ignore[no-untyped-def]
    """(k,) share of its weight that a sector keeps: 1 over its cells' mean square, where that is no chance.

    In units of what the quietest third of sectors have at the most, so that correlated noise is none's fault; no more
    than `noise`.
    """
    rings = 1 + int(np.max(s) / CELL)
    total, count = np.zeros((k, rings * PARTS)), np.zeros((k, rings * PARTS))
    for i in range(s.shape[0]):
        if s[i] > 0.0 and weight[i] > 0.0:
            cell = int(s[i] / CELL) * PARTS + min(int(share[i] * PARTS), PARTS - 1)
            total[left[i], cell] += residual[i] * math.sqrt(weight[i])
            count[left[i], cell] += 1.0
    freedom, square = np.full(k, -parameters), np.zeros(k)
    for j in range(k):
        for cell in range(rings * PARTS):
            if count[j, cell] > 1.0:
                square[j] += total[j, cell] ** 2 / count[j, cell]
                freedom[j] += 1.0
    enough = freedom > 2.0
    kept = np.ones(k)
    if not np.any(enough):
        return kept
    square /= np.maximum(freedom, 1.0)
    ordered = np.sort(square[enough])
    usual = min(max(1.0, float(ordered[ordered.shape[0] // 3])), noise)
    for j in range(k):
        if enough[j]:
            kept[j] = 1.0 / evident(square[j] / usual, freedom[j])
    return kept


@njit(cache=True)
def changes(jacobian, left, step, k):  # type: ignore[no-untyped-def]
    """(n,) change of the model with a step (8 + 3k,) of all parameters, to first order."""
    out = np.zeros(left.shape[0])
    for p in range(FIRST_NODE):
        if step[p] != 0.0:
            for i in range(left.shape[0]):
                out[i] += jacobian[p, i] * step[p]
    for i in range(left.shape[0]):
        node = left[i]
        right = node + 1 if node + 1 < k else 0
        for p in range(3):
            out[i] += jacobian[FIRST_NODE + p, i] * step[FIRST_NODE + 3 * node + p]
            out[i] += jacobian[FIRST_NODE + 3 + p, i] * step[FIRST_NODE + 3 * right + p]
    return out
