"""Pictures as PNG, in the page of the format's own specification (ISO/IEC 15948): 8-bit greyscale, or 8-bit colours."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import ShapeError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
PAETH = 4
"""The filter of every line: shaded pictures are a third smaller than without."""


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def grey_levels(image: ArrayLike, *, low: float = 0.5, high: float = 99.5) -> np.ndarray:
    """8-bit grey values of an image between two percentiles; pixels that are not finite become black."""
    image = np.asarray(image, dtype=np.float64)
    finite = np.isfinite(image)
    if not finite.any():
        return np.zeros(image.shape, dtype=np.uint8)
    bottom, top = np.percentile(image[finite], [low, high])
    span = top - bottom if top > bottom else 1.0
    scaled = np.clip((np.where(finite, image, bottom) - bottom) / span, 0.0, 1.0)
    result: np.ndarray = np.round(255.0 * scaled).astype(np.uint8)
    return result


def grey_png(rows: np.ndarray) -> bytes:
    """PNG of 8-bit grey values (height, width), first row at the top."""
    if rows.ndim != 2 or rows.dtype != np.uint8 or rows.size == 0:
        raise ShapeError(f"a grey picture is a filled (height, width) array of uint8; got {rows.shape} {rows.dtype}")
    return _png(rows, kind=0)


def colour_png(rows: np.ndarray) -> bytes:
    """PNG of 8-bit red, green and blue (height, width, 3), first row at the top."""
    if rows.ndim != 3 or rows.shape[2] != 3 or rows.dtype != np.uint8 or rows.size == 0:
        raise ShapeError(
            f"a colour picture is a filled (height, width, 3) array of uint8; got {rows.shape} {rows.dtype}"
        )
    return _png(rows, kind=2)


def _png(rows: np.ndarray, *, kind: int) -> bytes:
    height, width = rows.shape[:2]
    header = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    # Each line begins with the number of its filter.
    lines = np.hstack([np.full((height, 1), PAETH, dtype=np.uint8), _paeth(rows).reshape(height, -1)]).tobytes()
    return SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", zlib.compress(lines, 9)) + _chunk(b"IEND", b"")


def _paeth(rows: np.ndarray) -> np.ndarray:
    """What each byte differs, modulo 256, from the one that its neighbours predict (9.4 of the specification)."""
    x = np.pad(rows.astype(np.int16), [(1, 0), (1, 0)] + [(0, 0)] * (rows.ndim - 2))
    left, above, corner = x[1:, :-1], x[:-1, 1:], x[:-1, :-1]
    p = left + above - corner
    off_left, off_above, off_corner = abs(p - left), abs(p - above), abs(p - corner)
    nearest = np.where(off_above <= off_corner, above, corner)
    predicted = np.where((off_left <= off_above) & (off_left <= off_corner), left, nearest)
    return np.asarray((x[1:, 1:] - predicted).astype(np.uint8))


def data_uri(png: bytes) -> str:
    """A PNG as a data: address."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
