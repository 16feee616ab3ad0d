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
from tomopose.detection.rim_fit.noise import excess_variance
from tomopose.detection.rim_fit.normal_equations import Equations, summed, with_priors
from tomopose.detection.rim_fit.state import RimFit, active_parameters
from tomopose.detection.rim_model.rows import FIRST_NODE
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
    return kept_weight(
        fit.distance, pixels.sector, pixels.share, residual * np.sqrt(fit.weight), fit.ring.nodes,
        (cell, settings.parts, fit.settings.noise.rare), parameters, fit.noise.sum_variance,
    )  # fmt: skip


def kept_weight(
    s: Array, sector: Array, share: Array, normalised: Array, k: int, cells: tuple[float, int, float],
    parameters: float, noise: float,
) -> Array:  # fmt: skip
    """(k,) share of its weight that a sector keeps: 1 over its cells' mean square, where chance does not explain it.

    normalised: residuals in standard deviations, 0 for a pixel that is left out.  cells: their height, their number
    across a sector, and the prior share of excess_variance.  In units of what the quietest third of sectors have at the
    most, so that correlated noise is not a sector's fault; no more than `noise`.
    """
    height, parts, rare = cells
    used = np.flatnonzero((s > 0.0) & (normalised != 0.0))
    cells_each = (1 + int(s.max(initial=0.0) / height)) * parts
    cell = (s[used] / height).astype(np.int64) * parts + np.minimum((share[used] * parts).astype(np.int64), parts - 1)
    place = sector[used] * cells_each + cell
    total = np.bincount(place, normalised[used], k * cells_each).reshape(k, cells_each)
    count = np.bincount(place, minlength=k * cells_each).reshape(k, cells_each)
    several = count > 1
    freedom = several.sum(axis=1) - parameters
    square = np.where(several, total**2 / np.maximum(count, 1), 0.0).sum(axis=1) / np.maximum(freedom, 1.0)
    enough, kept = np.flatnonzero(freedom > 2.0), np.ones(k)
    if enough.size > 0:
        usual = min(max(1.0, float(np.partition(square[enough], enough.size // 3)[enough.size // 3])), noise)
        for j in enough.tolist():
            kept[j] = 1.0 / excess_variance(float(square[j]) / usual, float(freedom[j]), rare)
    return kept


def model_change(jacobian: Array, sector: Array, step: Array, k: int) -> Array:
    """(n,) change of the model with a step (8 + 3k,) of all parameters, to first order."""
    out = np.zeros(len(sector))
    for p in np.flatnonzero(step[:FIRST_NODE]).tolist():
        out += jacobian[p] * step[p]
    nodes = step[FIRST_NODE:].reshape(k, 3)
    for p in range(3):
        out += jacobian[FIRST_NODE + p] * nodes[sector, p]
        out += jacobian[FIRST_NODE + 3 + p] * nodes[(sector + 1) % k, p]
    return out
