"""How far round the rim the background's model holds: the fit compared with one without its misfitting sectors.

Where a holder's edge is no smooth background, residuals of neighbouring pixels have one sign.  Their sums over cells
of a few pixels, the size over which an edge is felt, show how many times the noise they amount to; a second fit gives
each sector so much less weight.  With D its centre less that of the first fit and V the difference of their
covariances, the first is unbiased if D ~ N(0, V); otherwise D ~ N(0, (1 + s) V).  Of the centre x given s,

    E x = x_first + s / (1 + s) D,    cov x = C_first + s / (1 + s) V,

and the data's own s is max(D' V^-1 D / 2 - 1, 0): the shrinkage of an estimate that may be biased and one that is not
(E. J. Green, W. E. Strawderman, J. Am. Stat. Assoc. 86 (1991) 1001).  Chance makes that positive in 37 % of images, so
it counts by the probability that it shows more than noise (`excess_variance`).  Where every sector fits, nothing
changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.detection.cholesky import solve
from tomopose.detection.order_statistics import select
from tomopose.detection.rim_fit.noise import excess_variance
from tomopose.detection.rim_fit.normal_equations import Equations, summed, with_priors
from tomopose.detection.rim_fit.state import RimFit, active_parameters
from tomopose.detection.rim_model.rows import FIRST_NODE
from tomopose.kernel_cache import njit
from tomopose.units import Array


def downweight_misfitting_sectors(fit: RimFit, of: Equations, *, parameters: float) -> RimFit:
    """The fit with its centre at the estimate above, and what that adds to its doubt.

    of: the fit's equations.  parameters: linear ones that a sector's pixels determine.
    """
    settings, noise, doubt, residual = fit.settings.sector_test, fit.noise.sum_variance, fit.doubt, fit.residual
    share = _kept_weight(fit, residual, parameters)
    if share.min() > settings.trusted:
        return fit
    active = active_parameters(fit.unknowns, fit.ring.nodes)
    unit, step = np.eye(active.size, 3), np.zeros(FIRST_NODE + 3 * fit.ring.nodes)
    for turn in range(settings.turns):
        if turn > 0:
            change = model_change(fit.jacobian, fit.pixels.sector, step, fit.ring.nodes)
            share = _kept_weight(fit, residual - change, parameters)
        N, unit[:, 2] = with_priors(fit, summed(of.blocks, share), fit.unknowns)
        X = solve(N, unit)
        step[active] = X[:, 2]
    first = solve(with_priors(fit, of, fit.unknowns)[0], unit[:, :2])[:2]
    D, V = X[:2, 2], noise * (X[:2, :2] - first) - doubt
    values, axes = np.linalg.eigh((V + V.T) / 2 + settings.negligible * noise * (first + first.T) / 2)
    V = (axes * np.maximum(values, settings.negligible * noise * values.max())) @ axes.T
    s = excess_variance(float(D @ np.linalg.solve(V, D)) / 2, 2.0, fit.settings.noise.rare) - 1.0
    shape = fit.parameters.shape.copy()
    shape[:2] += s / (1.0 + s) * D
    return replace(fit, parameters=fit.parameters._replace(shape=shape), doubt=doubt + s / (1.0 + s) * V)


def _kept_weight(fit: RimFit, residual: Array, parameters: float) -> Array:
    """(k,) share of its weight that these residuals leave each sector."""
    settings, pixels = fit.settings.sector_test, fit.pixels
    cell = settings.cell * max(fit.ring.blur / fit.settings.ring.sharp, 1.0)
    return np.asarray(
        kept_weight(
            fit.distance, pixels.sector, pixels.share, residual * np.sqrt(fit.weight), fit.ring.nodes,
            (cell, settings.parts, fit.settings.noise.rare), parameters, fit.noise.sum_variance,
        )
    )  # fmt: skip


@njit(cache=True)
def kept_weight(s, sector, share, normalised, k, cells, parameters, noise):  # type: ignore[no-untyped-def]
    """(k,) share of its weight that a sector keeps: 1 over its cells' mean square, where chance does not explain it.

    normalised: residuals in standard deviations, 0 for a pixel that is left out.  cells: their height, their number
    across a sector, and the prior share of excess_variance.  In units of what the quietest third of sectors have at the
    most, so that correlated noise is not a sector's fault; no more than `noise`.
    """
    height, parts, rare = cells
    farthest = 0.0
    for i in range(s.shape[0]):
        farthest = max(farthest, s[i])
    rings = 1 + int(farthest / height)
    total, count = np.zeros((k, rings * parts)), np.zeros((k, rings * parts))
    for i in range(s.shape[0]):
        if s[i] > 0.0 and normalised[i] != 0.0:
            cell = int(s[i] / height) * parts + min(int(share[i] * parts), parts - 1)
            total[sector[i], cell] += normalised[i]
            count[sector[i], cell] += 1.0
    freedom, square, ordered, kept, m = np.empty(k), np.empty(k), np.empty(k), np.ones(k), 0
    for j in range(k):
        freedom[j], square[j] = -parameters, 0.0
        for cell in range(rings * parts):
            if count[j, cell] > 1.0:
                square[j] += total[j, cell] ** 2 / count[j, cell]
                freedom[j] += 1.0
        square[j] /= max(freedom[j], 1.0)
        if freedom[j] > 2.0:
            ordered[m] = square[j]
            m += 1
    if m == 0:
        return kept
    usual = min(max(1.0, select(ordered[:m], m // 3)), noise)
    for j in range(k):
        if freedom[j] > 2.0:
            kept[j] = 1.0 / excess_variance(square[j] / usual, freedom[j], rare)
    return kept


@njit(cache=True)
def model_change(jacobian, sector, step, k):  # type: ignore[no-untyped-def]
    """(n,) change of the model with a step (8 + 3k,) of all parameters, to first order."""
    out = np.zeros(sector.shape[0])
    for p in range(FIRST_NODE):
        if step[p] != 0.0:
            for i in range(sector.shape[0]):
                out[i] += jacobian[p, i] * step[p]
    for i in range(sector.shape[0]):
        node = sector[i]
        right = node + 1 if node + 1 < k else 0
        for p in range(3):
            out[i] += jacobian[FIRST_NODE + p, i] * step[FIRST_NODE + 3 * node + p]
            out[i] += jacobian[FIRST_NODE + 3 + p, i] * step[FIRST_NODE + 3 * right + p]
    return out
