"""The background of the whole ring before the fit: robust against hot pixels, and without dead rows and columns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.detection.rim_fit.approach import approached, near_ring, with_weak_priors
from tomopose.detection.rim_fit.state import RimFit, Unknowns
from tomopose.detection.rim_fit.steps import equal_weight, stepped, with_equal_weights
from tomopose.detection.rim_model.ring import whole_ring

BACKGROUND = Unknowns(curvature=False)
ROBUST_TURNS = 6
LARGEST_NORMAL = 9.0
"""Residual in robust standard deviations from which one is no noise: Cauchy weights begin at a third of it."""
ALIKE = 0.7
"""Mean residual, in the worst dead line's, from which another one goes with it."""


def on_whole_ring(fit: RimFit) -> RimFit:
    """From some of the pixels near the rim to all of the ring, with its background."""
    ring = whole_ring(fit.parameters.radius, fit.parameters.blur, fit.settings.ring)
    ring = replace(ring, inside=max(ring.inside, fit.ring.inside))
    fit = with_equal_weights(fit.with_pixels(ring))
    return _with_robust_background(fit if ring.nodes * 3 == fit.priors.nodes.size else with_weak_priors(fit))


def without_dead_lines(fit: RimFit) -> RimFit:
    """Leaves out rows and columns whose pixels on the ring mostly have gross residuals, and fits again without them.

    Pixel by pixel they would go too, but not on the rim, where a line's value may look like the ball's.  The worst go
    first, since they spoil the background for others.
    """
    for _ in range(fit.settings.fit.most_lines):
        good = _good_without_worst_lines(fit)
        if good is None:
            break
        fit = replace(fit, window=replace(fit.window, good=good))
        if fit.parameters.opaque:
            near = near_ring(fit.parameters.radius, fit.parameters.blur, fit.settings)
            fit = approached(fit.with_pixels(near))
        fit = on_whole_ring(fit)
    return fit


def away_from_rim(fit: RimFit) -> npt.NDArray[np.bool_]:
    """(n,) whether a pixel lies so far from the rim that its residual is not the edge's own."""
    return np.asarray(np.abs(fit.distance) > fit.settings.fit.rim_clear * max(fit.parameters.blur, 1.0))


def _with_robust_background(fit: RimFit) -> RimFit:
    """The background alone is fitted; dead lines and hot pixels, if there are any, get little weight (Cauchy)."""
    fit, _ = stepped(fit, BACKGROUND)
    away = away_from_rim(fit)
    for _ in range(ROBUST_TURNS):
        size = np.abs(fit.residual[away])
        contrast = abs(fit.parameters.level - fit.parameters.white)
        if size.size == 0 or size.max() < fit.settings.fit.gross * contrast:
            break
        scale = MAD_TO_SIGMA * float(np.median(size)) + 1e-9 * fit.spread
        if size.max() < LARGEST_NORMAL * scale:
            break
        x = np.where(away, fit.residual / (LARGEST_NORMAL / 3 * scale), 0.0)
        fit, _ = stepped(replace(fit, weight=equal_weight(fit) / (1.0 + x**2) ** 2), BACKGROUND)
    return fit


def _good_without_worst_lines(fit: RimFit) -> npt.NDArray[np.bool_] | None:
    """The window's good pixels without the worst dead lines; None where no good pixel is left."""
    settings, window = fit.settings.fit, fit.window
    away = away_from_rim(fit)
    size = np.abs(fit.residual)
    gross = away & (size > settings.gross * abs(fit.parameters.level - fit.parameters.white))
    if np.count_nonzero(gross) < settings.line:
        return None
    gross &= size > LARGEST_NORMAL * float(np.median(size[away]))
    found = []
    for index, axis in ((fit.pixels.v - window.origin[1], 0), (fit.pixels.u - window.origin[0], 1)):
        at, n = index.astype(np.int64), window.good.shape[axis]
        of, bad = np.bincount(at[away], minlength=n), np.bincount(at[gross], minlength=n)
        mean = np.bincount(at[gross], size[gross], minlength=n) / np.maximum(bad, 1)
        found += [(mean[i], axis, i) for i in np.flatnonzero((bad >= settings.line) & (bad > 0.5 * of))]
    if not found:
        return None
    good = window.good.copy()
    worst = max(found)[0]
    for mean_size, axis, i in found:
        if mean_size > ALIKE * worst:
            good[(i, slice(None)) if axis == 0 else (slice(None), i)] = False
    return good
