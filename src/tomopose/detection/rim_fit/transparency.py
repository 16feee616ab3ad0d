"""Balls that X-rays pass: whether this is one, and its attenuation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tomopose.detection.order_statistics import median
from tomopose.detection.rim_fit.state import Parameters, RimFit, Unknowns
from tomopose.detection.rim_fit.steps import stepped, with_equal_weights
from tomopose.detection.rim_model.ring import annulus_pixels
from tomopose.kernel_cache import njit
from tomopose.units import Array

FEWEST = 5
"""Pixels whose median is worth a comparison."""
SIZE_STEPS, FINAL_STEPS = 4, 10
INWARDS, DEEPEST = 0.12, 10.0
"""Share of the radius that the ring reaches inwards, and its most, px: where the chord is well below the diameter."""


def is_transparent(fit: RimFit) -> bool:
    """Whether the ball grows darker towards its middle by more than noise and 1 % of its contrast.

    True as well where the blur is so wide that little of the middle is left to decide by.
    """
    p, settings = fit.parameters, fit.settings.fit
    depth, radius = 3 * p.blur + 0.5, p.radius
    if radius - depth < 2.0 or p.blur > settings.open_from * radius:
        return True
    rings = ((radius - depth - 0.08 * radius - 1.0, radius - depth), (0.0, max(0.6 * (radius - depth), 1.5)))
    middle = []
    for low, high in rings:
        every = 1 + 2 * int(math.pi * (high**2 - low**2) / (2 * fit.settings.ring.enough_pixels))
        values = annulus_pixels(fit.window, p.shape, low, high, every)
        if values.size < FEWEST:
            return False
        middle.append(_middle_value(values))
    (near, u_near), (deep, u_deep) = middle
    least = max(settings.transparent * abs(p.level - deep), settings.transparent_sigma * math.hypot(u_near, u_deep))
    return bool(abs(near - deep) > least)


def with_attenuation(fit: RimFit, start: Array) -> RimFit:
    """The ring widened inwards, and the best of several fits that begin with another total attenuation each.

    start: shape (7,) that they begin with; its blur is replaced by the one found so far.
    """
    blur = max(float(start[3]), fit.parameters.blur)
    start = np.array([*start[:3], blur, *start[4:]])
    radius = float(start[2])
    inside = min(max(INWARDS * radius, 3 * blur + 3.0), max(DEEPEST, 4 * blur), radius - 0.5)
    fit = replace(fit, parameters=fit.parameters._replace(shape=start))
    fit = with_equal_weights(fit.with_pixels(replace(fit.ring, inside=inside)))
    best = min((_from_attenuation(fit, start, kappa) for kappa in fit.settings.fit.kappa_starts), key=lambda f: f.cost)
    return replace(best, careful=True, unknowns=Unknowns(("u", "v", "radius", "sigma", "kappa")))


def with_attenuation_fitted(fit: RimFit) -> RimFit:
    """The attenuation fitted too, on the whole ring."""
    unknowns = fit.unknowns._replace(curvature=False)
    for _ in range(FINAL_STEPS):
        fit, moved = stepped(fit, unknowns, careful=True)
        if moved < 1e-3:
            break
    return fit


def _from_attenuation(fit: RimFit, start: Array, kappa: float) -> RimFit:
    shape = start.copy()
    shape[4] = kappa
    start_here = Parameters(shape, np.zeros_like(fit.parameters.nodes), 0.0)
    fit = replace(fit, priors=fit.priors._replace(kappa=kappa)).at(start_here)
    fit, _ = stepped(fit, Unknowns(curvature=False))
    for _ in range(SIZE_STEPS):
        fit, _ = stepped(fit, Unknowns(("u", "v", "radius", "sigma"), curvature=False), careful=True)
    return fit


@njit(cache=True)
def _middle_value(values):  # type: ignore[no-untyped-def]
    """Median of the values, and its standard deviation."""
    middle = median(values.copy())
    return middle, 1.8 * median(np.abs(values - middle)) / math.sqrt(values.shape[0])
