"""The part of a radiograph about a ball, as its pixels are in the file: read by range, never the whole image."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from tomopose.io.images import ImageSequence

LARGEST_HALF = 512
"""Half the side of the largest crop, px: 2 MB of 16-bit pixels."""
LOW, HIGH = 0.5, 99.5
"""Percentiles of the crop that are shown as black and white before anybody turns the brightness."""


@dataclass(frozen=True, kw_only=True)
class Crop:
    """pixels: bytes of [v, u], v upwards, little-endian;  head: JSON with u0, v0, width, height, kind, low, high."""

    head: str
    pixels: bytes


def crop(images: ImageSequence, k: int, centre: tuple[float, float], half: int) -> Crop:
    """Pixels of image k within `half` pixels of the centre (u, v), as far as they are on the panel."""
    n_v, n_u = images.shape
    half = int(np.clip(half, 8, LARGEST_HALF))
    u, v = (int(np.clip(round(c), 0, n - 1)) for c, n in zip(centre, (n_u, n_v), strict=True))
    v0, v1, u0, u1 = max(v - half, 0), min(v + half + 1, n_v), max(u - half, 0), min(u + half + 1, n_u)
    part = images.region(k, v0, v1, u0, u1)
    short = part.dtype in (np.uint8, np.uint16)
    pixels = np.ascontiguousarray(part, dtype="<u2" if short else "<f4")
    finite = pixels[np.isfinite(pixels)] if not short else pixels
    low, high = (float(x) for x in np.percentile(finite, [LOW, HIGH])) if finite.size else (0.0, 1.0)
    head = {
        "u0": u0, "v0": v0, "width": u1 - u0, "height": v1 - v0, "kind": "uint16" if short else "float32",
        "low": low, "high": high if high > low else low + 1.0,
    }  # fmt: skip
    return Crop(head=json.dumps(head), pixels=pixels.tobytes())
