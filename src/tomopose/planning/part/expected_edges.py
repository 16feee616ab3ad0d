"""The edges that a measurement of a part will find in the volume of a set of views, and how noise moves them.

The measurement fits a blurred step to the profile along each normal (`measurement.surface.edge_kernel`).  To first
order noise g of the profile moves that edge by sum_k L_k g_k, L the row of the fit's pseudo-inverse that belongs to its
place; the steepness comes from the profile that the views let expect, not from an ideal one: where no ray grazes a
surface its edge is weak, and noise moves it far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import erfc

from tomopose.kernel_cache import njit
from tomopose.measurement.surface import edge_kernel as kernel
from tomopose.measurement.surface.edges import EdgeSettings, common_sigma, fit_window
from tomopose.units import Array

SIGMA_POINTS, SIGMA_ROUNDS, SIGMA_TOLERANCE = 400, 25, 0.01
"""Points looked at, steps at the most, and voxels of the last change: coarser than a measurement's."""
SETTINGS = EdgeSettings()
FEWEST_EDGES = 0.2
"""Share of a feature's points with an edge, below which nothing is said of it."""


class Response(Protocol):
    """Grey levels that a reconstruction makes of the part, and the size of its voxels, mm."""

    @property
    def voxel(self) -> float: ...
    def at(self, x: Array) -> Array: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectedEdges:
    """Of m points: samples x (m, k, 3), mm, along the normals; L (m, k), mm per grey level; found: (m,) bool."""

    x: Array
    L: Array
    found: np.ndarray


@njit(cache=True, nogil=True)
def _fit(profiles: np.ndarray, sigma: float, window: float, out: np.ndarray) -> np.ndarray:
    """(m,) bool: whether a blurred step fits each profile (m, k); writes rows of results."""
    good = np.zeros(len(profiles), dtype=np.bool_)
    for i in range(len(profiles)):
        a, b = kernel.plateaus(profiles[i])
        s = kernel.crossing(profiles[i], 0.5 * (a + b), window)
        if a > b and math.isfinite(s):
            good[i] = kernel.fit_edge(profiles[i], sigma, window, s, a, b, out[i])
    return good


def _profiles(response: Response, x: Array, n: Array, sigma: float) -> tuple[Array, Array, Array]:
    """(places s (k,) in voxels, samples (m, k, 3) mm, grey levels (m, k)) along normals n from points x (m, 3)."""
    window = fit_window(SETTINGS, sigma)
    s = np.linspace(-window, window, 2 * round(window / kernel.STEP) + 1, dtype=np.float64)
    samples = x[:, None] + response.voxel * s[None, :, None] * n[:, None]
    return s, samples, response.at(samples.reshape(-1, 3)).reshape(len(x), len(s))


def _fitted(profiles: Array, sigma: float) -> tuple[Array, np.ndarray]:
    out = np.full((len(profiles), kernel.N_COLUMNS), np.nan)
    return out, _fit(profiles, sigma, fit_window(SETTINGS, sigma), out)


def _blur(response: Response, x: Array, n: Array) -> float:
    """Common standard width of a feature's edges, voxels, as the measurement estimates it."""
    rows = np.linspace(0, len(x) - 1, min(len(x), SIGMA_POINTS)).astype(int)
    return common_sigma(
        lambda sigma: _fitted(_profiles(response, x[rows], n[rows], sigma)[2], sigma),
        rounds=SIGMA_ROUNDS,
        tolerance=SIGMA_TOLERANCE,
    )


def expected_edges(response: Response, x: Array, n: Array) -> ExpectedEdges:
    """Of the points x (m, 3), mm, of one feature with unit normals n (m, 3) from material to air."""
    sigma = _blur(response, x, n)
    s, samples, profiles = _profiles(response, x, n, sigma)
    out, found = _fitted(profiles, sigma)
    contrast = np.where(found, out[:, kernel.A] - out[:, kernel.B], np.nan)
    typical = float(np.median(contrast[found])) if found.any() else np.nan
    t = s[None] - np.where(found, out[:, kernel.S], 0.0)[:, None]
    inner = 0.5 * erfc(t / (sigma * math.sqrt(2)))
    slope = np.exp(-0.5 * (t / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
    slope *= np.where(found, contrast, typical)[:, None]
    step = np.stack([slope, inner, 1 - inner], axis=2)
    normal = np.einsum("mki,mkj->mij", step, step)
    L = np.full(t.shape, np.nan)
    if found.any():
        L = response.voxel * np.einsum("mj,mkj->mk", np.linalg.inv(normal)[:, 0], step)
    return ExpectedEdges(x=samples, L=L, found=found)
