"""Writers for simulated radiographs and tests; the file row order is made here, as reading it is in `sequence`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tomopose.errors import InputError
from tomopose.files import atomic_file, require_absent
from tomopose.io.images.frames import Image
from tomopose.io.images.sequence import Rows
from tomopose.values import require_types

CHUNK_ROWS = 64
"""So that a small region costs a small read."""


def file_rows(image: Image, rows: Rows) -> Image:
    """image[v, u] in the row order of a file, or back."""
    return np.ascontiguousarray(image[::-1] if rows == "top-first" else image)


@require_types
def write_tiff(path: str | Path, image: Image, *, rows: Rows = "top-first", force: bool = False) -> None:
    """One image[v, u] as a plain TIFF; its type is kept.  FileError if the file exists and `force` is not given."""
    import tifffile

    if image.ndim != 2:
        raise InputError(f"an image is [v, u]; got an array of shape {image.shape}")
    with atomic_file(require_absent(path, force=force)) as temporary:
        tifffile.imwrite(temporary, file_rows(image, rows), photometric="minisblack", metadata=None)


@require_types
def write_hdf5(
    path: str | Path,
    images: Iterable[Image],
    *,
    dataset: str = "images",
    rows: Rows = "top-first",
    force: bool = False,
) -> int:
    """Images [v, u], one after the other, as a stack [frame, row, column]; the row order is written beside it.

    Returns the number of images.  Nothing but one image is held in memory.
    """
    import h5py

    n = 0
    with atomic_file(require_absent(path, force=force)) as temporary, h5py.File(temporary, "w") as file:
        stack = None
        for image in images:
            if stack is None:
                stack = file.create_dataset(
                    dataset,
                    shape=(0, *image.shape),
                    maxshape=(None, *image.shape),
                    dtype=image.dtype,
                    chunks=(1, min(CHUNK_ROWS, image.shape[0]), image.shape[1]),
                )
                stack.attrs["image_rows"] = rows
            if image.shape != stack.shape[1:]:
                raise InputError(f"image {n} has shape {image.shape}, image 0 {stack.shape[1:]}")
            stack.resize(n + 1, axis=0)
            stack[n] = file_rows(image, rows)
            n += 1
        if n == 0:
            raise InputError(f"{path}: there are no images to write")
    return n
