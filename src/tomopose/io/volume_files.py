"""Volumes as files: HDF5 (with everything a `Volume` knows), TIFF stack, NRRD and MetaImage (values and geometry).

In every file layers follow z, rows y, columns x, each index growing with its coordinate; lengths are mm in frame W.
The TIFF and the two raw formats carry spacing and the centre of voxel (0, 0, 0), so that no reader has to guess.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, cast

import h5py
import numpy as np
import tifffile

from tomopose.engines.storage import mapped, pieces, write_layers
from tomopose.errors import FileError, SchemaVersionError
from tomopose.files import atomic_file, plain, require_absent
from tomopose.io.images.formats.tiff_structure import require_sound_tiff
from tomopose.provenance import Provenance
from tomopose.reading import parse_json, read_text, reader, require_file, require_inside
from tomopose.reading.hdf5 import checked_hdf5
from tomopose.reading.memory import require_memory
from tomopose.units import Array
from tomopose.values import require_types
from tomopose.volume import Volume, VoxelGrid

SCHEMA = "tomopose/volume/1"
SUFFIXES = (".h5", ".tif", ".tiff", ".nrrd", ".mhd")


def write_volume(path: str | Path, volume: Volume, *, force: bool = False) -> Path:
    """Write a volume in the format that the suffix names: .h5, .tif, .tiff, .nrrd or .mhd (with a .raw beside it).

    Written layer by layer and atomically.  FileError where the suffix is another one, or something is there already
    and `force` is not given.  The order (volume, path) of version 0.1 is accepted with a DeprecationWarning.
    """
    if isinstance(path, Volume):
        warnings.warn(
            "write_volume(path, volume) is the order now, as of all writers", DeprecationWarning, stacklevel=2
        )
        path, volume = cast(str | Path, volume), cast(Volume, path)
    return _write(path, volume, force=force)


@require_types
def _write(path: str | Path, volume: Volume, *, force: bool) -> Path:
    path = Path(path)
    writer = {
        ".h5": _write_hdf5,
        ".tif": _write_tiff,
        ".tiff": _write_tiff,
        ".nrrd": _write_nrrd,
        ".mhd": _write_metaimage,
    }.get(path.suffix.lower())
    if writer is None:
        raise FileError(f"{path}: {path.suffix!r} is no volume format; {', '.join(SUFFIXES)} are known", path=path)
    require_absent(path, force=force)
    if path.suffix.lower() == ".mhd":
        require_absent(path.with_suffix(".raw"), force=force)
    writer(volume, path)
    return path


@reader("volume")
def read_volume(path: str | Path) -> Volume:
    """Read a volume that `write_volume` wrote.  The values are mapped from the file where it allows that.

    Raises FileError where the file is missing, of another suffix or damaged, SchemaVersionError for another schema.
    """
    path = Path(path)
    read = {
        ".h5": _read_hdf5,
        ".tif": _read_tiff,
        ".tiff": _read_tiff,
        ".nrrd": _read_nrrd,
        ".mhd": _read_metaimage,
    }.get(path.suffix.lower())
    if read is None:
        raise FileError(f"{path}: {path.suffix!r} is no volume format; {', '.join(SUFFIXES)} are known", path=path)
    return read(path)


def _grid(shape: Sequence[int], spacing: Sequence[float] | Array, origin: Sequence[float] | Array) -> VoxelGrid:
    """The grid of an array shape (n_z, n_y, n_x), spacing and origin (x, y, z), mm."""
    n_z, n_y, n_x = (int(n) for n in shape)
    spacing, origin = np.asarray(spacing, dtype=np.float64), np.asarray(origin, dtype=np.float64)
    centre = origin + spacing * (np.array([n_x, n_y, n_z]) - 1) / 2
    return VoxelGrid(shape=(n_z, n_y, n_x), spacing=spacing, centre=centre)


# -- HDF5 -----------------------------------------------------------------------------------------------------------


def _write_hdf5(volume: Volume, path: Path) -> None:
    with atomic_file(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["schema"] = SCHEMA
        file.attrs["notes"] = json.dumps(list(volume.notes), ensure_ascii=False)
        file.attrs["contradicted_views"] = np.array(volume.contradicted, dtype=np.int64)
        file.attrs["settings"] = json.dumps(plain(volume.settings), ensure_ascii=False)
        if volume.provenance is not None:
            file.attrs["provenance"] = json.dumps(plain(volume.provenance.to_json()), ensure_ascii=False)
        dataset = file.create_dataset("volume", shape=volume.values.shape, dtype="<f4")
        dataset.attrs["spacing_mm"] = volume.grid.spacing
        dataset.attrs["origin_mm"] = volume.grid.origin
        dataset.attrs["frame"] = "W"
        dataset.attrs["axes"] = "z,y,x"
        dataset.attrs["unit"] = "1/mm"
        write_layers(dataset, volume.values)
        if volume.view_residual is not None:
            file["view_residual"] = volume.view_residual


def _read_hdf5(path: Path) -> Volume:
    with h5py.File(checked_hdf5(path), "r") as file:
        schema = str(file.attrs.get("schema", ""))
        if schema != SCHEMA:
            raise SchemaVersionError(f"{path}: schema is {schema!r}; {SCHEMA!r} is needed", path=path)
        dataset = file["volume"]
        if not isinstance(dataset, h5py.Dataset) or dataset.ndim != 3 or dataset.dtype.kind not in "fiu":
            raise FileError(f"{path}: volume is no array [z, y, x] of numbers", path=path)
        if dataset.attrs["frame"] != "W" or dataset.attrs["axes"] != "z,y,x":
            raise FileError(
                f"{path}: frame {dataset.attrs['frame']!r} and axes {dataset.attrs['axes']!r}; 'W' and 'z,y,x' are "
                "needed",
                path=path,
            )
        grid = _grid(dataset.shape, dataset.attrs["spacing_mm"], dataset.attrs["origin_mm"])
        residual = file["view_residual"][()] if "view_residual" in file else None
        said = {
            key: parse_json(str(file.attrs[key]), f"{path}: {key}")
            for key in ("notes", "settings", "provenance")
            if key in file.attrs
        }
        contradicted = tuple(file.attrs.get("contradicted_views", ()))
    block = said.get("provenance")
    return Volume(
        values=mapped(path),
        grid=grid,
        view_residual=residual,
        notes=tuple(said["notes"]),
        settings=said["settings"],
        contradicted=contradicted,
        provenance=None if block is None else Provenance.from_json(block),
    )


# -- TIFF -----------------------------------------------------------------------------------------------------------


def _write_tiff(volume: Volume, path: Path) -> None:
    """One page a layer; the geometry as JSON in the first page's description."""
    description = json.dumps(
        {
            "schema": SCHEMA,
            "frame": "W",
            "axes": "z,y,x",
            "unit": "1/mm",
            "spacing_mm": volume.grid.spacing.tolist(),
            "origin_mm": volume.grid.origin.tolist(),
        }
    )
    layers = (np.ascontiguousarray(layer, dtype=np.float32) for layer in volume.values)
    with atomic_file(path) as temporary:
        tifffile.imwrite(
            temporary,
            layers,
            shape=volume.values.shape,
            dtype=np.float32,
            photometric="minisblack",
            description=description,
            metadata=None,
            bigtiff=volume.values.nbytes > 2**32 - 2**25,
        )


def _read_tiff(path: Path) -> Volume:
    require_sound_tiff(path)
    with tifffile.TiffFile(path) as file:
        first = file.pages[0]
        description = parse_json(getattr(first, "description", "") or "{}", f"{path}: the first page's description")
        if description.get("schema") != SCHEMA:
            raise SchemaVersionError(f"{path}: the first page does not say {SCHEMA!r}", path=path)
        layer = math.prod(first.shape) * np.dtype(first.dtype).itemsize
        require_memory(path, f"{len(file.pages)} layers", len(file.pages) * layer)
        values = np.stack([page.asarray() for page in file.pages])
    return Volume(values=values, grid=_grid(values.shape, description["spacing_mm"], description["origin_mm"]))


# -- NRRD (teem.sourceforge.net/nrrd/format.html) and MetaImage (itk.org/Wiki/ITK/MetaIO/Documentation) ----------------


def _numbers(values: Sequence[float] | Array) -> list[str]:
    return [repr(float(x)) for x in values]


def _write_raw(stream: BinaryIO, values: np.ndarray) -> None:
    for part in pieces((values.shape[0], values.shape[1], values.shape[2])):
        stream.write(np.ascontiguousarray(values[part], dtype="<f4").tobytes())


def _mapped_raw(path: Path, offset: int, shape: tuple[int, int, int]) -> np.ndarray:
    """Float32 values that lie in a file behind `offset` bytes, as many as the shape says."""
    require_file(path, "raw volume")
    there = path.stat().st_size - offset
    if min(shape) < 1 or 4 * math.prod(shape) != there:
        raise FileError(f"{path}: {' x '.join(map(str, shape[::-1]))} voxels do not fit its {there} bytes", path=path)
    return np.memmap(path, dtype="<f4", mode="r", offset=offset, shape=shape)


def _write_nrrd(volume: Volume, path: Path) -> None:
    grid = volume.grid
    n_x, n_y, n_z = grid.n_xyz
    s_x, s_y, s_z = _numbers(grid.spacing)
    header = "\n".join(
        [
            "NRRD0004",
            "type: float",
            "dimension: 3",
            "space: 3D-right-handed",
            f"sizes: {n_x} {n_y} {n_z}",
            f"space directions: ({s_x},0,0) (0,{s_y},0) (0,0,{s_z})",
            "kinds: domain domain domain",
            'space units: "mm" "mm" "mm"',
            f"space origin: ({','.join(_numbers(grid.origin))})",
            "endian: little",
            "encoding: raw",
            "",
            "",
        ]
    )
    with atomic_file(path) as temporary, open(temporary, "wb") as stream:
        stream.write(header.encode("ascii"))
        _write_raw(stream, volume.values)


def _read_nrrd(path: Path) -> Volume:
    with open(path, "rb") as stream:
        head = stream.read(4096)
    if not head.startswith(b"NRRD") or b"\n\n" not in head:
        raise FileError(f"{path} is no NRRD file", path=path)
    text, _, _ = head.partition(b"\n\n")
    fields = dict(line.split(": ", 1) for line in text.decode("ascii").splitlines()[1:] if ": " in line)
    if fields.get("type") != "float" or fields.get("encoding") != "raw" or fields.get("endian") != "little":
        raise FileError(f"{path}: only raw little-endian float NRRD files are read", path=path)
    n_x, n_y, n_z = (int(n) for n in fields["sizes"].split())
    rows = [[float(x) for x in r.strip("()").split(",")] for r in fields["space directions"].split()]
    directions = np.array(rows)
    if (directions != np.diag(np.diag(directions))).any():
        raise FileError(f"{path}: the axes are not those of W", path=path)
    origin = [float(x) for x in fields["space origin"].strip("()").split(",")]
    values = _mapped_raw(path, len(text) + 2, (n_z, n_y, n_x))
    return Volume(values=values, grid=_grid(values.shape, np.diag(directions), origin))


def _write_metaimage(volume: Volume, path: Path) -> None:
    grid = volume.grid
    raw = path.with_suffix(".raw")
    with atomic_file(raw) as temporary, open(temporary, "wb") as stream:
        _write_raw(stream, volume.values)
    header = "\n".join(
        [
            "ObjectType = Image",
            "NDims = 3",
            "BinaryData = True",
            "BinaryDataByteOrderMSB = False",
            "CompressedData = False",
            "TransformMatrix = 1 0 0 0 1 0 0 0 1",
            f"Offset = {' '.join(_numbers(grid.origin))}",
            f"ElementSpacing = {' '.join(_numbers(grid.spacing))}",
            f"DimSize = {' '.join(str(n) for n in grid.n_xyz)}",
            "ElementType = MET_FLOAT",
            f"ElementDataFile = {raw.name}",
            "",
        ]
    )
    with atomic_file(path) as temporary:
        temporary.write_text(header, encoding="ascii", newline="\n")


def _read_metaimage(path: Path) -> Volume:
    fields = dict(line.split(" = ", 1) for line in read_text(path).splitlines() if " = " in line)
    if fields.get("ElementType") != "MET_FLOAT" or fields.get("BinaryDataByteOrderMSB") != "False":
        raise FileError(f"{path}: only little-endian MET_FLOAT files are read", path=path)
    n_x, n_y, n_z = (int(n) for n in fields["DimSize"].split())
    values = _mapped_raw(require_inside(path.parent, fields["ElementDataFile"], str(path)), 0, (n_z, n_y, n_x))
    spacing, origin = ([float(x) for x in fields[k].split()] for k in ("ElementSpacing", "Offset"))
    return Volume(values=values, grid=_grid(values.shape, spacing, origin))
