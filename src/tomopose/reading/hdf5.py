"""HDF5: a file's structure is looked at in a process of its own before this one opens it.

The HDF5 library loops or ends the process on some damaged headers, and follows links and raw data into other files.
`checked_hdf5` lists every object and reads every attribute in a child with limits on time and memory, and refuses what
leaves the file: external links, external raw data, virtual datasets, and sizes that the stored bytes cannot hold.
"""

from __future__ import annotations

import math
import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from tomopose.errors import FileError
from tomopose.reading.border import require_file
from tomopose.reading.child import asked_apart
from tomopose.reading.memory import LARGEST_RATIO, MOST_UNPROVEN, in_gigabytes

if TYPE_CHECKING:
    import h5py

MOST_OBJECTS = 100_000
LARGEST_ATTRIBUTE = 64 * 2**20
SIGNATURE = b"\x89HDF\r\n\x1a\n"


def checked_hdf5(path: Path) -> Path:
    """The path, once its structure is sound; FileError says what is wrong with it.

    An unchanged file is looked at once.
    """
    require_file(path, "HDF5 file")
    facts = os.stat(path)
    _check_once(path, facts.st_ino, facts.st_size, facts.st_mtime_ns)
    return path


@lru_cache(maxsize=256)
def _check_once(path: Path, inode: int, size: int, changed: int) -> None:
    import h5py  # noqa: F401  (the child must not have to load it)

    asked_apart(look_at, path, "HDF5 file (truncated?)")


def look_at(path: Path) -> int:
    """Visit every object of a file, read all attributes, and compare sizes; the number of objects."""
    import h5py

    size = path.stat().st_size
    with h5py.File(path, "r") as file:
        _look_at_attributes(path, "/", file)
        seen = {h5py.h5o.get_info(file.id).addr}
        groups = [file]
        while groups:
            group = groups.pop()
            for name in group:
                item = _linked(path, group, name)
                if item is None:
                    continue
                address = h5py.h5o.get_info(item.id).addr
                if address in seen:
                    continue
                seen.add(address)
                if len(seen) > MOST_OBJECTS:
                    raise FileError(f"{path} holds more than {MOST_OBJECTS} objects", path=path)
                _look_at_attributes(path, item.name, item)
                if isinstance(item, h5py.Group):
                    groups.append(item)
                elif isinstance(item, h5py.Dataset):
                    _look_at_dataset(path, item, size)
        return len(seen)


def _linked(path: Path, group: h5py.Group, name: str) -> h5py.HLObject | None:
    """The object behind a name; None for a soft link to nothing.  FileError for a link into another file."""
    import h5py

    link = group.get(name, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        raise FileError(f"{path}: {name!r} leads to another file ({link.filename!r})", path=path)
    return group.get(name) if isinstance(link, h5py.SoftLink) else group[name]


def _look_at_attributes(path: Path, name: str, item: object) -> None:
    import h5py

    attributes = getattr(item, "attrs", None)
    assert isinstance(attributes, h5py.AttributeManager)
    for key in attributes:
        held = attributes.get_id(key)
        if math.prod(held.shape) * held.dtype.itemsize > LARGEST_ATTRIBUTE:
            raise FileError(f"{path}: the attribute {key!r} of {name} claims the shape {held.shape}", path=path)
        attributes[key]


def _look_at_dataset(path: Path, item: object, size: int) -> None:
    """Sizes, chunks and filters of a dataset, without its values."""
    import h5py

    assert isinstance(item, h5py.Dataset)
    if item.external:
        raise FileError(f"{path}: the values of {item.name} lie in another file, which is not read", path=path)
    if item.is_virtual:
        raise FileError(f"{path}: {item.name} is put together from other files, which are not read", path=path)
    claimed = math.prod(item.shape or (0,)) * item.dtype.itemsize
    stored = item.id.get_storage_size()
    if stored > size:
        raise FileError(f"{path} is truncated: {item.name} takes {stored} bytes, the file has {size}", path=path)
    offset = item.id.get_offset()
    if offset is not None and offset + stored > size:
        raise FileError(f"{path} is truncated: {item.name} ends {offset + stored - size} bytes too late", path=path)
    if claimed > MOST_UNPROVEN and claimed > LARGEST_RATIO * max(stored, 1):
        raise FileError(
            f"{path}: {item.name} of shape {item.shape} would take {in_gigabytes(claimed)}, but {stored} bytes are "
            "stored; the file is damaged or was never filled",
            path=path,
        )
    if item.chunks is not None:
        piece = math.prod(item.chunks) * item.dtype.itemsize
        if piece > max(MOST_UNPROVEN, LARGEST_RATIO * size):
            raise FileError(f"{path}: {item.name} claims chunks of {in_gigabytes(piece)}", path=path)
        if item.size:
            item.id.get_num_chunks()
            item[tuple(0 for _ in item.shape)]
            item[tuple(n - 1 for n in item.shape)]
    elif item.size and item.ndim:
        item[tuple(n - 1 for n in item.shape)]
