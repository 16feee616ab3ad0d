"""ImageSequence: radiographs as image[v, u], read when they are asked for.

Image files have their own row order.  Here, and nowhere else in the package, rows are turned so that the row index is
v: with "top-first" files, file row r is v = n_v - 1 - r.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, overload

import numpy as np

from tomopose.errors import InputError
from tomopose.io.images.correction import FlatField
from tomopose.io.images.frames import FrameSource, Image
from tomopose.reading import reading

Rows = Literal["top-first", "bottom-first"]


@dataclass(frozen=True, kw_only=True)
class ImageSequence:
    """n radiographs of one shape.  Holds no pixels and no open files, so worker processes can receive it.

    source:      where the pixels come from.
    rows:        row order of the files.
    index:       which frames of the source, in which order.
    correction:  dark, flat and bad pixels; with it images are transmission, float32, NaN at bad pixels.
    warnings:    what was accepted but should be looked at.
    """

    source: FrameSource
    rows: Rows
    index: tuple[int, ...]
    correction: FlatField | None = None
    bad_pixels: Image | None = None
    warnings: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.index)

    @property
    def shape(self) -> tuple[int, int]:
        """(n_v, n_u) of one image."""
        return self.source.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the pixels that are handed out."""
        return np.dtype(np.float32) if self.correction is not None else self.source.dtype

    @property
    def names(self) -> tuple[str, ...]:
        """File names; `stack.tif[3]` for frame 3 of a file with several."""
        return tuple(self.source.names[i] for i in self.index)

    @property
    def mask(self) -> Image | None:
        """(n_v, n_u) bool, true at bad pixels; None where none are known."""
        return self.bad_pixels if self.correction is None else self.correction.bad

    def region(self, i: int, v0: int, v1: int, u0: int, u1: int) -> Image:
        """Pixels [v0:v1, u0:u1] of image i.  Only that part is read, as far as the format allows.

        InputError where the region leaves the image; FileError where the file cannot be read.
        """
        n_v, n_u = self.shape
        if not (0 <= v0 <= v1 <= n_v and 0 <= u0 <= u1 <= n_u):
            raise InputError(f"region v {v0}:{v1}, u {u0}:{u1} is not inside an image of {n_u} x {n_v} pixels")
        k = self.index[i]
        with reading(self.source.names[k], "radiograph"):
            if self.rows == "top-first":
                part = np.array(self.source.read(k, (n_v - v1, n_v - v0, u0, u1))[::-1], order="C")
            else:
                part = np.array(self.source.read(k, (v0, v1, u0, u1)), order="C")
        return part if self.correction is None else self.correction.transmission(part, v0, u0)

    def fetch(self, i: int, v0: int, v1: int) -> None:
        """Asks the system for rows v0 to v1 of image i, where the format allows, so that they are there when read."""
        if hasattr(self.source, "fetch"):
            n_v = self.shape[0]
            self.source.fetch(self.index[i], *((n_v - v1, n_v - v0) if self.rows == "top-first" else (v0, v1)))

    @overload
    def __getitem__(self, i: int) -> Image: ...
    @overload
    def __getitem__(self, i: slice) -> ImageSequence: ...
    def __getitem__(self, i: int | slice) -> Image | ImageSequence:
        """Image i as image[v, u], or a part of the sequence."""
        if isinstance(i, slice):
            return self.select(range(len(self))[i])
        return self.region(i, 0, self.shape[0], 0, self.shape[1])

    def __iter__(self) -> Iterator[Image]:
        return (self[i] for i in range(len(self)))

    def select(self, index: Sequence[int] | Image) -> ImageSequence:
        """The images with those indices (or that mask), in that order."""
        chosen = np.arange(len(self))[np.asarray(index)] if len(index) else np.empty(0, np.intp)
        return ImageSequence(
            source=self.source,
            rows=self.rows,
            index=tuple(self.index[int(i)] for i in chosen),
            correction=self.correction,
            bad_pixels=self.bad_pixels,
            warnings=self.warnings,
        )
