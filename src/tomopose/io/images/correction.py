"""From counts to transmission: T = (I - D) / (F - D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.errors import InputError
from tomopose.io.images.frames import Image

LARGEST_BAD_PART = 0.5
"""More bad pixels than this are no bad pixels: dark and flat are exchanged or of another exposure."""
TRANSMISSION_LIMIT = 2.0


@dataclass(frozen=True, kw_only=True)
class FlatField:
    """dark and gain = 1 / (F - D), float32, and bad, bool, each (n_v, n_u)."""

    dark: Image
    gain: Image
    bad: Image

    def transmission(self, part: Image, v0: int, u0: int) -> Image:
        """Transmission, float32, of a part of an image whose pixel [0, 0] is pixel (u0, v0); NaN at bad pixels."""
        where = np.s_[v0 : v0 + part.shape[0], u0 : u0 + part.shape[1]]
        return (part.astype(np.float32) - self.dark[where]) * self.gain[where]


def correction(dark: Image | None, flat: Image | None, bad_pixels: Image | None, shape: tuple[int, int]) -> FlatField:
    """The correction with mean dark and flat images [v, u] (dark 0 and flat 1 where they are absent).

    Pixels where F - D <= 0 or is not finite are bad; so are those of `bad_pixels`.  InputError where a shape does not
    fit or more than half of the pixels would be bad.
    """
    D = np.zeros(shape) if dark is None else np.asarray(dark, dtype=np.float64)
    F = np.ones(shape) if flat is None else np.asarray(flat, dtype=np.float64)
    for name, image in (("dark", D), ("flat", F)):
        if image.shape != shape:
            raise InputError(f"the {name} image is {image.shape} (rows, columns), the images are {shape}")
    span = F - D if flat is not None else F
    bad = ~(np.isfinite(span) & (span > 0)) | ~np.isfinite(D)
    if bad.mean() > LARGEST_BAD_PART:
        raise InputError(
            f"flat minus dark is not above 0 in {100 * bad.mean():.0f} % of the pixels (median "
            f"{np.nanmedian(span):.4g}); were dark and flat exchanged?"
        )
    if bad_pixels is not None:
        bad = bad | bad_pixels
    gain = np.full(shape, np.nan, np.float32)
    gain[~bad] = 1.0 / span[~bad]
    bad.setflags(write=False)
    return FlatField(dark=D.astype(np.float32), gain=gain, bad=bad)


def require_uncorrected(first: Image, flat: Image) -> None:
    """InputError if the images are transmission already and the flat image is counts: they would be corrected twice."""
    if first.dtype.kind == "f" and np.nanpercentile(first, 99) < TRANSMISSION_LIMIT < np.nanmedian(flat) / 10:
        raise InputError(
            f"the images look flat-corrected already (99 % of the pixels below {np.nanpercentile(first, 99):.3g}), but "
            f"a flat image of counts (median {np.nanmedian(flat):.4g}) is given; leave dark and flat away"
        )
