"""A stack of radiographs in HDF5 that keeps every finished frame, whatever ends the program.

The HDF5 file is laid out and closed before the first frame is made: all its metadata are on the disk, and each chunk
has its place.  Frames are then written to their places as plain bytes and flushed one by one; a small file beside the
stack counts them and holds the run's key.  A process that is killed, or a disk that is full, therefore neither damages
the file's structure nor reaches the HDF5 library, which ends the process where it cannot write its metadata.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.files import read_json, sync_folder, write_json
from tomopose.io.images.frames import Image
from tomopose.io.images.sequence import Rows
from tomopose.io.images.writing import CHUNK_ROWS, file_rows
from tomopose.kept import Key, same_key

DATASET = "images"
PROGRESS = "partial-stack"
HEAD_BYTES = 1 << 16
"""Room for the HDF5 metadata beside those of the chunks (about 100 bytes each, counted apart)."""


def partial(path: Path) -> Path:
    """The name of a stack until it is complete."""
    return path.with_name(path.name + ".partial")


def progress_file(path: Path) -> Path:
    """Where the number of finished frames of a partial stack is kept, with its key."""
    return path.with_name(path.name + ".partial.json")


def frames_kept(path: Path, key: Key) -> int:
    """How many frames of an interrupted stack are finished and were made with this key.

    0 with StartsAnewWarning where the partial stack belongs to another key.
    """
    if not partial(path).exists() or not progress_file(path).exists():
        return 0
    try:
        document = read_json(progress_file(path), PROGRESS)
    except FileError:
        document = {}
    if not same_key(Key.from_json(document.get("key")), key, what=f"the interrupted stack {partial(path)}"):
        return 0
    frames = document.get("frames")
    return frames if isinstance(frames, int) and frames > 0 else 0


def append_hdf5(
    path: Path, images: Iterable[tuple[int, Image]], *, count: int, key: Key, rows: Rows, kept: int = 0
) -> None:
    """Write (number, image[v, u]) in rising order as [frame, row, column], behind the `kept` first of `count` frames.

    The dataset's layout is that of `write_hdf5`.  Raises FileError where the disk is full or the file cannot be
    written; what is finished by then is kept.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    place = partial(path)
    stream: int | None = None
    try:
        for k, image in images:
            if stream is None:
                if not kept:
                    _lay_out(place, count, image, rows)
                chunks, form = _places(place)
                stream = os.open(place, os.O_RDWR)
            if (image.shape, image.dtype) != form:
                raise InputError(f"frame {k} is {image.dtype} {image.shape}, the stack {form[1]} {form[0]}")
            _write_frame(stream, file_rows(image, rows), chunks[k])
            os.fsync(stream)
            write_json(progress_file(path), PROGRESS, {"frames": k + 1, "key": key.to_json()})
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}", path=path) from error
    finally:
        if stream is not None:
            os.close(stream)
    os.replace(place, path)
    progress_file(path).unlink(missing_ok=True)
    sync_folder(path.parent)


def remove_stack(path: Path) -> None:
    """Remove a stack, whole or partial."""
    progress_file(path).unlink(missing_ok=True)
    for file in (partial(path), path):
        file.unlink(missing_ok=True)


def _lay_out(place: Path, count: int, image: Image, rows: Rows) -> None:
    """An HDF5 file with the whole dataset allocated but no frame written; OSError where the disk has no room for it."""
    chunk = (1, min(CHUNK_ROWS, image.shape[0]), image.shape[1])
    pieces = count * -(-image.shape[0] // chunk[1])
    reserve(place, pieces * (int(np.prod(chunk)) * image.itemsize + 128) + HEAD_BYTES)
    with h5py.File(place, "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk(chunk)
        layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        layout.set_obj_track_times(False)
        space = h5py.h5s.create_simple((count, *image.shape), (h5py.h5s.UNLIMITED, *image.shape))
        kind = h5py.h5t.py_create(image.dtype, logical=True)
        h5py.h5d.create(file.id, DATASET.encode(), kind, space, layout)
        file[DATASET].attrs["image_rows"] = rows
    with open(place, "rb+") as stream:
        os.fsync(stream.fileno())


def reserve(place: Path, size: int) -> None:
    """Raise OSError now, where the disk has no room for a file of this size; the file is empty afterwards.

    The HDF5 library ends the process where it cannot flush its metadata: it must not meet a full disk.
    """
    with open(place, "wb") as stream:
        try:
            os.posix_fallocate(stream.fileno(), 0, size)
        except AttributeError:  # not a POSIX system
            stream.truncate(size)
        stream.truncate(0)


def _places(place: Path) -> tuple[list[list[int]], tuple[tuple[int, ...], np.dtype]]:
    """Byte offsets of each frame's chunks, from the top, and the shape and type of a frame."""
    with h5py.File(place, "r") as file:
        stack = file[DATASET]
        rows = range(0, stack.shape[1], stack.chunks[1])
        offsets = [[stack.id.get_chunk_info_by_coord((k, r, 0)).byte_offset for r in rows] for k in range(len(stack))]
        return offsets, (stack.shape[1:], stack.dtype)


def _write_frame(stream: int, lines: Image, offsets: list[int]) -> None:
    """One frame's chunks to their places; the last one is filled up with zeros."""
    height = min(CHUNK_ROWS, lines.shape[0])
    for i, offset in enumerate(offsets):
        chunk = np.zeros((height, lines.shape[1]), dtype=lines.dtype)
        piece = lines[i * height : (i + 1) * height]
        chunk[: len(piece)] = piece
        left = memoryview(chunk.tobytes())
        while left:
            written = os.pwrite(stream, left, offset)
            left, offset = left[written:], offset + written
