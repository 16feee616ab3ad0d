"""What a finished fit says: the shape's covariance, with correlated noise, misfit and doubt in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tomopose.detection.cholesky import solve
from tomopose.detection.rim_fit.noise import excess_variance, noise_by_distance, sandwich
from tomopose.detection.rim_fit.normal_equations import Equations, with_priors
from tomopose.detection.rim_fit.state import Anisotropy, Noise, RimFit, active_parameters
from tomopose.detection.rim_model.ring import pixels_between
from tomopose.detection.rim_model.rows import FIRST_NODE, N_SHAPE, SHAPE, influence
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class ConeFit:
    """Result of one fit.

    shape: (7,) in the order of rows.SHAPE; shape_covariance: (7, 7), NaN where a parameter was not fitted.
    gamma: half-angle of the cone, rad.
    level, white: mean background level and the ball's own.  noise: of the image; chi2_dof: with it.
    visible: share of the rim with pixels; lost: share of the visible rim's pixels left out as bad or outlying;
    rim_rms: residual on the rim, in the image's values.
    misfit: share of the rim where a holder's edge makes the background outside fit badly; doubt: share of the centre's
    variance that comes from such edges (ring_size_test.py, sector_test.py).
    """

    shape: Array
    gamma: float
    shape_covariance: Array
    level: float
    white: float
    noise: Noise
    chi2_dof: float
    visible: float
    lost: float
    misfit: float
    doubt: float
    rim_rms: float
    anisotropy: Anisotropy

    @property
    def contrast(self) -> float:
        return abs(self.level - self.white)

    @property
    def noise_outside(self) -> float:
        return math.sqrt(self.noise.outside)

    @property
    def snr(self) -> float:
        """Contrast of the ball against its background over the background's noise."""
        return self.contrast / self.noise_outside


def cone_fit(fit: RimFit, of: Equations) -> ConeFit:
    """The result of a fit with those equations."""
    N, _ = with_priors(fit, of, fit.unknowns)
    m, at = len(fit.unknowns.shape), [SHAPE.index(name) for name in fit.unknowns.shape]
    s, sigma, apart = fit.distance, fit.parameters.blur, fit.noise.apart
    clean = (fit.weight > 0) & (fit.noise.excess < fit.settings.fit.misfit * fit.noise.scatter)[fit.pixels.sector]
    normalised = fit.residual * np.sqrt(fit.weight)
    block, unexplained = _block(fit, N, m, clean, normalised)
    near = (np.abs(s) <= 3 * sigma) & clean if apart else (s > 0) & (fit.weight > 0)
    if near.any():
        square, count = float((unexplained[near] ** 2).mean()), float(np.count_nonzero(near))
        block = block * excess_variance(square, count, fit.settings.noise.rare)
    block[:2, :2] += fit.doubt
    all_near = (np.abs(s) <= 3 * sigma) & (fit.weight > 0)
    covariance = np.full((N_SHAPE, N_SHAPE), np.nan)
    covariance[np.ix_(at, at)] = block
    visible, lost = _rim_shares(fit)
    return ConeFit(
        shape=fit.parameters.shape,
        gamma=fit.parameters.radius * fit.window.gamma_px,
        shape_covariance=covariance,
        level=fit.parameters.level,
        white=float(fit.parameters.white),
        noise=fit.noise,
        chi2_dof=float((normalised**2).sum() / max(np.count_nonzero(fit.weight) - len(N), 1)),
        visible=visible,
        lost=lost,
        rim_rms=math.sqrt(float((fit.residual[all_near] ** 2).mean())) if all_near.any() else 0.0,
        misfit=float((fit.noise.excess >= fit.settings.fit.misfit * fit.noise.scatter).mean()),
        doubt=float(np.trace(fit.doubt) / np.trace(block[:2, :2])),
        anisotropy=fit.anisotropy,
    )


def _block(fit: RimFit, N: Array, m: int, clean: npt.NDArray[np.bool_], normalised: Array) -> tuple[Array, Array]:
    """Covariance (m, m) of the fitted shape without doubt, and the residuals (n,) in units of the noise."""
    rows = solve(N, np.eye(len(N), m)).T
    block = (rows[:, :m] + rows[:, :m].T) / 2
    if not fit.noise.correlated:
        return block, normalised
    full = np.zeros((m, FIRST_NODE + 3 * fit.ring.nodes))
    full[:, active_parameters(fit.unknowns, fit.ring.nodes)] = rows
    effect = influence(fit.jacobian, fit.pixels.sector, fit.weight, full, fit.ring.nodes)
    from_priors = block - effect.T @ effect
    if fit.noise.apart:
        spread = noise_by_distance(fit.distance, normalised, clean, fit.settings.noise)
        effect, normalised = effect * spread[:, None], normalised / spread
    return sandwich(fit.pixels.u, fit.pixels.v, effect, fit.noise.rho) + from_priors, normalised


def _rim_shares(fit: RimFit) -> tuple[float, float]:
    """Share of the rim's directions with a pixel in the image, and share of the rim's pixels that were left out."""
    radius = fit.parameters.radius
    half = min(max(1.5, 2 * fit.parameters.blur), radius)
    used = np.abs(fit.distance) < half
    kept = np.count_nonzero(fit.weight[used])
    if _rim_is_whole(fit):
        return 1.0, 1.0 - kept / max(int(used.sum()), 1)
    everywhere = np.ones_like(fit.window.good)
    *_, rim = pixels_between(fit.window, everywhere, fit.parameters.shape, -half, half, fit.ring)
    rim = rim[:, np.abs(rim[0]) < half]
    bins = int(np.clip(2 * radius, 16, 180))
    angle = np.arctan2(rim[5], rim[4])
    seen = np.unique(np.floor((angle / (2 * math.pi) + 0.5) * bins * (1 - 1e-12)))
    return seen.size / bins, max(0.0, 1.0 - kept / max(rim.shape[1], 1))


def _rim_is_whole(fit: RimFit) -> bool:
    """Whether the rim lies in the window, and every pixel of the window is good."""
    window = fit.window
    u, v, radius = fit.parameters.shape[:3]
    margin = radius + 3.6 + window.eccentricity
    reach_u, reach_v = margin * window.pitch / window.scanner.p_u, margin * window.pitch / window.scanner.p_v
    rows, columns = window.values.shape
    left, below = u - window.origin[0], v - window.origin[1]
    inside = min(left - reach_u, below - reach_v) > 0
    return bool(
        inside and left + reach_u < columns - 1 and below + reach_v < rows - 1 and window.good.all()
    )  # fmt: skip
