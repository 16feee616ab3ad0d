"""The detector: from transmission to grey values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.simulation.noise import add_photon_noise, digitise, frame_key
from tomopose.simulation.projector import in_bands
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Detector:
    """snr: of one pixel in the empty beam (inf: no noise); blur_sigma: px; white: grey value of the empty beam;
    bits: depth; cells: a pixel is cut in cells x cells before the blur."""

    snr: float = 200.0
    blur_sigma: float = 0.7
    white: float = 45000.0
    bits: int = 16
    cells: int = 2

    def __post_init__(self) -> None:
        if not self.snr > 0:
            raise InputError(f"detector: snr is {self.snr}; a positive number is needed")
        if not (math.isfinite(self.blur_sigma) and self.blur_sigma >= 0):
            raise InputError(f"detector: blur_sigma is {self.blur_sigma} px; it may not be negative")
        if not 1 <= self.bits <= 16:
            raise InputError(f"detector: bits is {self.bits}; 1 to 16 are possible")
        if not 0 < self.white < 2**self.bits:
            raise InputError(f"detector: white is {self.white:g}; it must lie below {2**self.bits}")
        if not 1 <= self.cells <= 16:
            raise InputError(f"detector: cells is {self.cells}; 1 to 16 are possible")


def expose(T: Array, detector: Detector, *, seed: int, frame: int, threads: int = 1) -> Any:
    """Grey values, uint16, of a transmission image (n_v, n_u)."""
    n_v = T.shape[0]
    out = np.empty(T.shape, dtype=np.uint16)
    top = float(2**detector.bits - 1)
    if math.isinf(detector.snr):
        in_bands(lambda lo, hi: digitise(T, detector.white, 0.0, top, lo, hi, out), n_v, threads)
        return out
    quanta, key = detector.snr**2, frame_key(seed, frame)
    signal = np.empty(T.shape, dtype=np.float32)
    mean = T * quanta

    def work(lo: int, hi: int) -> None:
        add_photon_noise(mean, key, lo, hi, signal)
        digitise(signal, detector.white / quanta, 0.0, top, lo, hi, out)

    in_bands(work, n_v, threads)
    return out
