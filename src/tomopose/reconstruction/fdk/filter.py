r"""Filtered back-projection from projection matrices, the ramp along the source's path.

Feldkamp, Davis and Kress (J. Opt. Soc. Am. A 1 (1984) 612), with the source at distance R from the centre of the path,
the panel at distance d_SD along its own normal and w the depth of a voxel along that normal:

    f(x) = \sum_j \Delta\beta_j  (R_j d_SD / w_j^2)  q_j(u(x), v(x)),
    q_j  = p_u \sum_n h_n  c m_j p_j(u - n, v),   c = d_SD / sqrt(d_SD^2 + ((u - u_0) p_u)^2 + ((v - v_0) p_v)^2),

m the share of a line's measurements that the pixel gets, 1/2 over a full turn (redundancy.py), and h the band-limited
ramp: h_0 = 1 / (4 p_u^2), h_n = -1 / (pi n p_u)^2 for odd n and 0 for even n (Kak and Slaney, Principles of
Computerized Tomographic Imaging, eq. 3.61).  Its transfer is |k_u|.

Where the source rises and falls on its way a(beta), rows are not the right direction.  A view knows the object's
Fourier components k in the plane of its panel.  Each k is known wherever the path crosses the plane through its centre
across k, M(k) times, and from 1 / |k . a'| of the views about each crossing: the sum of all is right where the transfer
of a view is

    (2 / M(k)) |t_u k_u + t_v k_v|,   t = a' / R along the panel's axes,

which is |k_u| on a circle.  With far sources that is exact on every path that meets all planes; M is counted for the
planes through the centre, so that sources at hand leave an error where planes beside it are crossed more or less often.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft

from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.fdk.path import SourcePath
from tomopose.reconstruction.fdk.redundancy import Redundancy
from tomopose.units import Array

DIRECTIONS = 180
"""Of k on the panel, over half a turn, in which crossings are counted."""


@dataclass(frozen=True, kw_only=True)
class RampFilter:
    """transfer: half spectrum of p_u h on `length` samples, so that a filtered image has the unit of p / mm."""

    transfer: np.ndarray
    length: int


def ramp_filter(n_u: int, p_u: float) -> RampFilter:
    """The band-limited ramp for rows of n_u pixels, padded to at least 2 n_u so that nothing wraps around."""
    length = int(scipy.fft.next_fast_len(2 * n_u, real=True))
    n = np.minimum(np.arange(length), length - np.arange(length))
    h = np.zeros(length)
    h[0] = 1 / (4 * p_u**2)
    odd = n % 2 == 1
    h[odd] = -1 / (np.pi * n[odd] * p_u) ** 2
    return RampFilter(transfer=(p_u * scipy.fft.rfft(h).real).astype(np.float32), length=length)


def crossings(path: SourcePath, axes: Array) -> np.ndarray:
    """(n, DIRECTIONS) float32: M, how often the path crosses the plane through its centre whose normal lies on the
    panel of view j, axes (n, 2, 3), at i pi / DIRECTIONS from u towards v; an even number, 2 on a circle."""
    psi = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    towards = (path.arm / path.distance[:, None])[np.argsort(path.angle, kind="stable")]
    out = np.empty((len(axes), DIRECTIONS), dtype=np.float32)
    for j, (e_u, e_v) in enumerate(axes):
        above = (np.cos(psi)[:, None] * e_u + np.sin(psi)[:, None] * e_v) @ towards.T > 0
        out[j] = np.maximum((above != np.roll(above, 1, axis=1)).sum(axis=1), 2)
    return out


def panel_frequencies(
    n: tuple[int, int], p: tuple[float, float], length: int, t: Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """k_u (m,) and k_v (h, 1), 1/mm, of a padded image's half spectrum, and each k's direction (h, m) in `crossings`.

    h leaves room for a line across all `n` columns along the steepest direction t (views, 2), which must not wrap.
    """
    steepest = min(float(np.max(np.abs(t[:, 1]) / np.maximum(np.abs(t[:, 0]), 1e-6))), 1.0)
    height = int(scipy.fft.next_fast_len(math.ceil((1 + steepest) * n[1]), real=True))
    k_u = scipy.fft.rfftfreq(length, p[0]).astype(np.float32)
    k_v = scipy.fft.fftfreq(height, p[1]).astype(np.float32)[:, None]
    direction = np.rint(np.arctan2(k_v, k_u) * (DIRECTIONS / np.pi)).astype(np.int16) % DIRECTIONS
    return k_u, k_v, direction


class FdkFilter:
    """Weights and filters single views, ready for back-projection with weight "inverse-square"."""

    def __init__(
        self, matrices: ProjectionMatrices, path: SourcePath, *, redundancy: Redundancy | None = None, threads: int = 1
    ) -> None:
        self._rays = matrices.decompose()
        self._path, self._threads = path, threads
        self._redundancy = None if redundancy is None or redundancy.constant else redundancy
        self._p = matrices.p_u, matrices.p_v
        self._n = matrices.n_u, matrices.n_v
        self.beyond = (0, 0) if self._redundancy is None else self._redundancy.beyond
        self._ramp = ramp_filter(matrices.n_u + sum(self.beyond), matrices.p_u)
        self._rows_only = path.circular or not path.smooth
        if not self._rows_only:
            axes = np.stack([self._rays.U, self._rays.V], axis=1)
            axes /= np.linalg.norm(axes, axis=2, keepdims=True)
            self._crossings = crossings(path, axes)
            self._t = np.einsum("jab,jb->ja", axes, path.tangent) / path.distance[:, None]
            wide = self._n[0] + sum(self.beyond), self._n[1]
            self._panel = panel_frequencies(wide, self._p, self._ramp.length, self._t)
            # The band-limited ramp differs from k near 0, where it keeps a wide object's level.
            self._beyond_k = np.append(self._ramp.transfer - self._panel[0], np.float32(0))

    def cosine(self, j: int) -> Array:
        """(n_v, n_u): d_SD over the length of each pixel's ray, view j."""
        a = (np.arange(self._n[0]) - self._rays.u_0[j]) * self._p[0]
        b = (np.arange(self._n[1]) - self._rays.v_0[j]) * self._p[1]
        d = self._rays.d_SD[j]
        result: Array = d / np.sqrt(d**2 + a**2 + b[:, None] ** 2)
        return result

    def along_rows(self, image: np.ndarray) -> np.ndarray:
        """The ramp along u."""
        spectrum = scipy.fft.rfft(image, n=self._ramp.length, axis=1, workers=self._threads)
        spectrum *= self._ramp.transfer
        return np.asarray(scipy.fft.irfft(spectrum, n=self._ramp.length, axis=1, workers=self._threads))

    def along_path(self, image: np.ndarray, j: int) -> np.ndarray:
        """The ramp along the path's direction in view j, each k over how often it is met."""
        (t_u, t_v), (k_u, k_v, direction) = self._t[j].astype(np.float32), self._panel
        k = np.abs(t_u * k_u + t_v * k_v)
        more = self._beyond_k[np.minimum(np.rint(k / k_u[1]).astype(np.int32), len(self._beyond_k) - 1)]
        size = len(k_v), self._ramp.length
        spectrum = scipy.fft.rfft2(image, s=size, workers=self._threads)
        spectrum *= (k + more) * (2 / self._crossings[j])[direction]
        return np.asarray(scipy.fft.irfft2(spectrum, s=size, workers=self._threads))

    def __call__(self, image: np.ndarray, j: int) -> np.ndarray:
        """The line integrals (n_v, n_u) of view j, weighted and filtered, times the view's share of the sum.

        Returns (n_v, n_u + sum(beyond)): wider than the panel where the weights say so.
        """
        n_u, n_v = self._n
        below, above = self.beyond
        share = 0.5 if self._redundancy is None else self._redundancy.weights(j)
        weighted = np.zeros((n_v, n_u + below + above), dtype=np.float32)
        weighted[:, below : below + n_u] = image * (self.cosine(j) * share)
        filtered = self.along_rows(weighted) if self._rows_only else self.along_path(weighted, j)
        scale = self._path.weight[j] * self._path.distance[j] * self._rays.d_SD[j]
        return np.asarray(filtered[:n_v, : weighted.shape[1]] * np.float32(scale), dtype=np.float32)
