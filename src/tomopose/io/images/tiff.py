"""TIFF: one image a file or many, plain or losslessly compressed.

Plain pages are read straight from the file; of compressed pages only the strips or tiles that are needed are decoded.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import EngineMissingError, FileError, InputError
from tomopose.io.images.frames import Band, Image, fetch_ahead, read_block, require_grey, require_one_kind, unreadable
from tomopose.io.images.tiff_structure import require_sound_tiff
from tomopose.reading import reading

LOSSLESS = {1: "none", 5: "LZW", 8: "deflate", 32773: "PackBits", 32946: "deflate", 34925: "LZMA", 50000: "Zstandard"}
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it finds wrong is said in one error
PHOTOMETRIC_GREY = (0, 1)
MIN_IS_WHITE = 0


@dataclass(frozen=True, kw_only=True)
class TiffFrame:
    """One frame: the page of a file, and where its pixels begin if they lie in one plain piece."""

    path: Path
    page: int
    offset: int | None
    dtype: np.dtype[Any]


@dataclass(frozen=True, kw_only=True)
class TiffSource:
    """Frames of TIFF files.  See FrameSource."""

    names: tuple[str, ...]
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    frames: tuple[TiffFrame, ...]
    warnings: tuple[str, ...] = ()

    def read(self, index: int, band: Band) -> Image:
        frame = self.frames[index]
        if frame.offset is not None:
            return read_block(frame.path, frame.offset, self.shape, frame.dtype, band)
        return _decode(frame, band)

    def fetch(self, index: int, r0: int, r1: int) -> None:
        """Asks the system for file rows r0 to r1 of a plain frame, without waiting for them."""
        frame, row = self.frames[index], self.shape[1] * self.dtype.itemsize
        if frame.offset is not None:
            fetch_ahead(frame.path, frame.offset + r0 * row, (r1 - r0) * row)


def open_tiff(paths: list[Path], names: list[str]) -> TiffSource:
    """The frames of TIFF files, in order.  Every header is read and every file's length checked.

    Raises FileError (truncated, empty, no TIFF), InputError (colour, lossy compression, shapes or types that differ).
    """
    frames: list[TiffFrame] = []
    frame_names: list[str] = []
    kinds: list[tuple[str, tuple[int, int], np.dtype[Any]]] = []
    warnings: list[str] = []
    for path, name in zip(paths, names, strict=True):
        found, shape, inverted = _pages(path)
        many = len(found) > 1
        for k, (frame, shape_k) in enumerate(zip(found, shape, strict=True)):
            frames.append(frame)
            frame_names.append(f"{name}[{k}]" if many else name)
            kinds.append((f"{path}, page {k}" if many else str(path), shape_k, frame.dtype.newbyteorder("=")))
        if inverted and not warnings:
            warnings.append(f"{name}: the file says that 0 is white (MinIsWhite); values are used as stored")
    require_one_kind(kinds)
    return TiffSource(
        names=tuple(frame_names), shape=kinds[0][1], dtype=kinds[0][2], frames=tuple(frames), warnings=tuple(warnings)
    )


def _pages(path: Path) -> tuple[list[TiffFrame], list[tuple[int, int]], bool]:
    """Frames and shapes of a file, and whether it says that 0 is white."""
    import tifffile

    with reading(path, "TIFF (truncated?)"):
        size = path.stat().st_size
        if size == 0:
            raise FileError(f"{path} is empty (0 bytes); copy it again", path=path)
        require_sound_tiff(path)
        with tifffile.TiffFile(path) as tif:
            frames, shapes, inverted = [], [], False
            for k, entry in enumerate(tif.pages):
                page: Any = entry
                _require_usable(path, k, page, size)
                dtype = np.dtype(page.dtype).newbyteorder(tif.byteorder)
                plain = page.is_contiguous and page.bitspersample == 8 * dtype.itemsize and page.fillorder == 1
                frames.append(TiffFrame(path=path, page=k, offset=page.dataoffsets[0] if plain else None, dtype=dtype))
                shapes.append((page.imagelength, page.imagewidth))
                inverted |= page.photometric == MIN_IS_WHITE
            count = _frames_behind_one_header(tif)
            if count > 1 and frames[0].offset is not None:
                step = shapes[0][0] * shapes[0][1] * frames[0].dtype.itemsize
                start = frames[0].offset
                frames = [
                    TiffFrame(path=path, page=k, offset=start + k * step, dtype=frames[0].dtype) for k in range(count)
                ]
                shapes *= count
                if start + count * step > size:
                    raise _truncated(path, start + count * step, size)
    if not frames:
        raise FileError(f"{path} holds no images", path=path)
    return frames, shapes, inverted


def _frames_behind_one_header(tif: Any) -> int:
    """ImageJ and raw-series writers put all frames behind the header of the first."""
    if len(tif.pages) != 1 or len(tif.series) != 1:
        return 1
    shape = tif.series[0].shape
    return int(np.prod(shape[:-2])) if len(shape) > 2 else 1


def _truncated(path: Path, needed: int, size: int) -> FileError:
    return FileError(f"{path} is truncated: {size} bytes of at least {needed}; copy it again", path=path)


def _require_usable(path: Path, k: int, page: Any, size: int) -> None:
    name = str(path) if k == 0 else f"{path}, page {k}"
    if page.dtype is None or int(page.imagedepth) != 1:
        raise InputError(f"{name} holds pixels of no plain type; whole numbers or floats are needed")
    require_grey(name, np.dtype(page.dtype), int(page.samplesperpixel))
    if int(page.photometric) not in PHOTOMETRIC_GREY:
        raise InputError(f"{name} is a colour image ({page.photometric.name}); a radiograph has one grey value a pixel")
    if int(page.compression) not in LOSSLESS:
        raise InputError(
            f"{name} is compressed with {getattr(page.compression, 'name', page.compression)}, which may change grey "
            f"values; accepted are: {', '.join(dict.fromkeys(LOSSLESS.values()))}"
        )
    end = max((o + c for o, c in zip(page.dataoffsets, page.databytecounts, strict=False)), default=0)
    needed = page.imagelength * page.imagewidth * np.dtype(page.dtype).itemsize if page.is_contiguous else 0
    end = max(end, page.dataoffsets[0] + needed if page.dataoffsets else 0)
    if not page.dataoffsets or end > size:
        raise _truncated(path, end, size)


def _decode(frame: TiffFrame, band: Band) -> Image:
    import tifffile

    r0, r1, c0, c1 = band
    try:
        with tifffile.TiffFile(frame.path) as tif:
            page = tif.pages[frame.page]
            out = np.zeros((r1 - r0, c1 - c0), frame.dtype.newbyteorder("="))
            needed = [k for k in range(len(page.dataoffsets)) if _overlaps(page, k, band)]
            for k in needed:
                tif.filehandle.seek(page.dataoffsets[k])
                data = tif.filehandle.read(page.databytecounts[k])
                segment, (_, _, y, x, _), (_, height, width, _) = page.decode(data, k)
                if segment is None:
                    continue  # a sparse strip or tile: zeros
                a, b, left, right = max(y, r0), min(y + height, r1), max(x, c0), min(x + width, c1)
                out[a - r0 : b - r0, left - c0 : right - c0] = segment[0, a - y : b - y, left - x : right - x, 0]
            return out
    except OSError as error:
        raise unreadable(frame.path, error) from error
    except MemoryError as error:
        raise FileError(
            f"{frame.path}, page {frame.page} asks for more memory than is free", path=frame.path
        ) from error
    except (ImportError, ValueError) as error:
        if "imagecodecs" in str(error):
            raise EngineMissingError(
                f"{frame.path}: this compression needs the package imagecodecs", install_line="pip install imagecodecs"
            ) from error
        raise FileError(f"{frame.path}, page {frame.page} is damaged: {error}", path=frame.path) from error
    except Exception as error:  # codecs raise errors of their own kinds (zlib.error, imagecodecs.DelayedImportError)
        raise FileError(f"{frame.path}, page {frame.page} is damaged: {error}", path=frame.path) from error


def _overlaps(page: Any, k: int, band: Band) -> bool:
    """Whether strip or tile k has pixels in the band."""
    r0, r1, c0, c1 = band
    if page.is_tiled:
        across = -(-page.imagewidth // page.tilewidth)
        y, x = (k // across) * page.tilelength, (k % across) * page.tilewidth
        return bool(y < r1 and y + page.tilelength > r0 and x < c1 and x + page.tilewidth > c0)
    y = k * page.rowsperstrip
    return bool(y < r1 and y + page.rowsperstrip > r0)
