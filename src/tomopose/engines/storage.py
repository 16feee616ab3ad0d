"""Volumes on disk, layer by layer in HDF5: what neither memory nor a killed process may lose."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from tomopose.files import atomic_file
from tomopose.reading import reading
from tomopose.reading.memory import require_memory

PIECE = 64 * 2**20
"""Bytes written at a time; a volume is often a strided view, and writing it whole would copy it whole."""


def pieces(shape: tuple[int, int, int]) -> Iterator[slice]:
    """Slices of layers of about `PIECE` bytes."""
    step = max(1, PIECE // max(1, shape[1] * shape[2] * 4))
    return (slice(z, min(z + step, shape[0])) for z in range(0, shape[0], step))


def write_layers(dataset: h5py.Dataset, values: np.ndarray, first: int = 0) -> None:
    """Write [z, y, x] into a dataset from layer `first` on."""
    for part in pieces(values.shape):
        dataset[first + part.start : first + part.stop] = np.ascontiguousarray(values[part], dtype=np.float32)


def store(path: Path, values: np.ndarray) -> None:
    """A file that holds `volume` [z, y, x] float32; whole or absent."""
    with atomic_file(path) as temporary, h5py.File(temporary, "w") as file:
        write_layers(file.create_dataset("volume", shape=values.shape, dtype="<f4"), values)


def mapped(path: str | Path, name: str = "volume") -> np.ndarray:
    """The dataset as a read-only memory map: nothing is read before it is used."""
    with reading(path, "volume"), h5py.File(path, "r") as file:
        dataset = file[name]
        offset, shape, kind = dataset.id.get_offset(), dataset.shape, dataset.dtype
        if offset is None:
            require_memory(path, f"{name} of shape {shape}", dataset.nbytes)
            values: np.ndarray = dataset[()]
            return values
    return np.memmap(path, dtype=kind, mode="r", offset=offset, shape=shape)
