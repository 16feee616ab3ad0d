"""Effects on the noiseless image that no ray shows: scatter, veiling glare, a measured MTF, wide blur in general."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import fft, ndimage

from tomopose.errors import InputError
from tomopose.kernel_cache import njit
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """constant: share of the empty beam added everywhere.  amount, sigma (px): scatter that the object makes, as
    amount x Gaussian * (-T ln T), the forward-scatter potential of kernel-superposition models (Ohnesorge, Flohr and
    Klingenbeck-Regn, Eur. Radiol. 9 (1999) 563)."""

    constant: float = 0.0
    amount: float = 0.0
    sigma: float = 100.0

    def __post_init__(self) -> None:
        if not (0 <= self.constant < 1 and 0 <= self.amount < 10 and self.sigma > 0):
            raise InputError(
                f"scatter: constant {self.constant} lies in [0, 1), amount {self.amount} in [0, 10), "
                f"sigma {self.sigma} px above 0"
            )


@dataclass(frozen=True, kw_only=True)
class Glare:
    """share of the light in the scintillator and its housing that spreads over a Gaussian of sigma px."""

    share: float = 0.0
    sigma: float = 200.0

    def __post_init__(self) -> None:
        if not (0 <= self.share < 1 and self.sigma > 0):
            raise InputError(f"glare: share {self.share}, sigma {self.sigma} px; share lies in [0, 1), sigma above 0")


@njit(cache=True, nogil=True)
def _block_means(image: np.ndarray, step: int, potential: bool, out: np.ndarray) -> None:
    """Means of step x step pixels of T, or of its scatter potential -T ln T."""
    n_v, n_u = image.shape
    for j in range(out.shape[0]):
        v_0, v_1 = j * step, min((j + 1) * step, n_v)
        for i in range(out.shape[1]):
            u_0, u_1 = i * step, min((i + 1) * step, n_u)
            total = 0.0
            for T in image[v_0:v_1, u_0:u_1].flat:
                if not potential:
                    total += T
                elif T != 1.0 and T > 1e-30:
                    total -= T * np.log(T)
            out[j, i] = total / ((v_1 - v_0) * (u_1 - u_0))


@njit(cache=True, nogil=True)
def _joined(image: np.ndarray, small: np.ndarray, step: int, own: float, share: float, constant: float) -> Any:
    """own x image + share x the block means, interpolated between the blocks' middles, + constant."""
    n_v, n_u = image.shape
    out = np.empty(image.shape)
    for v in range(n_v):
        y = min(max((v + 0.5) / step - 0.5, 0.0), small.shape[0] - 1.0)
        j = min(int(y), max(small.shape[0] - 2, 0))
        j_1, y = min(j + 1, small.shape[0] - 1), y - j
        for u in range(n_u):
            x = min(max((u + 0.5) / step - 0.5, 0.0), small.shape[1] - 1.0)
            i = min(int(x), max(small.shape[1] - 2, 0))
            i_1, x = min(i + 1, small.shape[1] - 1), x - i
            low = small[j, i] + x * (small[j, i_1] - small[j, i])
            high = small[j_1, i] + x * (small[j_1, i_1] - small[j_1, i])
            out[v, u] = own * image[v, u] + share * (low + y * (high - low)) + constant
    return out


def _spread(image: Array, sigma: float, *, potential: bool, own: float, share: float, constant: float = 0.0) -> Array:
    """own x image + share x (the image, or its scatter potential, blurred by a wide sigma, px) + constant.

    The wide blur acts on means over blocks of a quarter of sigma, interpolated back.
    """
    step = max(1, int(sigma / 4))
    small = np.empty((-(-image.shape[0] // step), -(-image.shape[1] // step)))
    _block_means(image, step, potential, small)
    small = ndimage.gaussian_filter(small, sigma / step, mode="nearest")
    return np.asarray(_joined(image, small, step, own, share, constant))


def wide_blur(image: Array, sigma: float) -> Array:
    """Gaussian blur of a wide sigma (px)."""
    return _spread(image, sigma, potential=False, own=0.0, share=1.0)


def with_scatter(T: Array, scatter: Scatter) -> Array:
    """Primary plus scattered radiation."""
    if scatter.amount > 0:
        return _spread(T, scatter.sigma, potential=True, own=1.0, share=scatter.amount, constant=scatter.constant)
    return T + scatter.constant if scatter.constant > 0 else T


def with_glare(T: Array, glare: Glare) -> Array:
    """The image with a veil over it; an even image stays as it is."""
    return _spread(T, glare.sigma, potential=False, own=1 - glare.share, share=glare.share) if glare.share > 0 else T


@dataclass(frozen=True, kw_only=True)
class MTF:
    """A measured modulation transfer function: values at spatial frequencies, cycles per px, rotationally symmetric.

    Begins with 1 at frequency 0; beyond the last frequency it falls linearly to 0 within one more step.
    """

    frequency: tuple[float, ...]
    value: tuple[float, ...]

    def __post_init__(self) -> None:
        f, m = np.asarray(self.frequency, dtype=np.float64), np.asarray(self.value, dtype=np.float64)
        if f.shape != m.shape or f.ndim != 1 or len(f) < 2 or (np.diff(f) <= 0).any() or f[0] != 0 or m[0] != 1:
            raise InputError("an MTF needs rising frequencies from 0 (cycles per px) and values that begin with 1")
        if not (np.isfinite(m).all() and (m >= 0).all() and (m <= 1.5).all()):
            raise InputError("the values of an MTF lie between 0 and 1.5")
        # Tuples, so that a detector can be a key.
        object.__setattr__(self, "frequency", tuple(f.tolist()))
        object.__setattr__(self, "value", tuple(m.tolist()))

    def at(self, f: Array) -> Array:
        last = self.frequency[-1] + (self.frequency[-1] - self.frequency[-2])
        result: Array = np.interp(f, np.append(self.frequency, last), np.append(self.value, 0.0))
        return result


def with_mtf(T: Array, mtf: MTF, border: int = 32) -> Array:
    """The image under that MTF (besides the Gaussian blur and the pixel's own area)."""
    n_v, n_u = (fft.next_fast_len(n + 2 * border, real=True) for n in T.shape)
    padded = np.pad(T, ((border, n_v - T.shape[0] - border), (border, n_u - T.shape[1] - border)), mode="edge")
    f = np.hypot(fft.fftfreq(n_v)[:, None], fft.rfftfreq(n_u)[None, :])
    filtered = fft.irfft2(fft.rfft2(padded) * mtf.at(f), s=padded.shape)
    return np.asarray(filtered[border : border + T.shape[0], border : border + T.shape[1]])
