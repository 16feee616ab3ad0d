r"""Maximum-likelihood fit of a radiograph around the ball's rim (model: edges.py, profile.py, cone.py).

Gauss-Newton on the shape (centre, radius, blur) and the linear background at once, which is variable projection: the
Schur complement of the background's block is the projected normal matrix.  The background's curvature has a prior
whose width is estimated sector by sector from the data themselves (empirical Bayes): none where the background is
smooth, so that little information is given away, and a wide one where a holder's wall runs along the rim.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from tomopose.detection.rim_fit.background import MOST_LINES, whole_ring, without_outliers, without_worst_lines
from tomopose.detection.rim_fit.cholesky import solve
from tomopose.detection.rim_fit.cone import ring_pixels
from tomopose.detection.rim_fit.model import FIRST_NODE, N_SHAPE, SHAPE, influence
from tomopose.detection.rim_fit.noise import across, correlation, evident, sandwich, weights
from tomopose.detection.rim_fit.order_statistics import median
from tomopose.detection.rim_fit.rim import ENOUGH, STAY, Rim
from tomopose.detection.rim_fit.ring_size_test import nearer
from tomopose.detection.rim_fit.sector_test import rounder
from tomopose.errors import BallNotFoundError
from tomopose.geometry.scanner import Scanner
from tomopose.units import Array

OUTLIER = 6.0
"""Residual in standard deviations from which a single pixel counts as bad."""
MISFIT = 4.0
"""Standard deviations by which a sector's chi-square must exceed 1 for its background to count as badly fitted."""
STEEPEST = 6.0
"""Prior: the background changes over the ring by no more than this many standard deviations of the ring's values."""
FEW_BENT, BENT = 0.1, 10.0
"""Prior share of nodes where the background is bent, and its curvature there, in variances of the estimate."""
LEAST_TAU2 = 1e-3
ENOUGH_QUIET, FEWEST_PIXELS = 200, 60
"""Pixels in sectors that fit well from which noise is taken from them alone, and pixels below which its correlation
cannot be told."""
KAPPA_STARTS = (0.3, 1.0, 3.0, 8.0)
"""Total attenuations along the diameter from which a ball that X-rays pass is fitted; below the first the shape of
the profile no longer depends on it."""


@dataclass(frozen=True, kw_only=True)
class ConeFit:
    """Result of one fit.

    shape: (7,) in the order of edges.SHAPE; shape_covariance: (7, 7), NaN where a parameter was not fitted.
    gamma: half-angle of the cone, rad.
    level, white: mean background level and the ball's own; noise_out, noise_in: standard deviations there.
    chi2_dof: with the noise of the background; rho: autocorrelation of the noise.
    visible: share of the rim with pixels; lost: share of the visible rim's pixels left out as bad or outlying;
    rim_rms: residual on the rim, in the image's values.
    misfit: share of the rim where a holder's edge makes the background outside fit badly; doubt: share of the centre's
    variance that comes from such edges (nested.py, sectors.py).
    """

    shape: Array
    gamma: float
    shape_covariance: Array
    level: float
    white: float
    noise_out: float
    noise_in: float
    chi2_dof: float
    rho: Array
    visible: float
    lost: float
    misfit: float
    doubt: float
    rim_rms: float
    anisotropy: Array
    anisotropy_covariance: Array

    @property
    def snr(self) -> float:
        """Contrast of the ball against its background over the background's noise."""
        return abs(self.level - self.white) / self.noise_out


def fit_cone(
    window: Array,
    good: Array,
    origin: tuple[int, int],
    scanner: Scanner,
    x_D: Array,
    radius: float,
    quantum: float = 0.0,
) -> ConeFit:
    """Fits the ball whose rim lies within 2 px or so of a circle.

    Parameters
    ----------
    window:  float64 [v, u], the part of the radiograph that holds the ball and its surroundings.
    good:    bool, same shape: pixels that may be used.
    origin:  D coordinates (u, v) of window[0, 0].
    x_D, radius:  where the rim about is, px.
    quantum: step of the image's values (1 for counts, 0 for floats): no noise is smaller than quantum / sqrt(12).

    Raises
    ------
    BallNotFoundError  where no ball can be fitted there.
    """
    rim = Rim(window, good, origin, scanner, np.asarray(x_D, dtype=np.float64), radius)
    spread = float(np.std(rim.value))
    if not spread > 0:
        raise BallNotFoundError(f"the image is constant around ({x_D[0]:.1f}, {x_D[1]:.1f})")
    floor = quantum**2 / 12 + (1e-5 * spread) ** 2
    start = rim.shape.copy()
    _approach(rim, spread)
    kappa_free = _is_transparent(rim)
    shape: tuple[str, ...] = ("u", "v", "radius", "sigma")
    if kappa_free:
        _choose_kappa(rim, spread, start)
        shape = (*shape, "kappa")

    whole_ring(rim, spread)
    for _ in range(MOST_LINES):
        if not without_worst_lines(rim):
            break
        if not kappa_free:
            rim.begin()
            _approach(rim, spread)
        whole_ring(rim, spread)
    if kappa_free:
        for _ in range(10):
            if rim.step(rim.active(*shape, curvature=False), careful=True) < 1e-3:
                break
    active = rim.active(*shape)
    widest = (rim.reach**2 / (STEEPEST * spread)) ** 2
    if kappa_free:
        _weigh(rim, floor, 2.0)
        rim.precision[2::3] = widest
        for _ in range(3):
            rim.step(active, careful=True)
    noise = _weigh(rim, floor, 2.0)
    rim.precision[2::3] = np.maximum(_curvature_precision(rim, active), widest)
    for _ in range(3 if kappa_free else 1):
        rim.step(active, careful=kappa_free)
    noise = _weigh(rim, floor, 2.5)
    rim.polish(active, careful=kappa_free)
    rho, apart = _noise_correlation(rim, noise)
    together = max(float(rho.sum()), 1.0) if apart else 1.0
    rim.turn()
    doubt = nearer(rim, active, careful=kappa_free, noise=together)
    doubt += rounder(rim, active, doubt, parameters=2.5, noise=together)
    anisotropy, anisotropy_covariance = _anisotropy(rim, shape)
    significance = float(anisotropy @ np.linalg.solve(anisotropy_covariance, anisotropy))
    if significance > 30.0 and np.hypot(*anisotropy) > 0.1 * rim.shape[3] ** 2:
        shape = (*shape, "q_cos", "q_sin")
        active = rim.active(*shape)
        for _ in range(3):
            rim.step(active)
        anisotropy = rim.shape[5:7].copy()
    return _result(rim, shape, active, noise, rho, apart, doubt, anisotropy, anisotropy_covariance)


def _approach(rim: Rim, spread: float) -> None:
    """From the finder's circle to the neighbourhood of the optimum, without curvature and with equal weights."""
    rim.weight = np.full(rim.u.size, 1.0 / (0.03 * spread) ** 2)
    prior = np.zeros((rim.n_nodes, 3))
    prior[:, 0], prior[:, 1] = 1 / (STEEPEST * spread) ** 2, (rim.reach / (STEEPEST * spread)) ** 2
    rim.precision = prior.ravel()
    rim.white_prior = (float(np.mean(rim.value)), 1 / (STEEPEST * spread) ** 2)
    rim.evaluate(STAY)
    rim.step(rim.active(curvature=False))
    for turn in range(14):
        moved = rim.step(rim.active("u", "v", "radius", *(("sigma",) if turn else ()), curvature=False))
        if moved < 0.02 and turn > 1:
            break
        if turn in (1, 3, 6, 9) and moved > 0.02:
            rim.gather()
            rim.evaluate(STAY)
        rim.weight = without_outliers(
            rim.rim[0], rim.value, rim.model, 3.0 + 2 * moved, 0.1 * spread, 1.0 / (0.03 * spread) ** 2
        )


def _is_transparent(rim: Rim) -> bool:
    """Whether the ball grows darker towards its middle by more than noise and 1 % of its contrast."""
    depth = 3 * rim.shape[3] + 0.5
    radius = rim.shape[2]
    if radius - depth < 2.0:
        return True
    rings = ((radius - depth - 0.08 * radius - 1.0, radius - depth), (0.0, max(0.6 * (radius - depth), 1.5)))
    middle = []
    for low, high in rings:
        every = 1 + 2 * int(math.pi * (high**2 - low**2) / (2 * ENOUGH))
        *_, value = ring_pixels(
            rim.window, rim.good, rim.origin[0], rim.origin[1], rim.shape[0], rim.shape[1], low, high,
            rim.scanner.p_u / rim.p, rim.scanner.p_v / rim.p, every,
        )  # fmt: skip
        if value.size < 5:
            return False
        middle.append(middle_value(value))
    (near, u_near), (deep, u_deep) = middle
    return abs(near - deep) > max(0.01 * abs(rim.level - deep), 6 * math.hypot(u_near, u_deep))


@njit(cache=True)
def middle_value(values):  # type: ignore[no-untyped-def]
    """Median of the values, and its standard deviation."""
    middle = median(values.copy())
    return middle, 1.8 * median(np.abs(values - middle)) / math.sqrt(values.shape[0])


def _choose_kappa(rim: Rim, spread: float, start: Array) -> None:
    """Widens the ring inwards and takes the best of several starts for the total attenuation."""
    radius = start[2]
    rim.shape = start.copy()
    rim.inside = float(min(max(0.12 * radius, 3 * start[3] + 3.0), 10.0, radius - 0.5))
    rim.gather()
    rim.weight = np.full(rim.u.size, 1.0 / (0.03 * spread) ** 2)
    best = None
    for kappa in KAPPA_STARTS:
        rim.shape, rim.nodes, rim.white = start.copy(), np.zeros_like(rim.nodes), 0.0
        rim.shape[4] = rim.kappa_start = kappa
        rim.evaluate()
        rim.step(rim.active(curvature=False))
        for _ in range(4):
            rim.step(rim.active("u", "v", "radius", "sigma", curvature=False), careful=True)
        if best is None or rim.cost < best[0]:
            best = (rim.cost, rim.shape, rim.nodes, rim.white, kappa)
    assert best is not None
    _, rim.shape, rim.nodes, rim.white, rim.kappa_start = best
    rim.evaluate()


@dataclass(frozen=True, kw_only=True)
class _Noise:
    """Variance inside and outside; each sector's chi-square outside less 1, and what noise alone lets it vary by."""

    inside: float
    outside: float
    excess: Array
    scatter: float


def _weigh(rim: Rim, floor: float, parameters: float) -> _Noise:
    """Gives the pixels weights by the noise of the image; parameters: linear ones that a sector's pixels determine."""
    weight, v_in, v_out, excess, scatter = weights(
        rim.rim[0], rim.residual, rim.model, rim.first, rim.shape[3], rim.level, rim.white, floor, parameters, OUTLIER
    )
    if not math.isfinite(v_out):
        raise BallNotFoundError("too few usable pixels outside the rim to measure the noise")
    rim.weight = weight
    return _Noise(inside=v_in, outside=v_out, excess=excess, scatter=scatter)


def _noise_correlation(rim: Rim, noise: _Noise) -> tuple[Array, bool]:
    """Autocorrelation of the noise, where the background fits: what is left of an edge is correlated too.

    On a ring too small to tell the two apart (False), what is left counts as noise.
    """
    outside = (rim.rim[0] > 3 * rim.shape[3]) & (rim.weight > 0)
    quiet = outside & (noise.excess < noise.scatter)[rim.left]
    apart = bool(np.count_nonzero(quiet) > ENOUGH_QUIET)
    used = np.flatnonzero(quiet if apart else outside)
    if used.size <= FEWEST_PIXELS:
        return np.ones((1, 1)), apart
    return correlation(rim.u[used], rim.v[used], (rim.residual * np.sqrt(rim.weight))[used]), apart


def _curvature_precision(rim: Rim, active: npt.NDArray[np.intp]) -> Array:
    """Empirical Bayes: 1 / tau_k^2, where most nodes share one small tau and few, at a holder's edges, have their own.

    With z_k the estimate of c_k without prior in its standard deviations, the share p_k of the evidence that node k is
    one of the few (a normal of variance 1 + BENT against one of variance 1) weighs what z_k^2 shows above its noise;
    all nodes have in common what the others' mean square shows above what chance may do.
    """
    kept, rim.precision = rim.precision, rim.precision.copy()
    rim.precision[2::3] = 0.0
    N, g = rim.normal(active)
    rim.precision = kept
    at = np.searchsorted(active, np.arange(FIRST_NODE + 2, FIRST_NODE + 3 * rim.n_nodes, 3))
    unit = np.zeros((active.size, at.size + 1))
    unit[at, np.arange(at.size)] = 1.0
    unit[:, -1] = g
    X = solve(N, unit)[at]
    V, c = X[np.arange(at.size), np.arange(at.size)], rim.nodes[:, 2] + X[:, -1]
    z2 = np.where(V > 0, c**2 / np.where(V > 0, V, 1.0), 0.0)
    p = 1.0 / (1.0 + (1.0 / FEW_BENT - 1.0) * math.sqrt(1.0 + BENT) * np.exp(-0.5 * z2 * BENT / (1.0 + BENT)))
    count = float(np.sum(1.0 - p))
    common = max(evident(float(np.sum((1.0 - p) * z2)) / max(count, 1.0), count) - 1.0, LEAST_TAU2)
    own = p * np.maximum(z2 - 1.0, 0.0) * V
    smooth = (np.roll(own, 1) + 2 * own + np.roll(own, -1)) / 4
    return np.where(V > 0, 1.0 / np.maximum(smooth + common * V, 1e-300), 0.0)


def _anisotropy(rim: Rim, shape: tuple[str, ...]) -> tuple[Array, Array]:
    """One Gauss-Newton step towards a blur that depends on direction, and its covariance, px^2."""
    active = rim.active(*shape, "q_cos", "q_sin")
    N, g = rim.normal(active)
    at = np.searchsorted(active, [SHAPE.index(q) for q in ("q_cos", "q_sin")])
    right = np.zeros((active.size, 3))
    right[at, [0, 1]] = 1.0
    right[:, 2] = g
    X = solve(N, right)[at]
    return X[:, 2].copy(), X[:, :2].copy()


def _result(
    rim: Rim,
    shape: tuple[str, ...],
    active: npt.NDArray[np.intp],
    noise: _Noise,
    rho: Array,
    apart: bool,
    doubt: Array,
    anisotropy: Array,
    anisotropy_covariance: Array,
) -> ConeFit:
    N, _ = rim.normal(active)
    m = len(shape)
    rows = solve(N, np.eye(active.size, m)).T
    at = [SHAPE.index(name) for name in shape]
    block = (rows[:, :m] + rows[:, :m].T) / 2
    s, sigma = rim.rim[0], rim.shape[3]
    clean = (rim.weight > 0) & (noise.excess < MISFIT * noise.scatter)[rim.left]
    normalised = unexplained = rim.residual * np.sqrt(rim.weight)
    if np.count_nonzero(rho) > 1:
        effect = influence(rim.jacobian, rim.left, rim.weight, _scattered(rim, active, rows), rim.n_nodes)
        from_priors = block - effect.T @ effect
        if apart:
            spread = across(s, normalised, clean)
            effect, unexplained = effect * spread[:, None], normalised / spread
        block = sandwich(rim.u, rim.v, effect, rho) + from_priors
    near = (np.abs(s) <= 3 * sigma) & clean if apart else (s > 0) & (rim.weight > 0)
    if near.any():
        block = block * evident(float((unexplained[near] ** 2).mean()), float(np.count_nonzero(near)))
    block[:2, :2] += doubt
    all_near = (np.abs(s) <= 3 * sigma) & (rim.weight > 0)
    rim_rms = math.sqrt(float((rim.residual[all_near] ** 2).mean())) if all_near.any() else 0.0
    covariance = np.full((N_SHAPE, N_SHAPE), np.nan)
    covariance[np.ix_(at, at)] = block
    weighted = rim.weight > 0
    visible, lost = _rim_shares(rim)
    return ConeFit(
        shape=rim.shape,
        gamma=float(rim.shape[2] * rim.gamma_px),
        shape_covariance=covariance,
        level=rim.level,
        white=float(rim.white),
        noise_in=math.sqrt(noise.inside),
        noise_out=math.sqrt(noise.outside),
        chi2_dof=float((normalised[weighted] ** 2).sum() / max(int(weighted.sum()) - len(active), 1)),
        rho=rho,
        visible=visible,
        lost=lost,
        rim_rms=rim_rms,
        misfit=float((noise.excess >= MISFIT * noise.scatter).mean()),
        doubt=float(np.trace(doubt) / np.trace(block[:2, :2])),
        anisotropy=anisotropy,
        anisotropy_covariance=anisotropy_covariance,
    )


def _scattered(rim: Rim, active: npt.NDArray[np.intp], rows: Array) -> Array:
    """Rows of the inverse normal matrix (m, active) in the order of all parameters, zero where one was not fitted."""
    full = np.zeros((rows.shape[0], FIRST_NODE + 3 * rim.n_nodes))
    full[:, active] = rows
    return full


def _rim_shares(rim: Rim) -> tuple[float, float]:
    """Share of the rim's directions with a pixel in the image, and share of the rim's pixels that were left out."""
    radius, half = rim.shape[2], max(1.5, 2 * rim.shape[3])
    used = np.abs(rim.rim[0]) < half
    kept = np.count_nonzero(rim.weight[used])
    if rim.whole():
        return 1.0, 1.0 - kept / max(int(used.sum()), 1)
    *_, every = rim.ring(np.ones_like(rim.good), -half, half, 1)
    every = every[:, np.abs(every[0]) < half]
    bins = int(np.clip(2 * radius, 16, 180))
    angle = np.arctan2(every[5], every[4])
    seen = np.unique(np.floor((angle / (2 * math.pi) + 0.5) * bins * (1 - 1e-12)))
    return seen.size / bins, max(0.0, 1.0 - kept / max(every.shape[1], 1))
