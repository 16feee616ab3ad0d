"""The detector: from the noiseless image to grey values.

quanta     q = Poisson(q_0 profile signal), spread over neighbours by the scintillator (noise correlation)
binned     q summed over binning x binning detector pixels, as charge, before it is read out
raw        g = dark + gain q + readout noise, held between 0 and saturation, rounded to `bits`
corrected  c = white (g - dark) / (flat - dark), with averaged dark and flat images that have their own noise
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.scanner import PARAMETER_UNITS, Scanner
from tomopose.simulation.detector.noise import (
    add_normal_noise,
    add_photon_noise,
    digitise,
    frame_key,
    spread_columns,
    spread_rows,
)
from tomopose.simulation.detector.scatter_glare_mtf import MTF, Glare, Scatter
from tomopose.simulation.projector.view import in_bands
from tomopose.units import Array

PATTERN, FLATS = 1, 2
"""Streams of random numbers beside the frames' own: the fixed pattern, the flat and dark images."""


@dataclass(frozen=True, kw_only=True)
class Detector:
    """What the detector does to the image.  Pixels are those of the image, where not said otherwise.

    snr:         of one pixel of one averaged frame in the empty beam, before readout noise (inf: no noise); or
    photons:     detected quanta per detector pixel and single exposure, which then fixes snr.
    binning:     a pixel is binning x binning detector pixels, whose charges are summed before they are digitised.
    averages:    exposures averaged into a frame.
    blur_sigma:  px, Gaussian, before the pixel integrates.  mtf: a measured MTF besides.
    noise_sigma: detector px, Gaussian: how far one quantum's light spreads; correlates the noise (its power is
                 exp(-4 pi^2 s^2 f^2)).
    white:       grey value of the empty beam.  bits: depth.  saturation: largest grey value.
    output:      "corrected" (dark and flat removed) or "raw".
    dark, readout_noise: grey values.  gain_spread, dark_spread: pixel-to-pixel standard deviations (relative; grey).
    dead_share:  share of pixels that always read 0.  flats: dark and flat images averaged for the correction.
    falloff:     whether the beam weakens towards the panel's rim (distance and obliquity).
    lag:         share of the frame before, of the one before that, ..., that a frame still shows.
    cells:       a pixel is cut in cells x cells before the blur.
    """

    snr: float = 200.0
    photons: float | None = None
    averages: int = 1
    binning: int = 1
    blur_sigma: float = 0.7
    mtf: MTF | None = None
    noise_sigma: float = 0.0
    white: float = 45000.0
    bits: int = 16
    saturation: float | None = None
    output: Literal["corrected", "raw"] = "corrected"
    dark: float = 0.0
    readout_noise: float = 0.0
    gain_spread: float = 0.0
    dark_spread: float = 0.0
    dead_share: float = 0.0
    flats: int = 50
    falloff: bool = False
    lag: tuple[float, ...] = ()
    scatter: Scatter = field(default_factory=Scatter)
    glare: Glare = field(default_factory=Glare)
    cells: int = 2

    def __post_init__(self) -> None:
        if self.photons is not None:
            if not self.photons > 0:
                raise InputError(f"detector: photons is {self.photons}; a positive number is needed")
            object.__setattr__(self, "snr", math.sqrt(self.photons * self.averages / self.kernel_power))
        if not self.snr > 0:
            raise InputError(f"detector: snr is {self.snr}; a positive number is needed")
        for name in ("blur_sigma", "noise_sigma", "dark", "readout_noise", "gain_spread", "dark_spread"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"detector: {name} is {value}; it may not be negative")
        if not 0 <= self.dead_share < 0.5:
            raise InputError(f"detector: dead_share is {self.dead_share}; it lies between 0 and 0.5")
        if min(self.lag, default=0.0) < 0 or sum(self.lag) >= 1:
            raise InputError(f"detector: lag is {self.lag}; shares that are not negative and stay below 1 are needed")
        if self.output not in ("corrected", "raw"):
            raise InputError(f'detector: output is {self.output!r}; "corrected" or "raw" is needed')
        if not 1 <= self.bits <= 16:
            raise InputError(f"detector: bits is {self.bits}; 1 to 16 are possible")
        if not 0 < self.white < 2**self.bits:
            raise InputError(f"detector: white is {self.white:g}; it must lie below {2**self.bits}")
        if min(self.averages, self.binning, self.flats, self.cells) < 1 or self.cells > 16:
            raise InputError("detector: averages, binning, flats and cells are 1 or more, cells at most 16")

    @property
    def kernel_power(self) -> float:
        """Relative variance of a pixel times the quanta of a detector pixel: what correlation and binning leave."""
        c = np.convolve(self.noise_kernel, np.ones(self.binning)) / self.binning
        return float((c**2).sum() ** 2)

    @property
    def noise_kernel(self) -> Array:
        """1D weights, adding up to 1, of how a quantum's light spreads."""
        if self.noise_sigma == 0:
            return np.ones(1)
        half = math.ceil(4 * self.noise_sigma)
        k = np.exp(-0.5 * (np.arange(-half, half + 1) / self.noise_sigma) ** 2)
        return np.asarray(k / k.sum())

    @property
    def quanta(self) -> float:
        """Quanta per detector pixel and frame in the empty beam."""
        return self.snr**2 * self.kernel_power

    @property
    def top(self) -> float:
        """The largest grey value."""
        return float(2**self.bits - 1) if self.saturation is None else min(self.saturation, float(2**self.bits - 1))

    @property
    def patterned(self) -> bool:
        """Whether pixels differ, so that a correction has something to do."""
        return bool(self.dark or self.gain_spread or self.dark_spread or self.falloff)


def beam_profile(scanner: Scanner, detector: Detector) -> Array | None:
    """The empty beam over the panel (n_v, n_u), 1 at its strongest; None where it is even.

    A pixel gets its share of an isotropic point source: the solid angle that it subtends, which is near
    p_u p_v cos(obliquity) / distance^2. A rectangle from the source's foot point on the panel to (a, b), at the
    distance d, subtends atan(a b / (d sqrt(a^2 + b^2 + d^2))).
    """
    if not detector.falloff:
        return None
    U, V, O = scanner.panel
    a = O @ (U / np.linalg.norm(U)) + (np.arange(scanner.n_u + 1) - 0.5) * np.linalg.norm(U)
    b = O @ (V / np.linalg.norm(V)) + (np.arange(scanner.n_v + 1)[:, None] - 0.5) * np.linalg.norm(V)
    d = abs(O @ np.cross(U, V)) / (np.linalg.norm(U) * np.linalg.norm(V))
    solid_angle = np.diff(np.diff(np.arctan2(a * b, d * np.sqrt(a * a + b * b + d * d)), axis=0), axis=1)
    return np.asarray(solid_angle / solid_angle.max())


@functools.lru_cache(maxsize=4)
def fixed_pattern(detector: Detector, shape: tuple[int, int], seed: int) -> tuple[Any, Any, Any]:
    """(gain, dark, dead) images (n_v, n_u): factors around 1, grey values, and which pixels read 0.

    A binned pixel has the mean of its detector pixels; those that are dead give nothing.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0, PATTERN]))
    fine = (shape[0] * detector.binning, shape[1] * detector.binning)
    gain = np.maximum(1 + detector.gain_spread * rng.standard_normal(fine), 0.0)
    dark = detector.dark + detector.dark_spread * rng.standard_normal(fine)
    dead = rng.random(fine) < detector.dead_share
    if detector.binning == 1:
        return gain, dark, dead
    gain, dark = (blocks(np.where(dead, 0.0, a), detector.binning) for a in (gain, dark))
    return gain / detector.binning**2, dark / detector.binning**2, blocks(~dead, detector.binning) == 0


def blocks(image: np.ndarray, b: int) -> Any:
    """Sums over blocks of b x b pixels."""
    return image.reshape(image.shape[0] // b, b, image.shape[1] // b, b).sum(axis=(1, 3))


def counted(signal: Array, detector: Detector, *, key: np.uint64, threads: int) -> Any:
    """Quanta (n_v, n_u) that a pixel reads, float32: Poisson numbers about signal x quanta, spread by the scintillator,
    summed over the detector pixels that are binned."""
    b = detector.binning
    if detector.noise_sigma == 0:
        # A sum of Poisson numbers is one.
        mean, quanta = signal * (detector.quanta * b * b), np.empty(signal.shape, dtype=np.float32)
        in_bands(lambda lo, hi: add_photon_noise(mean, key, lo, hi, quanta), len(mean), threads)
        return quanta
    mean = signal * detector.quanta
    if b > 1:
        mean = mean.repeat(b, axis=0).repeat(b, axis=1)
    quanta, k = np.empty(mean.shape, dtype=np.float32), detector.noise_kernel.astype(np.float32)
    rows = np.empty_like(quanta)
    in_bands(lambda lo, hi: add_photon_noise(mean, key, lo, hi, quanta), len(mean), threads)
    np.subtract(quanta, mean, out=quanta, casting="same_kind")
    in_bands(lambda lo, hi: spread_rows(quanta, k, lo, hi, rows), len(mean), threads)
    in_bands(lambda lo, hi: spread_columns(rows, k, mean, lo, hi, quanta), len(mean), threads)
    return quanta if b == 1 else blocks(quanta, b)


def _raw(signal: Array, detector: Detector, *, seed: int, frame: int, threads: int) -> Array:
    """Grey values before rounding: quanta, their spread, gain, dark, readout noise."""
    n_v = signal.shape[0]
    gain, dark, _ = (
        fixed_pattern(detector, signal.shape, seed) if detector.patterned or detector.dead_share else (1, 0, 0)
    )
    if math.isinf(detector.snr):
        quanta, scale = signal, detector.white
    else:
        quanta = counted(signal, detector, key=frame_key(seed, frame), threads=threads)
        scale = detector.white / (detector.quanta * detector.binning**2)
    raw = dark + gain * (scale * quanta.astype(np.float64))
    if detector.readout_noise > 0:
        sigma, key = detector.readout_noise / math.sqrt(detector.averages), frame_key(seed, frame, 8)
        in_bands(lambda lo, hi: add_normal_noise(raw, sigma, key, lo, hi), n_v, threads)
    return np.asarray(raw)


def reference_images(detector: Detector, scanner: Scanner, seed: int) -> tuple[Any, Any]:
    """(dark, flat), grey values: means of `flats` images, with what noise the averaging leaves."""
    names = [*PARAMETER_UNITS, "n_u", "n_v"]
    return _reference_images(detector, tuple((name, getattr(scanner, name)) for name in names), seed)


@functools.lru_cache(maxsize=2)
def _reference_images(detector: Detector, panel: tuple[tuple[str, Any], ...], seed: int) -> tuple[Any, Any]:
    scanner = Scanner(**dict(panel))
    profile = beam_profile(scanner, detector)
    empty = np.ones(scanner.shape) if profile is None else profile
    gain, dark, dead = fixed_pattern(detector, scanner.shape, seed)
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0, FLATS]))
    flat = dark + gain * detector.white * empty
    photon = 0.0 if math.isinf(detector.snr) else gain * detector.white * np.sqrt(empty) / detector.snr
    rest = detector.readout_noise / math.sqrt(detector.flats * detector.averages)
    flat = flat + photon / math.sqrt(detector.flats) * rng.standard_normal(scanner.shape)
    flat += rest * rng.standard_normal(scanner.shape)
    dark = dark + rest * rng.standard_normal(scanner.shape)
    return np.where(dead, 0.0, dark), np.where(dead, 0.0, flat)


def expose(T: Array, detector: Detector, scanner: Scanner, *, seed: int, frame: int, threads: int = 1) -> Any:
    """Grey values, uint16, of a noiseless image (n_v, n_u), given as a share of the empty beam."""
    n_v = T.shape[0]
    out = np.empty(T.shape, dtype=np.uint16)
    if not (detector.patterned or detector.dead_share or detector.readout_noise or math.isinf(detector.snr)):
        quanta = counted(T, detector, key=frame_key(seed, frame), threads=threads)
        gain = detector.white / (detector.quanta * detector.binning**2)
        in_bands(lambda lo, hi: digitise(quanta, gain, 0.0, detector.top, lo, hi, out), n_v, threads)
        return out
    profile = beam_profile(scanner, detector)
    raw = _raw(T if profile is None else T * profile, detector, seed=seed, frame=frame, threads=threads)
    dead = fixed_pattern(detector, T.shape, seed)[2] if detector.dead_share else None
    if dead is not None:
        raw[dead] = 0.0
    # The converter rounds and saturates before any correction can act.
    raw = np.minimum(np.round(np.maximum(raw, 0.0)), detector.top)
    if detector.output == "corrected" and detector.patterned:
        dark, flat = reference_images(detector, scanner, seed)
        raw = detector.white * (raw - dark) / np.maximum(flat - dark, 1e-3 * detector.white)
        if dead is not None:
            raw[dead] = 0.0
    in_bands(lambda lo, hi: digitise(raw, 1.0, 0.0, detector.top, lo, hi, out), n_v, threads)
    return out
