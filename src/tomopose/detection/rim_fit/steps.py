"""Gauss-Newton steps of the rim's fit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tomopose.detection.cholesky import solve
from tomopose.detection.rim_fit.normal_equations import Equations, equations, with_gradient, with_priors
from tomopose.detection.rim_fit.state import Parameters, RimFit, Unknowns, active_parameters
from tomopose.detection.rim_model.rows import FIRST_NODE, KAPPA, N_SHAPE, WHITE
from tomopose.detection.settings import FitSettings
from tomopose.errors import BallNotFoundError
from tomopose.units import Array

CONVERGED, STILL = 1e-4, 1e-3
"""Move of centre and radius, px, below which a fit has converged, and below which a step is not shortened any more:
both far below the centre's standard deviation, 0.0003 px at best."""
POLISHING, CAREFUL_POLISHING = 4, 3
"""Steps to the optimum: with one normal matrix, and with a new one for each."""


def stepped(
    fit: RimFit, unknowns: Unknowns, of: Equations | None = None, *, careful: bool = False
) -> tuple[RimFit, float]:
    """The fit after one step, shortened while it raises the cost if `careful`; and its largest move, px, of centre and
    radius."""
    N, g = with_priors(fit, equations(fit, unknowns) if of is None else of, unknowns)
    full = np.zeros(FIRST_NODE + 3 * len(fit.parameters.nodes))
    full[active_parameters(unknowns, len(fit.parameters.nodes))] = solve(N, g.reshape(-1, 1))[:, 0]
    if not math.isfinite(full.sum()):
        raise BallNotFoundError("the rim does not determine a ball (no finite step)")
    largest, limits = float(np.abs(full[:3]).max()), fit.settings.fit
    if largest > limits.largest_step:
        full[:N_SHAPE] *= limits.largest_step / largest
    moved = _moved(fit, full)
    cost = fit.cost if careful else 0.0
    while careful and moved.cost > cost and np.abs(full[:3]).max() > STILL:
        full = full / 3
        moved = _moved(fit, full)
    return moved, largest


def polished(fit: RimFit) -> RimFit:
    """The fit at the optimum near by, by one normal matrix; by a new one for each step if it is to be careful."""
    unknowns = fit.unknowns
    of = equations(fit, unknowns)
    for _ in range(CAREFUL_POLISHING if fit.careful else POLISHING):
        fit, move = stepped(fit, unknowns, of, careful=fit.careful)
        if move < CONVERGED:
            break
        of = equations(fit, unknowns) if fit.careful else with_gradient(fit, unknowns, of)
    return fit


def with_equal_weights(fit: RimFit) -> RimFit:
    """All pixels weigh the same, as if noise were 3 % of the ring's spread."""
    return replace(fit, weight=np.full(fit.pixels.u.size, equal_weight(fit)))


def equal_weight(fit: RimFit) -> float:
    return 1.0 / (0.03 * fit.spread) ** 2


def _moved(fit: RimFit, full: Array) -> RimFit:
    p = fit.parameters
    shape = _within_bounds(p.shape, p.shape + full[:N_SHAPE], fit.settings.fit)
    moved = Parameters(shape, p.nodes + full[FIRST_NODE:].reshape(-1, 3), float(p.white + full[WHITE]))
    u, v, radius = full[:3].tolist()
    return fit.at(moved, (u, v, radius))


def _within_bounds(before: Array, shape: Array, limits: FitSettings) -> Array:
    """Blur and attenuation no more than doubled or halved, and within their limits."""
    sigma, kappa, radius = float(before[3]), float(before[KAPPA]), float(shape[2])
    shape[3] = min(max(float(shape[3]), limits.least_blur, sigma / 2), sigma * 2, limits.most_blur * radius)
    if math.isfinite(kappa):
        shape[KAPPA] = min(max(float(shape[KAPPA]), kappa / 2, 0.1), kappa * 2, 20.0)
    return shape
