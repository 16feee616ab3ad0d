"""From the finder's circle to the neighbourhood of the optimum."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.detection.order_statistics import median
from tomopose.detection.rim_fit.state import Anisotropy, Noise, Parameters, Priors, RimFit, Unknowns
from tomopose.detection.rim_fit.steps import equal_weight, stepped, with_equal_weights
from tomopose.detection.rim_model.ring import SHELLS, BallWindow, Ring, taken_pixels, whole_ring
from tomopose.detection.settings import DetectionSettings
from tomopose.errors import BallNotFoundError
from tomopose.kernel_cache import njit
from tomopose.units import Array

TURNS, NEAR_ENOUGH = 14, 0.02
"""Steps at the most, and the move, px, that ends them: what follows takes the fit to its optimum."""
GATHER_AFTER = (1, 3, 6, 9)
"""Steps after which the ring's pixels are taken anew, while it still moves."""
WIDENINGS = 3
"""Times that the ring is made anew for a larger blur: each step can double it."""
NEAR_RIM = 6.0
"""Width outside the rim, px, that the approach looks at."""


def first_fit(
    window: BallWindow, x_D: Array, radius: float, blur: float, *, expected: float, quantum: float,
    settings: DetectionSettings,
) -> RimFit:  # fmt: skip
    """The circle that the finder gives, with some of the pixels near it; BallNotFoundError in a constant image."""
    blur = min(max(blur, settings.fit.start_blur), settings.fit.most_blur * radius)
    ring = near_ring(radius, blur, settings)
    shape = np.array([x_D[0], x_D[1], radius, blur, np.inf, 0.0, 0.0])
    pixels = taken_pixels(window, ring, shape, settings.ring)
    spread = float(np.std(pixels.value))
    if not spread > 0:
        raise BallNotFoundError(f"the image is constant around ({x_D[0]:.1f}, {x_D[1]:.1f})")
    n = pixels.u.size
    fit = RimFit(
        window=window, ring=ring, pixels=pixels, expected=expected, distance=pixels.rim[0],
        parameters=Parameters(shape, np.zeros((ring.nodes, 3)), 0.0), model=np.zeros(n), jacobian=np.zeros((0, n)),
        weight=np.ones(n), shells=SHELLS, priors=Priors(1.0, (0.0, 0.0), (0.0, 0.0), np.zeros(3 * ring.nodes)),
        unknowns=Unknowns(("u", "v", "radius", "sigma")), careful=False, floor=quantum**2 / 12 + (1e-5 * spread) ** 2,
        spread=spread, noise=Noise(0.0, 0.0, np.zeros(ring.nodes), 1.0, np.ones((1, 1)), False),
        doubt=np.zeros((2, 2)), anisotropy=Anisotropy(np.zeros(2), np.eye(2)), settings=settings,
    )  # fmt: skip
    return fit.at(fit.parameters, (0.0, 0.0, 0.0))


def near_ring(radius: float, blur: float, settings: DetectionSettings) -> Ring:
    """The ring near the rim alone, so many pixels taken as lead there quickly."""
    ring = whole_ring(radius, blur, settings.ring)
    outside = min(ring.outside, NEAR_RIM * max(blur / settings.ring.sharp, 1.0))
    pixels, enough = 2 * math.pi * radius * (ring.inside + outside), settings.ring.enough_pixels
    return replace(ring, outside=outside, every=5 if pixels > 5 * enough else 3 if pixels > 3 * enough else 1)


def approached(fit: RimFit) -> RimFit:
    """Near the optimum, without curvature and with equal weights; the ring is as wide as the blur needs."""
    fit = _on_this_ring(fit)
    for _ in range(WIDENINGS):
        wider = fit.settings.fit.wider_ring
        ring = near_ring(fit.parameters.radius, fit.parameters.blur, fit.settings)
        if not (ring.outside > wider * fit.ring.outside or ring.outside * wider < fit.ring.outside):
            break
        fit = _on_this_ring(fit.with_pixels(ring))
    return fit


def with_weak_priors(fit: RimFit) -> RimFit:
    """Priors that keep a background without data from running away; a radius that the blur leaves open gets its own."""
    k, settings = fit.ring.nodes, fit.settings.fit
    radius, blur, largest = fit.parameters.radius, fit.parameters.blur, settings.steepest * fit.spread
    width = whole_ring(radius, blur, fit.settings.ring).outside
    nodes = np.zeros((k, 3))
    nodes[:, 0], nodes[:, 1] = 1 / largest**2, (width / largest) ** 2
    blurred = blur > settings.size_from * radius
    size = 1 / settings.size_prior**2 if blurred else 0.0
    priors = fit.priors._replace(
        nodes=nodes.ravel(), white=(float(np.mean(fit.pixels.value)), 1 / largest**2),
        log_radius=(math.log(fit.expected), size),
    )  # fmt: skip
    return replace(fit, priors=priors)


def _on_this_ring(fit: RimFit) -> RimFit:
    fit = with_weak_priors(with_equal_weights(fit))
    fit, _ = stepped(fit, Unknowns(curvature=False))
    for turn in range(TURNS):
        names = ("u", "v", "radius", *(("sigma",) if turn else ()))
        fit, moved = stepped(fit, Unknowns(names, curvature=False))
        if moved < NEAR_ENOUGH and turn > 1:
            break
        if turn in GATHER_AFTER and moved > NEAR_ENOUGH:
            fit = fit.with_pixels(fit.ring)
        clear = fit.settings.fit.rim_clear * max(fit.parameters.blur, 1.0) + 2 * moved
        fit = replace(
            fit,
            weight=_without_outliers(
                fit.distance, fit.pixels.value, fit.model, clear, 0.1 * fit.spread, equal_weight(fit)
            ),
        )
    return fit


@njit(cache=True)
def _without_outliers(s, image, value, clear, least, weight):  # type: ignore[no-untyped-def]
    """(n,) the same weight for all pixels but those farther than `clear` from the rim that are outliers, by `least` at
    least and 8 standard deviations."""
    size, m = np.empty(s.shape[0]), 0
    for i in range(s.shape[0]):
        if abs(s[i]) > clear:
            size[m] = abs(image[i] - value[i])
            m += 1
    most = max(8 * MAD_TO_SIGMA * median(size[:m]), least) if m > 0 else np.inf
    out = np.empty(s.shape[0])
    for i in range(s.shape[0]):
        out[i] = 0.0 if abs(s[i]) > clear and abs(image[i] - value[i]) > most else weight
    return out
