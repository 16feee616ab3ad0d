"""A geometry file's content by its first bytes: an array, a mapping of arrays, a JSON object or list, or text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError, UnknownKindError
from tomopose.reading import parse_json, read_text, reading, require_file
from tomopose.reading.arrays import MAGIC, ZIP_MAGIC, read_npy, read_npz
from tomopose.reading.hdf5 import checked_hdf5

WHAT = "geometry file"
HDF5, MATLAB, MATLAB_HDF5 = b"\x89HDF", b"MATLAB 5.0", b"MATLAB 7.3"


def load(path: Path) -> Any:
    """The content of a file.  FileError where it cannot be read or is not whole, UnknownKindError for a binary file."""
    require_file(path, WHAT)
    with reading(path, WHAT), open(path, "rb") as stream:
        head = stream.read(128)
    if head.startswith(MAGIC):
        return read_npy(path, WHAT)
    if head.startswith(ZIP_MAGIC):
        return read_npz(path, WHAT)
    if head.startswith((MATLAB, MATLAB_HDF5)):
        return _matlab(path) if head.startswith(MATLAB) else _matlab_hdf5(path)
    if head.startswith(HDF5) and path.suffix.lower() == ".mat":
        return _matlab_hdf5(path)
    if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise UnknownKindError(f"{path} is a binary file of no format that is read", path=path)
    text = read_text(path)
    first = text.lstrip()[:1]
    if first == "{":
        return parse_json(text, path, constants=True)
    if first == "[":
        try:
            return parse_json(text, path, constants=True)
        except FileError:  # an INI section, or a list of numbers as NumPy prints it
            return text
    return text


def _matlab(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file, version 5 to 7."""
    import scipy.io

    with reading(path, "MATLAB file"):
        return {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")}


def _matlab_hdf5(path: Path) -> dict[str, Any]:
    """The arrays of a MATLAB file of version 7.3, whose axes HDF5 holds in reverse."""
    import h5py

    with reading(path, "MATLAB file"), h5py.File(checked_hdf5(path), "r") as file:
        return {k: np.asarray(v[()]).T for k, v in file.items() if isinstance(v, h5py.Dataset)}
