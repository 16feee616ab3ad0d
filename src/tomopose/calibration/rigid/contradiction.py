"""A stated or default standard deviation that the images contradict: the value is freed, and said to be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.model.parameters import MATTERS, FreeParameters, base_name
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.rigid.fit import Fit, minimise
from tomopose.units import Array

CONTRADICTED = 3.0
"""Prior standard deviations from which the images must pull a value away before it is a candidate."""

GAIN = 16.0
"""chi2 must fall by this much (4 sigma) when the prior is widened: 12 values may be tried."""

DETERMINED = 0.5
"""The images must know the value this many times better than the prior did."""

WIDE = 20.0
"""Times what matters of a value (`parameters.MATTERS`): the prior of a value that was freed."""

NOTHING_FITS = 1e5
"""chi2 for each equation beyond which nothing fits, and no single value is to blame."""

MOST = 3


@dataclass(frozen=True, kw_only=True)
class Contradicted:
    """name of a value;  stated: sigma that was assumed;  off: the estimate's distance from the assumed value."""

    name: str
    stated: float
    off: float


def contradicted(problem: Problem, free: FreeParameters, fit: Fit) -> tuple[FreeParameters, tuple[Contradicted, ...]]:
    """The freed parameters with wider priors where the images contradict them, the likeliest one after the other."""
    found: list[Contradicted] = []
    if fit.chi2 > NOTHING_FITS * 2 * len(problem):
        return free, ()
    for _ in range(MOST):
        candidates = pulled(free, fit.delta)
        tried: list[tuple[float, int, FreeParameters, Fit]] = []
        for j in candidates:
            wider = widened(free, j)
            other = minimise(problem, wider, fit, iterations=20)
            if np.isfinite(other.chi2) and _sigma(other)[j - len(free)] < DETERMINED * wider.sigma[j]:
                tried.append((other.chi2, j, wider, other))
        if not tried:
            break
        chi2, j, wider, other = min(tried, key=lambda t: t[0])
        if fit.chi2 - chi2 < GAIN:
            break
        found.append(Contradicted(name=free.names[j], stated=float(free.sigma[j]), off=float(other.delta[j])))
        free, fit = wider, other
    return free, tuple(found)


def pulled(free: FreeParameters, delta: Array) -> list[int]:
    """Which freed parameters lie beyond `CONTRADICTED` prior standard deviations, farthest first, six at most."""
    known = np.isfinite(free.sigma)
    pull = np.where(known, np.abs(delta) / np.where(known, free.sigma, 1.0), 0.0)
    return [int(j) for j in np.argsort(-pull) if pull[j] > CONTRADICTED][:6]


def widened(free: FreeParameters, j: int) -> FreeParameters:
    """The same with a prior of parameter j that hardly holds it."""
    sigma = np.array(free.sigma)
    sigma[j] = max(WIDE * MATTERS[base_name(free.names[j])], 10.0 * sigma[j])
    return replace(free, sigma=sigma)


def _sigma(fit: Fit) -> Array:
    from tomopose.calibration.model.covariance import inverse_information

    return np.asarray(np.sqrt(np.diag(inverse_information(fit.N))))


def as_stated(free: FreeParameters, against: tuple[Contradicted, ...]) -> FreeParameters:
    """The freed parameters with the priors that were stated or assumed before any was contradicted."""
    sigma = np.array(free.sigma)
    for c in against:
        sigma[free.names.index(c.name)] = c.stated
    return replace(free, sigma=sigma)
