"""HDF5: a stack [frame, row, column] in a named dataset, or NXtomo, which says by itself what its frames are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomopose.errors import InputError
from tomopose.io.images.formats.nexus import DATA, NexusValues, entries, stated_by
from tomopose.io.images.frames import Band, Image, require_grey
from tomopose.io.images.stated import Stated
from tomopose.reading import reading
from tomopose.reading.hdf5 import checked_hdf5

if TYPE_CHECKING:
    import h5py

PROJECTION, FLAT, DARK = 0, 1, 2
"""NXtomo's image_key; 3 marks frames to be left out."""


@dataclass(frozen=True, kw_only=True)
class Hdf5Source:
    """Frames of a dataset.  See FrameSource.  The file is opened for each read, as h5py objects cannot be sent."""

    names: tuple[str, ...]
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    path: Path
    dataset: str
    frames: tuple[int, ...]
    flats: tuple[int, ...] = ()
    darks: tuple[int, ...] = ()
    image_rows: str | None = None
    warnings: tuple[str, ...] = ()
    stated: Stated | None = None
    angles_deg: tuple[float, ...] | None = None

    def read(self, index: int, band: Band) -> Image:
        return self._read(self.frames[index], band)

    def _read(self, k: int, band: Band) -> Image:
        import h5py

        r0, r1, c0, c1 = band
        with reading(self.path, "stack of radiographs"), h5py.File(self.path, "r") as file:
            part: Image = file[self.dataset][k, r0:r1, c0:c1]
        return part.astype(part.dtype.newbyteorder("="), copy=False)

    def mean(self, frames: tuple[int, ...]) -> Image | None:
        """The mean of some frames of the dataset, float64, in the row order of the file; None of no frames."""
        if not frames:
            return None
        total = np.zeros(self.shape)
        for k in frames:
            total += self._read(k, (0, self.shape[0], 0, self.shape[1]))
        return total / len(frames)


def open_hdf5(path: Path, name: str, dataset: str | None) -> Hdf5Source:
    """The frames of an HDF5 file.  InputError lists the datasets where the right one is not clear."""
    import h5py

    with reading(path, "HDF5 file (truncated?)"), h5py.File(checked_hdf5(path), "r") as file:
        stacks = _stacks(file)
        where = dataset.strip("/") if dataset else _only(path, file, stacks)
        if where not in file:
            raise InputError(f"{path} holds no dataset {where!r}; stacks are: {', '.join(stacks) or 'none'}")
        data = file[where]
        if not isinstance(data, h5py.Dataset) or data.ndim != 3 or 0 in data.shape:
            raise InputError(
                f"{path}: {where} has shape {getattr(data, 'shape', 'of a group')}; a stack [frame, row, column] "
                f"is needed; stacks are: {', '.join(stacks) or 'none'}"
            )
        require_grey(f"{path}, {where}", data.dtype)
        keys = _image_key(path, file, where, len(data))
        frames = np.flatnonzero(keys == PROJECTION)
        if frames.size == 0:
            raise InputError(f"{path}: no frame of {where} is a projection (image_key 0)")
        rows = data.attrs.get("image_rows")
        stated, angles = _facts(file, data, frames)
        return Hdf5Source(
            names=tuple(f"{name}[{k}]" for k in frames),
            shape=(int(data.shape[1]), int(data.shape[2])),
            dtype=data.dtype.newbyteorder("="),
            path=path,
            dataset=where,
            frames=tuple(frames.tolist()),
            flats=tuple(np.flatnonzero(keys == FLAT).tolist()),
            darks=tuple(np.flatnonzero(keys == DARK).tolist()),
            image_rows=None if rows is None else str(rows),
            stated=stated,
            angles_deg=angles,
        )


def _facts(file: h5py.File, data: h5py.Dataset, frames: Image) -> tuple[Stated | None, tuple[float, ...] | None]:
    """What an NXtomo entry says of the scan, if the stack is its data: geometry, and the table angle of each frame."""
    for entry in entries(file):
        if entry[DATA] == data:
            angles = NexusValues(entry).angles(len(data))
            return stated_by(entry), None if angles is None else tuple(angles[frames].tolist())
    return None, None


def _stacks(file: h5py.File) -> list[str]:
    """The names of all three-dimensional datasets; one that several links lead to is named once."""
    found: list[str] = []

    def visit(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if getattr(item, "ndim", 0) == 3:
            found.append(name)

    file.visititems(visit)
    return found


def _only(path: Path, file: h5py.File, stacks: list[str]) -> str:
    """The stack of NXtomo, or the only one there is."""
    candidates = [s for s in stacks if _key_beside(file, s) is not None] or stacks
    if len(candidates) == 1:
        return candidates[0]
    raise InputError(
        f"{path} holds {len(candidates)} stacks of images ({', '.join(candidates) or 'none'}); name one with dataset="
    )


def _key_beside(file: h5py.File, stack: str) -> str | None:
    name = f"{stack.rpartition('/')[0]}/image_key".lstrip("/")
    return name if name in file else None


def _image_key(path: Path, file: h5py.File, stack: str, n: int) -> Image:
    name = _key_beside(file, stack)
    if name is None:
        return np.full(n, PROJECTION)
    keys = np.asarray(file[name][()]).reshape(-1)
    if len(keys) != n:
        raise InputError(f"{path}: {name} has {len(keys)} entries for {n} frames")
    return keys
