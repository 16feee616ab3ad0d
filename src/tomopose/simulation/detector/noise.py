"""Random numbers that depend on where they are used, not on who draws them, and the photon noise made from them.

Number n of a frame is the n-th output of the SplitMix64 generator (Steele, Lea and Flood, OOPSLA 2014) started at the
frame's key, computed directly: so bands of rows can be made in any order by any number of threads or processes with the
same bytes as result.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.kernel_cache import njit

FEW = 60.0
"""Below this mean a Poisson number is drawn exactly; above it the normal approximation with skewness is used."""


def frame_key(seed: int, frame: int, stream: int = 0) -> np.uint64:
    """The key of one frame's random numbers."""
    return np.uint64(np.random.SeedSequence([seed, frame, stream]).generate_state(1, np.uint64)[0])


@njit(cache=True, nogil=True, inline="always")
def _mix(key: np.uint64, n: int) -> Any:
    x = key + (np.uint64(n) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True, nogil=True, inline="always")
def _two_normals(key: np.uint64, n: int) -> Any:
    x = _mix(key, n)
    u = (np.float64(x >> np.uint64(32)) + 0.5) * 2.0**-32
    v = (np.float64(x & np.uint64(0xFFFFFFFF)) + 0.5) * 2.0**-32
    r = np.sqrt(np.float32(-2.0) * np.log(min(np.float32(u), np.float32(1.0))))
    a = np.float32(2.0 * np.pi * v)
    return r * np.cos(a), r * np.sin(a)


@njit(cache=True, nogil=True)
def _few(key: np.uint64, n: int, mean: float) -> float:
    """A Poisson number by inversion, exact for small means."""
    u = (np.float64(_mix(key, n) >> np.uint64(11)) + 0.5) * 2.0**-53
    p = np.exp(-mean)
    k, total = 0, p
    while u > total and k < 400:
        k += 1
        p *= mean / k
        total += p
    return float(k)


@njit(cache=True, nogil=True, inline="always")
def _quanta(key: np.uint64, n: int, mean: float, z: float) -> float:
    if mean < FEW:
        return _few(key, n, mean) if mean > 0 else 0.0
    result: float = mean + np.sqrt(mean) * z + (z * z - 1) / 6
    return result


@njit(cache=True, nogil=True)
def add_photon_noise(mean: np.ndarray, key: np.uint64, v_0: int, v_1: int, out: np.ndarray) -> None:
    """Photon numbers `out` (n_v, n_u) with that mean, rows v_0 to v_1: Poisson, by the frame's key."""
    n_u = mean.shape[1]
    half = (n_u + 1) // 2
    for v in range(v_0, v_1):
        for k in range(half):
            z_0, z_1 = _two_normals(key, v * half + k)
            u = 2 * k
            out[v, u] = _quanta(key, -1 - (v * n_u + u), mean[v, u], z_0)
            if u + 1 < n_u:
                out[v, u + 1] = _quanta(key, -1 - (v * n_u + u + 1), mean[v, u + 1], z_1)


@njit(cache=True, nogil=True)
def add_normal_noise(image: np.ndarray, sigma: float, key: np.uint64, v_0: int, v_1: int) -> None:
    """Add white normal noise to rows v_0 to v_1 of an image, in place."""
    n_u = image.shape[1]
    half = (n_u + 1) // 2
    for v in range(v_0, v_1):
        for k in range(half):
            z_0, z_1 = _two_normals(key, v * half + k)
            image[v, 2 * k] += sigma * z_0
            if 2 * k + 1 < n_u:
                image[v, 2 * k + 1] += sigma * z_1


@njit(cache=True, nogil=True)
def digitise(signal: np.ndarray, gain: float, offset: float, top: float, v_0: int, v_1: int, out: np.ndarray) -> None:
    """Grey values of rows v_0 to v_1: round(offset + gain signal), held between 0 and `top`."""
    for v in range(v_0, v_1):
        for u in range(signal.shape[1]):
            g = offset + gain * signal[v, u] + 0.5
            out[v, u] = 0 if g < 0 else (top if g > top else np.uint16(g))


@njit(cache=True, nogil=True, inline="always")
def _mirrored(k: int, n: int) -> int:
    """Index k of n, reflected about the first and the last element."""
    k = -k if k < 0 else k
    return max(2 * (n - 1) - k, 0) if k > n - 1 else k


@njit(cache=True, nogil=True)
def spread_rows(image: np.ndarray, k: np.ndarray, v_0: int, v_1: int, out: np.ndarray) -> None:
    """Rows v_0 to v_1 of an image correlated with the odd kernel k along v, float32."""
    n_v, n_u = image.shape
    half = len(k) // 2
    for v in range(v_0, v_1):
        out[v, :] = np.float32(0.0)
        for a in range(len(k)):
            row, weight = _mirrored(v + a - half, n_v), k[a]
            for u in range(n_u):
                out[v, u] += weight * image[row, u]


@njit(cache=True, nogil=True)
def spread_columns(image: np.ndarray, k: np.ndarray, mean: np.ndarray, v_0: int, v_1: int, out: np.ndarray) -> None:
    """mean + an image correlated with the odd kernel k along u, rows v_0 to v_1."""
    n_u = image.shape[1]
    half = len(k) // 2
    for v in range(v_0, v_1):
        for u in range(n_u):
            total = np.float32(0.0)
            if half <= u < n_u - half:
                for a in range(len(k)):
                    total += k[a] * image[v, u + a - half]
            else:
                for a in range(len(k)):
                    total += k[a] * image[v, _mirrored(u + a - half, n_u)]
            out[v, u] = mean[v, u] + total
