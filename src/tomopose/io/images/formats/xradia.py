"""Zeiss Xradia .xrm and .txrm: an OLE container of streams, image k (from 1) in ImageData<ceil(k / 100)>/Image<k>.

ImageInfo/DataType is 3 (uint8), 5 (uint16) or 10 (float32); where it is missing, the stream's length decides. Which of
its rows is the top the file does not say.  Source: the streams as txrm2tiff 2.2 and dxchange read them.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol, cast

import numpy as np

from tomopose.errors import EngineMissingError, FileError, InputError
from tomopose.io.images.frames import Band, Image, require_one_kind
from tomopose.io.images.stated import Stated
from tomopose.reading import reading
from tomopose.units import Array

TYPES: Mapping[int, str] = {3: "u1", 5: "<u2", 10: "<f4"}
PER_FOLDER = 100
UM = 1e-3
REFERENCE = "ReferenceData/Image"


class Container(Protocol):
    """What is used of olefile.OleFileIO."""

    def exists(self, filename: str) -> bool: ...
    def get_size(self, filename: str) -> int: ...
    def openstream(self, filename: str) -> BinaryIO: ...
    def close(self) -> None: ...


def open_container(path: Path) -> Container:
    """The OLE container; EngineMissingError where olefile is not installed, FileError where it is damaged."""
    try:
        import olefile
    except ImportError as error:
        raise EngineMissingError(
            f"{path} is a Zeiss Xradia file; reading it needs the package olefile",
            install_line="pip install 'tomopose[zeiss]'",
        ) from error
    with reading(path, "Xradia file (truncated?)"):
        return cast(Container, olefile.OleFileIO(str(path)))


def numbers(container: Container, name: str, kind: str) -> np.ndarray | None:
    """A stream of numbers (n,) as float64, None where it is missing."""
    if not container.exists(name):
        return None
    raw = container.openstream(name).read()
    size = np.dtype(kind).itemsize
    return np.frombuffer(raw[: len(raw) // size * size], kind).astype(np.float64)


def first(container: Container, kind: str, *names: str) -> float | None:
    """The first number of the first of these streams that is there."""
    for name in names:
        values = numbers(container, name, kind)
        if values is not None and len(values):
            return float(values[0])
    return None


def stated_by(container: Container) -> Stated:
    """Distances and pixel pitch, mm: the pitch where the beam meets the detector, not behind an objective."""
    source, detector = (first(container, "<f4", f"ImageInfo/{name}RADistance") for name in ("Sto", "Dto"))
    camera = first(container, "<f4", "DetAssemblyInfo/CamPixelSize", "ImageInfo/CamPixelSize")
    voxel = first(container, "<f4", "ImageInfo/PixelSize")
    d_SR = None if source is None else abs(source)
    d_SD = abs(source) + abs(detector) if source is not None and detector is not None else None
    at_panel = voxel * d_SD / d_SR if voxel and d_SD and d_SR else None
    pitch = at_panel or camera
    readings = ["the distances count from the rotation axis, the source's is negative; d_SD is their sum"]
    if at_panel is not None:
        readings.append(
            "the pixel pitch is PixelSize (at the object) times the geometric magnification: behind an objective the "
            "camera's own pixel is not what the beam meets"
        )
    name = "CamPixelSize" if at_panel is None else "PixelSize times the magnification"
    values = {"d_SD_mm": d_SD, "d_SR_mm": d_SR, "p_u_mm": pitch and pitch * UM, "p_v_mm": pitch and pitch * UM}
    return Stated(
        values={k: v for k, v in values.items() if v is not None and np.isfinite(v) and v > 0},
        fields={"d_SD_mm": "StoRADistance + DtoRADistance", "d_SR_mm": "StoRADistance", "p_u_mm": name, "p_v_mm": name},
        readings=tuple(readings),
    )


@dataclass(frozen=True, kw_only=True)
class XradiaSource:
    """Frames of Xradia files.  See FrameSource.  flats: reference images of the file, indices behind the frames."""

    names: tuple[str, ...]
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    frames: tuple[tuple[Path, str], ...]
    flats: tuple[int, ...] = ()
    darks: tuple[int, ...] = ()
    stated: Stated | None = None
    angles_deg: tuple[float, ...] | None = None

    def read(self, index: int, band: Band) -> Image:
        path, stream = self.frames[index]
        r0, r1, c0, c1 = band
        return _pixels(path, stream, self.shape)[r0:r1, c0:c1]

    def mean(self, indices: tuple[int, ...]) -> Array | None:
        """Mean of some frames, float64, None of none."""
        if not indices:
            return None
        band = (0, self.shape[0], 0, self.shape[1])
        return np.asarray(np.mean([self.read(i, band).astype(np.float64) for i in indices], axis=0))


def open_xradia(paths: list[Path], names: list[str]) -> XradiaSource:
    """The frames of .xrm and .txrm files, in order; a single file's own reference image is offered as flat."""
    frames: list[tuple[Path, str]] = []
    frame_names: list[str] = []
    kinds: list[tuple[str, tuple[int, int], np.dtype[Any]]] = []
    angles: list[float] = []
    stated: Stated | None = None
    for path, name in zip(paths, names, strict=True):
        with closing(open_container(path)) as container, reading(path, "Xradia file"):
            count = int(first(container, "<i4", "ImageInfo/NoOfImages") or 1)
            shape = _shape(container, path)
            streams = [f"ImageData{k // PER_FOLDER + 1}/Image{k + 1}" for k in range(count)]
            missing = next((s for s in streams if not container.exists(s)), None)
            if missing is not None:
                raise FileError(f"{path} states {count} images and lacks {missing}; was the scan ended?", path=path)
            kinds.append((str(path), shape, _type(container, streams[0], shape, path)))
            turns = numbers(container, "ImageInfo/Angles", "<f4")
            angles += [] if turns is None else turns[:count].tolist()
            stated = stated or stated_by(container)
            frames += [(path, s) for s in streams]
            frame_names += [f"{name}[{k}]" if count > 1 else name for k in range(count)]
            has_reference = container.exists(REFERENCE)
    require_one_kind(kinds)
    own = (len(frames),) if has_reference and len(paths) == 1 else ()
    return XradiaSource(
        names=tuple(frame_names),
        shape=kinds[0][1],
        dtype=kinds[0][2],
        frames=(*frames, *((paths[0], REFERENCE) for _ in own)),
        flats=own,
        stated=stated,
        angles_deg=tuple(angles) if len(angles) == len(frame_names) else None,
    )


def _shape(container: Container, path: Path) -> tuple[int, int]:
    n_v, n_u = (first(container, "<i4", f"ImageInfo/Image{side}") for side in ("Height", "Width"))
    if not n_v or not n_u or min(n_v, n_u) < 1:
        raise FileError(f"{path} is no Xradia radiograph: ImageInfo/ImageWidth and ImageHeight are missing", path=path)
    return int(n_v), int(n_u)


def _type(container: Container, stream: str, shape: tuple[int, int], path: Path) -> np.dtype[Any]:
    """The pixels' type, by the stream's length; it must be the one that DataType states."""
    kind = "ReferenceData" if stream == REFERENCE else "ImageInfo"
    said = first(container, "<i4", f"{kind}/DataType")
    size = container.get_size(stream)
    fitting = {int(code): t for code, t in TYPES.items() if np.dtype(t).itemsize * shape[0] * shape[1] == size}
    if said is not None and int(said) not in TYPES:
        raise InputError(f"{path}: the pixels are of Xradia's type {said:g}; read are {sorted(TYPES)}")
    if not fitting or (said is not None and int(said) not in fitting):
        raise FileError(
            f"{path}: {stream} has {size} bytes, which is no image of {shape[1]} x {shape[0]} pixels of the type that "
            "the file states; truncated?",
            path=path,
        )
    return np.dtype(fitting[int(said)] if said is not None else next(iter(fitting.values()))).newbyteorder("=")


@functools.lru_cache(maxsize=2)
def _open(path: Path, size: int, modified: int) -> Container:
    return open_container(path)


def _pixels(path: Path, stream: str, shape: tuple[int, int]) -> Image:
    with reading(path, "Xradia file"):
        about = path.stat()
        container = _open(path, about.st_size, about.st_mtime_ns)
        kind = _type(container, stream, shape, path).newbyteorder("<")
        return np.frombuffer(container.openstream(stream).read(), kind).reshape(shape).astype(kind.newbyteorder("="))
