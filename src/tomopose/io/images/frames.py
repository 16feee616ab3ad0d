"""What every image format offers: frames by index, read in part, in the row order of the file."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.files import NUMBER_RUN

Image = np.ndarray[Any, np.dtype[Any]]
Band = tuple[int, int, int, int]
"""Rows r0 to r1 and columns c0 to c1, ends excluded, in the row order of the file."""


class FrameSource(Protocol):
    """Frames of one shape and type.  `read` gives file rows r0 to r1 and columns c0 to c1 of one frame."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def dtype(self) -> np.dtype[Any]: ...
    def read(self, index: int, band: Band) -> Image: ...


def read_block(path: Path, offset: int, shape: tuple[int, int], dtype: np.dtype[np.generic], band: Band) -> Image:
    """Part of an uncompressed image that lies in one piece in a file: a mapped view, so that it is copied only once.

    dtype may be of the other endianness; the result is native.  FileError names a file that is too short.
    """
    r0, r1, c0, c1 = band
    try:
        with open(path, "rb") as stream:
            short = offset + shape[0] * shape[1] * dtype.itemsize - os.fstat(stream.fileno()).st_size
            if short > 0:
                raise FileError(f"{path} is truncated: it ends {short} bytes too early; copy it again", path=path)
            image = np.memmap(stream, dtype, "r", offset, shape)
    except OSError as error:
        raise unreadable(path, error) from error
    return image[r0:r1, c0:c1].astype(dtype.newbyteorder("="), copy=False)


def fetch_ahead(path: Path, offset: int, count: int) -> None:
    """Asks the system for bytes of a file without waiting for them: a hint, which some systems cannot be given."""
    if not hasattr(os, "posix_fadvise"):
        return
    try:
        with open(path, "rb") as stream:
            os.posix_fadvise(stream.fileno(), offset, count, os.POSIX_FADV_WILLNEED)
    except OSError:
        return  # reading the file will say what is wrong with it


def unreadable(path: Path, error: OSError) -> FileError:
    """The FileError for a file that the system does not let us read."""
    why = "does not exist" if error.errno == errno.ENOENT else f"cannot be read: {error.strerror or error}"
    return FileError(f"{path} {why}", path=path)


def require_one_kind(kinds: list[tuple[str, tuple[int, int], np.dtype[np.generic]]]) -> None:
    """InputError naming the first frame, of (name, shape, dtype) each, that differs from frame 0."""
    name_0, shape_0, dtype_0 = kinds[0]
    for name, shape, dtype in kinds[1:]:
        if shape != shape_0:
            raise InputError(
                f"{name} is {shape[1]} x {shape[0]} pixels (columns x rows), {name_0} is {shape_0[1]} x {shape_0[0]}; "
                "all images of a sequence have one shape"
            )
        if dtype != dtype_0:
            raise InputError(f"{name} holds {dtype.name}, {name_0} {dtype_0.name}; all images have one type")


def require_grey(name: str, dtype: np.dtype[np.generic], samples: int = 1) -> None:
    """InputError for colour, alpha, complex or Boolean pixels."""
    if samples != 1:
        raise InputError(
            f"{name} has {samples} values a pixel (colour or transparency); a radiograph has one grey value: export "
            "the detector's own 16-bit grey data"
        )
    if dtype.kind not in "uif" or dtype.itemsize > 8:
        raise InputError(f"{name} holds pixels of type {dtype}; whole numbers or floats are needed")


def numbers_in_names(names: tuple[str, ...]) -> list[int] | None:
    """The running number of each name, if the names differ in exactly one number; None otherwise."""
    parts = [NUMBER_RUN.split(name) for name in names]
    if len(names) < 2 or len({len(p) for p in parts}) != 1:
        return None
    varying = [k for k in range(len(parts[0])) if len({int(p[k]) if k % 2 else p[k] for p in parts}) > 1]
    if len(varying) != 1 or varying[0] % 2 == 0:
        return None
    return [int(p[varying[0]]) for p in parts]


MOST_MISSING = 3
"""A series that leaves out more than this many numbers for each one there is no running number."""


def missing_numbers(names: tuple[str, ...]) -> list[int]:
    """Numbers that a numbered series leaves out, by its commonest step; empty where nothing is missing or numbered."""
    numbers = numbers_in_names(names)
    if numbers is None or len(numbers) < 3:
        return []
    steps = np.diff(sorted(numbers))
    if steps.min() <= 0:
        return []
    values, counts = np.unique(steps, return_counts=True)
    step = int(values[counts.argmax()])
    if (max(numbers) - min(numbers)) // step > MOST_MISSING * len(numbers):
        return []  # times or serial numbers, which count nothing
    present = set(numbers)
    return [k for k in range(min(numbers), max(numbers), step) if k not in present]
