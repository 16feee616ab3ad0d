"""NumPy's .npy and .npz: what their headers declare is compared with their bytes before an array is made."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, TypeAlias

import numpy as np

from tomopose.errors import FileError
from tomopose.reading.border import reading
from tomopose.reading.memory import require_plausible

Anything: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.generic]]
MAGIC, ZIP_MAGIC = b"\x93NUMPY", b"PK\x03\x04"
MOST_MEMBERS = 1000
LONGEST_HEADER = 10_000
"""Characters; NumPy's own limit."""


def read_npz(path: Path, what: str) -> dict[str, Anything]:
    """The arrays of an .npz by name.  Python objects (pickles) are not read.

    FileError where the file is damaged, a name occurs twice, or an array claims more than its bytes hold.
    """
    with reading(path, what), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > MOST_MEMBERS:
            raise FileError(f"{path} holds {len(members)} arrays; a {what} has a few", path=path)
        found: dict[str, Anything] = {}
        for member in members:
            name = member.filename.removesuffix(".npy")
            if name in found:
                raise FileError(f"{path} holds the array {name[:60]!r} twice; which is meant?", path=path)
            require_plausible(path, f"the array {name[:60]!r}", member.file_size, member.compress_size)
            with archive.open(member) as stream:
                found[name] = _array(stream, member.file_size, path, f"the array {name[:60]!r}")
        return found


def read_npy(path: Path, what: str) -> Anything:
    """The array of an .npy; FileError where it is damaged or claims more than its bytes hold."""
    with reading(path, what), open(path, "rb") as stream:
        return _array(stream, path.stat().st_size, path, "the array")


def _array(stream: IO[bytes], size: int, path: Path, name: str) -> Anything:
    """One array, once its header fits the bytes that follow."""
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise FileError(f"{path}: {name} is of NumPy's format {version}, which is not known", path=path)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, by_columns, dtype = header(stream, max_header_size=LONGEST_HEADER)
    if dtype.hasobject:
        raise FileError(f"{path}: {name} holds Python objects, which are not read", path=path)
    if any(n < 0 for n in shape):
        raise FileError(f"{path}: {name} has the shape {shape}", path=path)
    needed, there = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if needed != there:
        raise FileError(f"{path}: {name} of shape {shape} needs {needed} bytes; {there} follow its header", path=path)
    require_plausible(path, f"{name} of shape {shape}", needed, there)
    values = np.frombuffer(stream.read(needed), dtype=dtype) if dtype.itemsize else np.zeros(math.prod(shape), dtype)
    return values.reshape(shape, order="F" if by_columns else "C").copy()
