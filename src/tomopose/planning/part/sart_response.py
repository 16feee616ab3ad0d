r"""What SART makes of a set of views, at points alone and before there is an image: grey levels and their noise.

A view measures a plane of the object's Fourier transform, and a plane wave of frequency k, cut off by the chord D_l of
the reconstructed box, is seen by view l of direction d_l with the share

    s_l(k) = sinc^2(D_l k . d_l) B(k)^2                 B = (sinc f_u sinc f_v)^2, f in 1/px

of its amplitude: sinc^2 from the cut (the weighting function of Radermacher et al., J. Microsc. 146 (1987) 113), B from
linear interpolation in the voxels and in the pixels.  One step of SART with relaxation w multiplies what is missing by
1 - w s_l.  After all sweeps view j has entered a wave of its own plane with the filter

    H_j(k) = (w / D_j) R_j sum_(i < K) Q^i,             Q = prod_l (1 - w s_l),  R_j = prod over the views after j

that is, weighted back-projection whose weights are those of the order and number of SART's steps.  In a step the energy
of noise falls by 1 - w s_l (2 - w B^2), less than the square of that: what a view takes from a wave it scatters among
the waves next to it.  With Q_E, R_E of these factors,

    |N_j(k)|^2 = (w / D_j)^2 R_E sum_(i, i' < K) Q_E^min(i, i') Q^|i - i'|

The covariance of any two sums over the volume's grey levels is then a sum over views and pixels of the squared, so
filtered, back-projection's transpose times the variance 1 / (N_0 tau) + (r / (N_0 tau))^2 of a pixel's line integral.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array

from tomopose.engines.cpu import processors
from tomopose.geometry.projection import project
from tomopose.geometry.scanner import Scanner
from tomopose.kernel_cache import njit
from tomopose.planning.part.material_paths import material_paths
from tomopose.planning.part.part import Part
from tomopose.planning.part.settings import PartSettings
from tomopose.trajectory.completeness import source_path
from tomopose.trajectory.view_order import view_order
from tomopose.units import Array

RELAXATION = 0.8
"""Of `reconstruct` with sart unless another is asked for."""
MOST_PIXELS = 160
"""Square root of the pixels of the part's image; a finer panel is taken in blocks."""
MARGIN = 12
"""Pixels about the part's image that are filtered with it."""
CELLS = 2
"""A pixel is cut in CELLS x CELLS, whose transmission is averaged."""
CHORDS = 200
"""Points of the part whose chords through the reconstructed box are averaged."""
FAR = 8.0
"""From here on sinc^2 is taken as its mean over a wiggle: it is below 0.001 there, and views differ in phase."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SartResponse:
    """Views of a part with matrices P (n, 3, 4) on crops of the panel, in blocks.

    grey:     (n, n_v, n_u) filtered line integrals, whose back-projection is the volume, 1/mm.
    noise:    (n, a, b) filter of the noise, half plane, of images padded to `padded`.
    variance: (n, n_v, n_u) of each line integral;  voxel: mm, a pixel's size at the part.
    """

    P: Array
    grey: Array
    noise: Array
    variance: Array
    padded: tuple[int, int]
    voxel: float

    def at(self, x: Array) -> Array:
        """(m,) grey levels, 1/mm, at points x (m, 3), mm, of the part at home."""
        out = np.zeros(len(x))
        for P, image in zip(self.P, self.grey, strict=True):
            _gather(image, project(P, x), out)
        return out

    def covariance(self, x: Array, weights: csr_array) -> Array:
        """(f, f) of the sums weights (f, m) of grey levels at x (m, 3), from the noise of the views."""
        f, (n_v, n_u) = weights.shape[0], self.grey.shape[1:]
        total, size = np.zeros((f, f)), float(np.abs(weights.data).max(initial=1e-300))
        for j, P in enumerate(self.P):
            image = np.zeros((f, n_v, n_u), dtype=np.float32)
            _scatter(weights.indptr, weights.indices, weights.data, project(P, x), image)
            spectrum = fft.rfft2(image / size, s=self.padded) * self.noise[j].astype(np.float32)
            own = fft.irfft2(spectrum, s=self.padded)[:, :n_v, :n_u].reshape(f, -1)
            total += (own * self.variance[j].ravel().astype(np.float32)) @ own.T
        return total * size**2


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks:
    """Images of a part that cover it with a margin, the panel's pixels taken in blocks of size x size.

    P (n, 3, 4): to blocks;  tau, variance (n, n_v, n_u): transmission, and the variance of its line integral;
    voxel: mm, a block's size at the part.
    """

    P: Array
    tau: Array
    variance: Array
    size: int
    voxel: float


def blocks(part: Part, scanner: Scanner, P: Array, settings: PartSettings, *, corners: Array | None = None) -> Blocks:
    """Of views with matrices P (n, 3, 4), part at home -> pixels.

    The images follow the part, and what leaves the panel is taken as if it did not; with `corners` (k, 3), mm, of a
    reconstructed box they are one part of the panel, that which the box's image fills.
    """
    x_D = project(P, part.hull)
    extent = np.ptp(x_D, axis=1).max(axis=0)
    size = max(math.ceil(math.sqrt(float(extent.prod())) / MOST_PIXELS), 1)
    low = np.floor((x_D.min(axis=1) - (size - 1) / 2) / size) - MARGIN
    n_u, n_v = (int(k) for k in np.ceil(extent / size) + 2 * MARGIN + 2)
    if corners is not None:
        panel = np.array([scanner.n_u, scanner.n_v]) // size
        first, last = np.zeros(2), panel - 1.0
        if (P[:, 2, :3] @ corners.T + P[:, 2, 3:] > 0).all():
            x_D = (project(P, corners) - (size - 1) / 2) / size
            first = np.clip(np.floor(x_D.min(axis=(0, 1))), 0, panel - 2)
            last = np.clip(np.ceil(x_D.max(axis=(0, 1))), first + 1, panel - 1)
        low, (n_u, n_v) = np.tile(first, (len(P), 1)), (int(k) for k in last - first + 1)
    crop = np.zeros((len(P), 3, 3))
    crop[:, 0, 0] = crop[:, 1, 1] = 1 / size
    crop[:, :2, 2] = -(size - 1) / 2 / size - low
    crop[:, 2, 2] = 1.0
    P = crop @ P
    tau = np.stack([_transmission(part, p, (n_v, n_u), settings) for p in P])
    tau = np.maximum(gaussian_filter(tau, (0, settings.blur / size, settings.blur / size)), 1e-12)
    quanta = settings.quanta * size**2 * tau
    depth = float(np.mean(P[:, 2, :3] @ part.centre + P[:, 2, 3]))
    return Blocks(
        P=P,
        tau=tau,
        variance=1 / quanta + (settings.readout * size / quanta) ** 2,
        size=size,
        voxel=scanner.p_u * size * depth / scanner.d_SD,
    )


def sart_response(part: Part, scanner: Scanner, P: Array, settings: PartSettings) -> SartResponse:
    """Of views with matrices P (n, 3, 4), part at home -> pixels."""
    found = blocks(part, scanner, P, settings)
    n_v, n_u = found.tau.shape[1:]
    padded = (fft.next_fast_len(2 * n_v, real=True), fft.next_fast_len(2 * n_u, real=True))
    signal, noise = _filters(part, found.P, settings, padded)
    spectrum = fft.rfft2(-np.log(found.tau), s=padded) * signal
    return SartResponse(
        P=found.P,
        grey=fft.irfft2(spectrum, s=padded)[:, :n_v, :n_u],
        noise=noise,
        variance=found.variance,
        padded=padded,
        voxel=found.voxel,
    )


def _transmission(part: Part, P: Array, shape: tuple[int, int], settings: PartSettings) -> Array:
    """(n_v, n_u) mean transmission of the pixels of a view P (3, 4)."""
    v, u = (np.arange(k * CELLS) / CELLS - 0.5 + 0.5 / CELLS for k in shape)
    rays = np.stack([*np.meshgrid(u, v), np.ones((len(v), len(u)))], axis=-1).reshape(-1, 3)
    depth = float(P[2, :3] @ part.centre + P[2, 3])
    x = (depth * rays - P[:, 3]) @ np.linalg.inv(P[:, :3]).T
    L, _ = material_paths(P[None], part.mesh.points, part.mesh.faces, x)
    tau = settings.transmission(L[0]).reshape(shape[0], CELLS, shape[1], CELLS)
    mean: Array = tau.mean(axis=(1, 3))
    return mean


def _filters(part: Part, P: Array, settings: PartSettings, padded: tuple[int, int]) -> tuple[Array, Array]:
    """(H, N) (n, a, b) each, of the module's text."""
    s, c, n = source_path(P), part.centre, len(P)
    d = (c - s) / np.linalg.norm(c - s, axis=1)[:, None]
    place = np.empty(n, dtype=np.int64)
    place[view_order(n)] = np.arange(n)
    depth = (P[:, 2, :3] @ c + P[:, 2, 3])[:, None]
    x_D = project(P, c[None])[:, 0]
    per_mm = [(P[:, k, :3] - x_D[:, k, None] * P[:, 2, :3]) / depth for k in (0, 1)]
    f = np.stack(np.meshgrid(fft.rfftfreq(padded[1]), fft.fftfreq(padded[0])), axis=-1)
    signal, noise = np.empty((2, n, *f.shape[:2]))
    how, D, steps = (RELAXATION, settings.sweeps), _chords(part, s, settings.room), np.stack(per_mm, axis=1)

    def fill(j: int) -> None:
        _fill(j, f, steps, d, D, place, how, signal[j], noise[j])

    with ThreadPoolExecutor(processors()) as pool:
        list(pool.map(fill, range(n)))
    return signal, noise


def _chords(part: Part, s: Array, room: float) -> Array:
    """(n,) mm: harmonic mean of the lengths in the reconstructed box of rays from s (n, 3) through the part."""
    half = np.ptp(part.mesh.points, axis=0) / 2
    x = part.centre + np.random.default_rng(0).uniform(-1, 1, (CHORDS, 3)) * half
    d = x[None] - s[:, None]
    d /= np.linalg.norm(d, axis=2)[..., None]
    d = np.where(np.abs(d) < 1e-12, 1e-12, d)
    ends = np.sort([(part.centre + side * (half + room) - x) / d for side in (-1, 1)], axis=0)
    chords: Array = 1 / np.mean(1 / (ends[1].min(axis=2) - ends[0].max(axis=2)), axis=1)
    return chords


@njit(cache=True, nogil=True)
def _sinc(x: float) -> float:
    return 1.0 if abs(x) < 1e-8 else math.sin(math.pi * x) / (math.pi * x)


@njit(cache=True, nogil=True)
def _sinc_2(x: float) -> float:
    return _sinc(x) ** 2 if abs(x) < FAR else 0.5 / (math.pi * x) ** 2


@njit(cache=True, nogil=True)
def _of_wave(share: np.ndarray, B2: float, place: np.ndarray, j: int, how: tuple[float, int]) -> tuple[float, float]:
    """(H_j D_j, |N_j| D_j) of a wave of which the views see the shares s_l = share B2."""
    w, K = how
    Q, R, Q_E, R_E = 1.0, 1.0, 1.0, 1.0
    for i in range(len(share)):
        left, energy = 1 - w * B2 * share[i], 1 - w * B2 * share[i] * (2 - w * B2)
        Q, Q_E = Q * left, Q_E * energy
        if place[i] > place[j]:
            R, R_E = R * left, R_E * energy
    total = energy_total = 0.0
    for i in range(K):
        total += Q**i
        for k in range(K):
            energy_total += Q_E ** min(i, k) * Q ** abs(i - k)
    return w * R * total, w * math.sqrt(R_E * energy_total)


@njit(cache=True, nogil=True)
def _fill(
    j: int,
    f: np.ndarray,
    per_mm: np.ndarray,
    d: np.ndarray,
    D: np.ndarray,
    place: np.ndarray,
    how: tuple[float, int],
    signal: np.ndarray,
    noise: np.ndarray,
) -> None:
    """Write the filters (a, b) of view j: f (a, b, 2) 1/px, per_mm (n, 2, 3) px/mm, d (n, 3), chords D (n,)."""
    n = len(d)
    share = np.empty(n)
    for a in range(f.shape[0]):
        for b in range(f.shape[1]):
            k = f[a, b, 0] * per_mm[j, 0] + f[a, b, 1] * per_mm[j, 1]
            B2 = (_sinc(f[a, b, 0]) * _sinc(f[a, b, 1])) ** 4
            for i in range(n):
                share[i] = _sinc_2(D[i] * (k[0] * d[i, 0] + k[1] * d[i, 1] + k[2] * d[i, 2]))
            H, N = _of_wave(share, B2, place, j, how)
            signal[a, b], noise[a, b] = H / D[j], N / D[j]


@njit(cache=True, nogil=True)
def _place(pixel: np.ndarray, shape: tuple[int, int]) -> tuple[int, int, float, float]:
    """(row, column) of the pixel below and before a place (u, v), and how far it lies beyond, for interpolation."""
    column = min(max(int(np.floor(pixel[0])), 0), shape[1] - 2)
    row = min(max(int(np.floor(pixel[1])), 0), shape[0] - 2)
    return row, column, pixel[1] - row, pixel[0] - column


@njit(cache=True, nogil=True)
def _gather(q: np.ndarray, pixels: np.ndarray, out: np.ndarray) -> None:
    """Add to out (m,) the image q (n_v, n_u) at pixels (m, 2), by linear interpolation."""
    for i in range(len(out)):
        r, c, t, s = _place(pixels[i], q.shape)
        out[i] += (1 - t) * ((1 - s) * q[r, c] + s * q[r, c + 1]) + t * ((1 - s) * q[r + 1, c] + s * q[r + 1, c + 1])


@njit(cache=True, nogil=True)
def _scatter(first: np.ndarray, column: np.ndarray, weight: np.ndarray, pixels: np.ndarray, image: np.ndarray) -> None:
    """The transpose of `_gather`: rows of a sparse matrix of weights to images (f, n_v, n_u)."""
    shape = image.shape[1:]
    for f in range(len(image)):
        for h in range(first[f], first[f + 1]):
            r, c, t, s = _place(pixels[column[h]], shape)
            image[f, r, c] += weight[h] * (1 - t) * (1 - s)
            image[f, r, c + 1] += weight[h] * (1 - t) * s
            image[f, r + 1, c] += weight[h] * t * (1 - s)
            image[f, r + 1, c + 1] += weight[h] * t * s
