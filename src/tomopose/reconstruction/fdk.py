r"""Filtered back-projection from projection matrices: exact in the mid-plane of a circle, a start elsewhere.

Feldkamp, Davis and Kress (J. Opt. Soc. Am. A 1 (1984) 612), with the source at distance R from the centre of the path,
the panel at distance d_SD along its own normal and w the depth of a voxel along that normal:

    f(x) = 1/2 \sum_j \Delta\beta_j  (R_j d_SD / w_j^2)  q_j(u(x), v(x)),
    q_j  = p_u \sum_n h_n  c p_j(u - n, v),   c = d_SD / sqrt(d_SD^2 + ((u - u_0) p_u)^2 + ((v - v_0) p_v)^2),

h the band-limited ramp: h_0 = 1 / (4 p_u^2), h_n = -1 / (pi n p_u)^2 for odd n and 0 for even n (Kak and Slaney,
Principles of Computerized Tomographic Imaging, eq. 3.61).  Rows are filtered along u whatever the path: on tilted paths
that direction is not the path's, which is why FDK alone leaves errors there that SART removes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.path import SourcePath
from tomopose.units import Array


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


class FdkFilter:
    """Weights and filters single views, ready for back-projection with weight "inverse-square"."""

    def __init__(self, matrices: ProjectionMatrices, path: SourcePath, *, threads: int = 1) -> None:
        self._rays = matrices.decompose()
        self._path, self._threads = path, threads
        self._p = matrices.p_u, matrices.p_v
        self._n = matrices.n_u, matrices.n_v
        self._ramp = ramp_filter(matrices.n_u, matrices.p_u)

    def cosine(self, j: int) -> Array:
        """(n_v, n_u): d_SD over the length of each pixel's ray, view j."""
        a = (np.arange(self._n[0]) - self._rays.u_0[j]) * self._p[0]
        b = (np.arange(self._n[1]) - self._rays.v_0[j]) * self._p[1]
        d = self._rays.d_SD[j]
        return d / np.sqrt(d**2 + a**2 + b[:, None] ** 2)

    def __call__(self, image: np.ndarray, j: int) -> np.ndarray:
        """The line integrals (n_v, n_u) of view j, weighted and filtered, times the view's share of the sum."""
        n_u = self._n[0]
        spectrum = scipy.fft.rfft(
            (image * self.cosine(j)).astype(np.float32), n=self._ramp.length, axis=1, workers=self._threads
        )
        spectrum *= self._ramp.transfer
        filtered = scipy.fft.irfft(spectrum, n=self._ramp.length, axis=1, workers=self._threads)[:, :n_u]
        share = 0.5 * self._path.weight[j] * self._path.distance[j] * self._rays.d_SD[j]
        return np.asarray(filtered * np.float32(share), dtype=np.float32)
