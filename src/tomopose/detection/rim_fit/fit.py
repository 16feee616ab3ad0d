r"""Maximum-likelihood fit of a radiograph around the ball's rim (model: rim_model).

Gauss-Newton on the shape (centre, radius, blur) and the linear background at once, which is variable projection: the
Schur complement of the background's block is the projected normal matrix.  The background's curvature has a prior
whose width is estimated sector by sector from the data themselves (empirical Bayes): none where the background is
smooth, so that little information is given away, and a wide one where a holder's wall runs along the rim.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.detection.cholesky import solve
from tomopose.detection.rim_fit.approach import approached, first_fit
from tomopose.detection.rim_fit.background import on_whole_ring, without_dead_lines
from tomopose.detection.rim_fit.background_priors import with_background_priors, with_widest_curvature
from tomopose.detection.rim_fit.covariance import ConeFit, cone_fit
from tomopose.detection.rim_fit.noise import weighted, with_noise_correlation
from tomopose.detection.rim_fit.normal_equations import Equations, equations, place_of, with_priors
from tomopose.detection.rim_fit.ring_size_test import select_ring_size
from tomopose.detection.rim_fit.sector_test import downweight_misfitting_sectors
from tomopose.detection.rim_fit.state import Anisotropy, RimFit
from tomopose.detection.rim_fit.steps import polished, stepped
from tomopose.detection.rim_fit.transparency import is_transparent, with_attenuation, with_attenuation_fitted
from tomopose.detection.rim_model.ring import BallWindow
from tomopose.detection.rim_model.rows import SHAPE
from tomopose.detection.settings import DEFAULT, DetectionSettings
from tomopose.units import Array

FIRST, FINAL = 2.0, 2.5
"""Linear parameters that a sector's pixels determine: level and slope, and later half of a curvature."""
STEPS = 3


def fit_cone(
    window: BallWindow, x_D: Array, radius: float, *, expected: float, blur: float = 0.0, quantum: float = 0.0,
    settings: DetectionSettings = DEFAULT,
) -> ConeFit:  # fmt: skip
    """Fits the ball whose rim lies within 2 px or so of a circle.

    Parameters
    ----------
    window:    the part of the radiograph that holds the ball and its surroundings.
    x_D, radius:  where the rim about is, px; blur: about how wide its edge is, px.
    expected:  nominal radius, px: counts only where the blur leaves the radius open.
    quantum:   step of the image's values (1 for counts, 0 for floats): no noise is smaller than quantum / sqrt(12).

    Raises
    ------
    BallNotFoundError  where no ball can be fitted there.
    """
    start = first_fit(window, x_D, radius, blur, expected=expected, quantum=quantum, settings=settings)
    fit = approached(start)
    if is_transparent(fit):
        fit = with_attenuation(fit, start.parameters.shape)
    fit = without_dead_lines(on_whole_ring(fit))
    if fit.careful:
        fit = with_widest_curvature(weighted(with_attenuation_fitted(fit), FIRST))
        for _ in range(STEPS):
            fit, _ = stepped(fit, fit.unknowns, careful=True)
    fit = with_background_priors(weighted(fit, FIRST))
    fit = with_noise_correlation(polished_with_weights(fit))
    fit, of = select_ring_size(fit, fit.unknowns.and_also("q_cos", "q_sin"))
    fit = downweight_misfitting_sectors(fit, of, parameters=FINAL)
    return cone_fit(*with_anisotropy(fit, of))


def polished_with_weights(fit: RimFit) -> RimFit:
    """The optimum with the noise that the curved background leaves."""
    return polished(weighted(fit, FINAL))


def with_anisotropy(fit: RimFit, of: Equations) -> tuple[RimFit, Equations]:
    """The blur's dependence on direction, by one step; it is fitted where it is significant.  And the equations."""
    unknowns = fit.unknowns.and_also("q_cos", "q_sin")
    N, g = with_priors(fit, of, unknowns)
    at = place_of(unknowns, fit.ring.nodes, np.array([SHAPE.index(q) for q in ("q_cos", "q_sin")]))
    right = np.zeros((len(g), 3))
    right[at, [0, 1]] = 1.0
    right[:, 2] = g
    X = solve(N, right)[at]
    found = Anisotropy(X[:, 2].copy(), X[:, :2].copy())
    settings = fit.settings.fit
    significance = float(found.value @ np.linalg.solve(found.covariance, found.value))
    if significance < settings.moved or np.hypot(*found.value) < settings.anisotropic * fit.parameters.blur**2:
        return replace(fit, anisotropy=found), of
    fit = replace(fit, unknowns=unknowns)
    for _ in range(STEPS):
        fit, _ = stepped(fit, unknowns)
    fit = replace(fit, anisotropy=found._replace(value=fit.parameters.shape[5:7].copy()))
    return fit, equations(fit, unknowns)
