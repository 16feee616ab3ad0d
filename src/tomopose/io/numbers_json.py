"""Numbers in JSON that need not be finite: nan is null, infinities are the words "inf" and "-inf"."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tomopose.units import Array


def encode(value: Any) -> Any:
    """A number or nested lists of numbers as JSON holds them."""
    if isinstance(value, (np.ndarray, list, tuple)):
        return [encode(v) for v in value]
    number = float(value)
    if math.isnan(number):
        return None
    return number if math.isfinite(number) else ("inf" if number > 0 else "-inf")


def decode(value: Any) -> Any:
    """The inverse of `encode`, as floats and nested lists."""
    if isinstance(value, list):
        return [decode(v) for v in value]
    return math.nan if value is None else float(value)


def decode_array(value: object, *shape: int) -> Array:
    """An array of that shape; ValueError where it has another."""
    array = np.array(decode(value), dtype=np.float64)
    return array.reshape(shape) if array.size == 0 else _exactly(array, shape)


def _exactly(array: Array, shape: tuple[int, ...]) -> Array:
    if array.shape != tuple(n if n >= 0 else array.shape[k] for k, n in enumerate(shape)):
        raise ValueError(f"an array of shape {array.shape} is given where {shape} is needed")
    return array
