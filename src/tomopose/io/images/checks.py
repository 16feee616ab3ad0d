"""What pixels and shapes give away about a wrong description."""

from __future__ import annotations

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.scanner import Scanner
from tomopose.io.images.frames import Image

LARGEST_BINNING = 8
SMOOTHER = 8.0
"""An image whose neighbours differ this many times less after its bytes are exchanged was read the wrong way round:
detector noise is a small part of the range, and a noisy low byte taken for the high one is not."""
WINDOW = 256


def require_scanner_shape(shape: tuple[int, int], scanner: Scanner, name: str) -> None:
    """ShapeError, with the likely reason, if images (rows, columns) are not of the scanner's size."""
    if shape == scanner.shape:
        return
    found = f"{name} is {shape[1]} x {shape[0]} pixels (u x v), the scanner {scanner.n_u} x {scanner.n_v}"
    if shape == scanner.shape[::-1]:
        raise ShapeError(f"{found}: are n_u_px and n_v_px exchanged, or the images turned by 90 degrees?")
    for b in range(2, LARGEST_BINNING + 1):
        if shape == (scanner.n_v // b, scanner.n_u // b):
            raise ShapeError(f"{found}: the images are binned by {b}; use Scanner.binned({b}), which scales the pitch")
        if scanner.shape == (shape[0] // b, shape[1] // b):
            raise ShapeError(f"{found}: the scanner is that of images binned by {b}; these are not binned")
    if shape[0] <= scanner.n_v and shape[1] <= scanner.n_u:
        raise ShapeError(f"{found}: is this a read-out window? Say where it lies: Scanner.cropped(u=, v=, n_u=, n_v=)")
    raise ShapeError(f"{found}: this scanner file does not belong to these images")


def middle(shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """(v0, v1, u0, u1) of the window in an image's middle by which its bytes are judged."""
    (v0, v1), (u0, u1) = ((max(0, (n - WINDOW) // 2), max(0, (n - WINDOW) // 2) + min(n, WINDOW)) for n in shape)
    return v0, v1, u0, u1


def endianness_note(part: Image, name: str) -> list[str]:
    """InputError if the `middle` of a 16-bit image was read with its bytes exchanged; a note if it carries 8 bits
    only."""
    if part.dtype.kind not in "ui" or part.dtype.itemsize != 2 or part.shape[1] < 2:
        return []
    low, high = part & 0xFF, part.astype(np.uint16) >> 8
    if np.ptp(low) == 0 and np.ptp(high) > 0:
        return [f"{name}: the low byte of every pixel is {int(low.flat[0])}; only 8 of 16 bits carry anything"]
    as_read, exchanged = _roughness(part), _roughness(part.byteswap())
    if exchanged > 0 and as_read > SMOOTHER * exchanged:
        raise InputError(
            f"{name}: the two bytes of each pixel look exchanged (neighbours differ by {as_read:.0f} on average, and "
            f"by {exchanged:.0f} after exchanging them); declare the other endianness ('<u2' or '>u2'), or the header"
        )
    return []


def _roughness(image: Image) -> float:
    return float(np.abs(np.diff(image.astype(np.float64), axis=1)).mean())
