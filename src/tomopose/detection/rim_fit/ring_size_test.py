"""How far out the background's model holds: the fit compared with fits on smaller rings.

A background of level, slope and curvature is an approximation that gets worse with distance, while every shell of
pixels makes the centre more certain.  Of two rings, one in the other, the larger gives the centre with covariance C,
the smaller with C', and if the model holds on both, their difference D has the covariance C' - C (J. A. Hausman,
Econometrica 46 (1978) 1251).  Where D is larger, the smaller ring is taken.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.detection.cholesky import solve
from tomopose.detection.rim_fit.normal_equations import Equations, equations, shell_blocks, summed, with_priors
from tomopose.detection.rim_fit.state import RimFit, Unknowns, active_parameters
from tomopose.detection.rim_fit.steps import polished
from tomopose.units import Array


def select_ring_size(fit: RimFit, unknowns: Unknowns) -> tuple[RimFit, Equations]:
    """The fit on the largest ring that agrees with those inside it, its doubt added; and its equations.

    unknowns: what the equations are to hold.
    """
    sizes = fit.ring.sizes
    if len(sizes) == 1:
        return fit, equations(fit, unknowns)
    blocks = shell_blocks(fit, unknowns, 0, 1)
    steps, covariances = [], []
    unit = np.eye(active_parameters(fit.unknowns, fit.ring.nodes).size, 3)
    for n in sizes:
        if n > 1:
            blocks = blocks + shell_blocks(fit, unknowns, n - 1, n)
        N, unit[:, 2] = with_priors(fit, summed(blocks), fit.unknowns)
        X = solve(N, unit)
        steps.append(X[:2, 2])
        covariances.append((X[:2, :2] + X[:2, :2].T) / 2)
    settings, chosen = fit.settings.ring_test, len(sizes) - 1
    while chosen > 0:
        D = np.array(steps[:chosen]) - steps[chosen]
        C = np.array(covariances[:chosen]) - covariances[chosen]
        if max(_chi2(*pair) for pair in zip(D, C, strict=True)) < settings.implausible * fit.noise.sum_variance:
            break
        chosen -= 1
    if chosen == len(sizes) - 1:
        return fit, summed(blocks)
    smaller = polished(_with_shells(fit, sizes[chosen]))
    move = steps[chosen] - steps[chosen + 1]
    smaller = replace(smaller, doubt=fit.doubt + settings.remaining * np.outer(move, move))
    return smaller, equations(smaller, unknowns)


def _with_shells(fit: RimFit, n: int) -> RimFit:
    """The pixels beyond the first n shells without weight."""
    return replace(fit, shells=n, weight=np.where(fit.distance < fit.ring.edges[n - 1], fit.weight, 0.0))


def _chi2(D: Array, C: Array) -> float:
    """Of D (2,) with covariance C, by its degrees of freedom; 0 where C is not positive."""
    (x, y), ((xx, xy), (_, yy)) = D.tolist(), C.tolist()
    determinant = xx * yy - xy * xy
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant / 2 if xx > 0 and determinant > 0 else 0.0
