"""A stack of radiographs in HDF5, written frame by frame and gone on with after an interruption."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from tomopose.io.images.frames import Image
from tomopose.io.images.sequence import Rows
from tomopose.io.images.writing import CHUNK_ROWS, file_rows

DATASET = "images"


def partial(path: Path) -> Path:
    """The name that a stack bears until it is whole."""
    return path.with_name(path.name + ".partial")


def frames_kept(path: Path) -> int:
    """How many frames of a stack need not be made again: all of a whole one; of an interrupted one those before the
    last, which may not be whole."""
    import h5py

    for file, spare in ((path, 0), (partial(path), 1)):
        if file.exists():
            try:
                with h5py.File(file, "r") as stack:
                    return max(len(stack[DATASET]) - spare, 0)
            except (OSError, KeyError):
                return 0
    return 0


def append_hdf5(path: Path, images: Iterable[tuple[int, Image]], kept: int, rows: Rows) -> None:
    """Write (number, image[v, u]) in rising order as [frame, row, column] behind the `kept` first frames.

    The layout is that of `write_hdf5`.
    """
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(partial(path), "r+" if kept else "w") as file:
        stack = file[DATASET] if kept else None
        for k, image in images:
            if stack is None:
                chunks = (1, min(CHUNK_ROWS, image.shape[0]), image.shape[1])
                stack = file.create_dataset(
                    DATASET, shape=(0, *image.shape), maxshape=(None, *image.shape), dtype=image.dtype, chunks=chunks
                )
                stack.attrs["image_rows"] = rows
            stack.resize(k + 1, axis=0)
            stack[k] = file_rows(image, rows)
    os.replace(partial(path), path)
