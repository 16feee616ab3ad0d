"""Units inside: mm, rad, px, keV, s.  Conversion happens at the border, in readers and writers; here are its tools.

`value_with_uncertainty` prints a number in the concise form of JCGM 100:2008, 7.2.2: 12.3(4) um.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating[Any]]
"""float32 where images and volumes are held, else float64."""

MICROMETRES_PER_MM = 1000.0
MICRORADIANS_PER_RAD = 1.0e6


def float_array(values: ArrayLike) -> Array:
    """A float64 copy that cannot be written to, so that value types stay frozen."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def value_with_uncertainty(value: float, u: float, unit: str = "") -> str:
    """`12.3(4) um`: the uncertainty `u` in units of the last digit, two digits where it begins with 1.

    A zero, infinite or undefined `u` gives the words "not determinable".
    """
    tail = f" {unit}" if unit else ""
    if not (math.isfinite(value) and math.isfinite(u)) or u <= 0:
        return f"{value:.6g}{tail} (uncertainty not determinable)"
    exponent = math.floor(math.log10(u))
    digits = 2 if u / 10.0**exponent < 1.95 else 1
    last = exponent - digits + 1
    scaled = round(u / 10.0**last)
    if last >= 0:
        return f"{round(value / 10.0**last) * 10**last}({scaled * 10**last}){tail}"
    return f"{value:.{-last}f}({scaled}){tail}"


def rows_at(n: int, index: object) -> np.ndarray:
    """Row numbers (m,) out of 0 .. n - 1 that a mask, a slice or a list of indices means."""
    return np.arange(n)[index if isinstance(index, slice) else np.asarray(index)]
