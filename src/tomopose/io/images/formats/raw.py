"""RAW: pixels without a description, read as the caller declares them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError, InputError, UnitError
from tomopose.io.images.frames import Band, Image, read_block, unreadable

DTYPE = re.compile(r"[<>][uif][248]|[<>|]?[ui]1")


@dataclass(frozen=True, kw_only=True)
class RawLayout:
    """How RAW files are laid out.

    shape:   (rows, columns) of a frame.
    dtype:   with its endianness: "<u2" is little-endian uint16, ">u2" big-endian, "<f4" float32.
    header:  bytes before the first frame.
    frames:  frames in a file, or None: as many as fit.
    """

    shape: tuple[int, int]
    dtype: str
    header: int = 0
    frames: int | None = None

    def __post_init__(self) -> None:
        if not DTYPE.fullmatch(str(self.dtype)):
            raise UnitError(
                f"RAW type {self.dtype!r} does not say its endianness; '<u2' (little) or '>u2' (big-endian uint16), "
                "'<f4' and the like are needed"
            )
        rows, columns = (int(n) for n in self.shape)
        if rows < 1 or columns < 1 or self.header < 0 or (self.frames is not None and self.frames < 1):
            raise InputError(f"RAW layout {self} has a size that is not positive")
        object.__setattr__(self, "shape", (rows, columns))


@dataclass(frozen=True, kw_only=True)
class RawSource:
    """Frames of RAW files.  See FrameSource."""

    names: tuple[str, ...]
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    stored: np.dtype[Any]
    frames: tuple[tuple[Path, int], ...]
    warnings: tuple[str, ...] = ()

    def read(self, index: int, band: Band) -> Image:
        path, offset = self.frames[index]
        return read_block(path, offset, self.shape, self.stored, band)


def open_raw(paths: list[Path], names: list[str], layout: RawLayout) -> RawSource:
    """The frames of RAW files.  FileError where a file's length does not fit the layout."""
    stored = np.dtype(layout.dtype)
    step = layout.shape[0] * layout.shape[1] * stored.itemsize
    frames: list[tuple[Path, int]] = []
    frame_names: list[str] = []
    for path, name in zip(paths, names, strict=True):
        try:
            size = path.stat().st_size
        except OSError as error:
            raise unreadable(path, error) from error
        count, rest = divmod(size - layout.header, step)
        if rest or count < 1 or (layout.frames is not None and count != layout.frames):
            raise FileError(
                f"{path} has {size} bytes; {layout.frames or 'whole'} frames of {layout.shape[1]} x {layout.shape[0]} "
                f"pixels {layout.dtype} after a header of {layout.header} bytes need "
                f"{layout.header + (layout.frames or max(count, 1)) * step} ({size % step} bytes of header would fit)",
                path=path,
            )
        for k in range(count):
            frames.append((path, layout.header + k * step))
            frame_names.append(f"{name}[{k}]" if count > 1 else name)
    return RawSource(
        names=tuple(frame_names),
        shape=layout.shape,
        dtype=stored.newbyteorder("="),
        stored=stored,
        frames=tuple(frames),
    )
