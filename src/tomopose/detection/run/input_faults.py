"""Why no ball was found: faults of input that an image shows by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from tomopose.detection.image import detect_image
from tomopose.detection.reading import Image
from tomopose.errors import InputError, TomoposeError
from tomopose.geometry.scanner import Scanner
from tomopose.units import Array

SAMPLED_ROWS = 64
SMOOTHER = 4.0
"""Times by which exchanging each pixel's bytes must make an image smoother."""
SQUARE = 0.01
"""Relative difference of the pitches below which an exchange of the two makes none."""


def fault_of_input(image: Image, scanner: Scanner, **options: Any) -> InputError | None:
    """What is wrong with an image, or with the pitches, in which no ball was found; options: of detect_image."""
    if bytes_are_exchanged(image):
        return InputError("each pixel's two bytes are exchanged: the image is smooth the other way round; read it so")
    if abs(scanner.p_u / scanner.p_v - 1.0) > SQUARE:
        other = replace(scanner, p_u=scanner.p_v, p_v=scanner.p_u)
        try:
            detect_image(image, other, **options)
        except TomoposeError:
            return None
        return InputError(
            f"p_u = {scanner.p_u:g} mm and p_v = {scanner.p_v:g} mm are exchanged: the other way round there is a ball"
        )
    return None


def bytes_are_exchanged(image: Any) -> bool:
    """Whether an image of 16-bit counts is far smoother along its rows with every pixel's bytes exchanged."""
    step = max(1, int(image.shape[0]) // SAMPLED_ROWS)
    whole = hasattr(image, "region")
    rows = [image.region(v, v + 1, 0, image.shape[1])[0] if whole else image[v] for v in range(0, image.shape[0], step)]
    values = np.asarray(rows)
    if values.dtype.kind not in "ui" or values.dtype.itemsize != 2:
        return False
    return roughness(values) > SMOOTHER * roughness(values.byteswap())


def roughness(values: Array) -> float:
    """Mean square of neighbours' differences over twice the variance: 1 for white noise, near 0 for a smooth image."""
    x = values.astype(np.float64)
    return float(np.mean(np.diff(x, axis=1) ** 2) / max(2.0 * float(np.var(x)), 1e-300))
