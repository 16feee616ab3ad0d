"""How far the background departs from a level: priors of its slope and curvature, estimated from the data themselves
(empirical Bayes)."""

from __future__ import annotations

import math

import numpy as np

from tomopose.detection.cholesky import solve
from tomopose.detection.rim_fit.noise import excess_variance
from tomopose.detection.rim_fit.normal_equations import Equations, equations, place_of, with_priors
from tomopose.detection.rim_fit.state import RimFit
from tomopose.detection.rim_fit.steps import stepped
from tomopose.detection.rim_model.rows import FIRST_NODE
from tomopose.units import Array

SLOPE, CURVATURE = 1, 2
"""Columns of the nodes."""


def with_widest_curvature(fit: RimFit) -> RimFit:
    """The weakest prior of curvature that keeps a background without data from running away."""
    return _with_precision(fit, CURVATURE, np.full(fit.ring.nodes, _widest(fit, CURVATURE)))


def with_background_priors(fit: RimFit) -> RimFit:
    """Priors of curvature and, on a ring that is narrow for its blur, of slope, each as wide as the data show; and a
    step with them."""
    of = equations(fit, fit.unknowns)
    narrow = fit.ring.outside < fit.settings.ring.slopes_from * fit.parameters.blur
    for column in (CURVATURE, SLOPE) if narrow else (CURVATURE,):
        fit = _with_precision(fit, column, _evident_precision(fit, of, column))
    if not fit.careful:
        return stepped(fit, fit.unknowns, of)[0]
    for _ in range(3):
        fit, _ = stepped(fit, fit.unknowns, careful=True)
    return fit


def _evident_precision(fit: RimFit, of: Equations, column: int) -> Array:
    """1 / tau_k^2 (k,), where most nodes share one small tau and few, at a holder's edges, have their own.

    With z_k the estimate of that coefficient without prior in its standard deviations, the share p_k of the evidence
    that node k is one of the few (a normal of variance 1 + bent against one of variance 1) weighs what z_k^2 shows
    above its noise; all nodes have in common what the others' mean square shows above what chance may do.
    """
    settings, k = fit.settings.fit, fit.ring.nodes
    N, g = with_priors(_with_precision(fit, column, np.zeros(k)), of, fit.unknowns)
    at = place_of(fit.unknowns, k, np.arange(FIRST_NODE + column, FIRST_NODE + 3 * k, 3))
    unit = np.zeros((len(g), k + 1))
    unit[at, np.arange(k)] = 1.0
    unit[:, -1] = g
    X = solve(N, unit)[at]
    V, value = X[np.arange(k), np.arange(k)], fit.parameters.nodes[:, column] + X[:, -1]
    z2 = np.where(V > 0, value**2 / np.where(V > 0, V, 1.0), 0.0)
    bent = settings.bent
    p = 1.0 / (1.0 + (1.0 / settings.few_bent - 1.0) * math.sqrt(1.0 + bent) * np.exp(-0.5 * z2 * bent / (1.0 + bent)))
    count = float(np.sum(1.0 - p))
    mean_square = excess_variance(float(np.sum((1.0 - p) * z2)) / max(count, 1.0), count, fit.settings.noise.rare)
    common = max(mean_square - 1.0, settings.least_curvature)
    own = p * np.maximum(z2 - 1.0, 0.0) * V
    smooth = (np.roll(own, 1) + 2 * own + np.roll(own, -1)) / 4
    precision = np.where(V > 0, 1.0 / np.maximum(smooth + common * V, 1e-300), 0.0)
    return np.maximum(precision, _widest(fit, column))


def _widest(fit: RimFit, column: int) -> float:
    """Precision of the weakest prior: no more change over the ring than `steepest` times its standard deviation."""
    return (fit.ring.outside**column / (fit.settings.fit.steepest * fit.spread)) ** 2


def _with_precision(fit: RimFit, column: int, precision: Array) -> RimFit:
    nodes = fit.priors.nodes.copy()
    nodes[column::3] = precision
    return fit.with_node_precision(nodes)
