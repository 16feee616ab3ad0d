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
from tomopose.io.images.formats.orientation import TURNS, UPRIGHT, upright
from tomopose.io.images.formats.tiff_structure import require_sound_tiff
from tomopose.io.images.frames import (
    Band,
    FrameSource,
    Image,
    fetch_ahead,
    read_block,
    require_grey,
    require_one_kind,
    unreadable,
)
from tomopose.reading import reading

ORIENTATION, DATE_TIME = 274, 306
REDUCED_OR_MASK = 1 | 4
"""Bits of NewSubfileType: a smaller copy of another page, or a transparency mask."""
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


@dataclass(frozen=True, kw_only=True)
class TiffPages:
    """What the headers of a file say: frames and shapes, whether 0 is white, its Orientation, pages passed over."""

    frames: list[TiffFrame]
    shapes: list[tuple[int, int]]
    inverted: bool
    orientation: int
    thumbnails: int


def open_tiff(paths: list[Path], names: list[str]) -> FrameSource:
    """The frames of TIFF files, in order, upright.  Every header is read and every file's length checked.

    Smaller copies of a page (NewSubfileType) are passed over.  Raises FileError (truncated, empty, no TIFF), InputError
    (colour, lossy compression, shapes, types or orientations that differ).
    """
    frames: list[TiffFrame] = []
    frame_names: list[str] = []
    kinds: list[tuple[str, tuple[int, int], np.dtype[Any]]] = []
    warnings: list[str] = []
    turns: list[int] = []
    inverted, thumbnails = False, 0
    for path, name in zip(paths, names, strict=True):
        pages = _pages(path)
        turns.append(pages.orientation)
        many = len(pages.frames) > 1
        for k, (frame, shape_k) in enumerate(zip(pages.frames, pages.shapes, strict=True)):
            frames.append(frame)
            frame_names.append(f"{name}[{k}]" if many else name)
            kinds.append((f"{path}, page {k}" if many else str(path), shape_k, frame.dtype.newbyteorder("=")))
        if pages.inverted and not inverted:
            inverted = True
            warnings.append(f"{name}: the file says that 0 is white (MinIsWhite); values are used as stored")
        if pages.thumbnails and not thumbnails:
            warnings.append(
                f"{name}: {pages.thumbnails} pages are smaller copies or masks (NewSubfileType); passed over"
            )
        thumbnails += pages.thumbnails
    require_one_kind(kinds)
    if len(set(turns)) > 1:
        k = next(k for k, t in enumerate(turns) if t != turns[0])
        raise InputError(
            f"{paths[k]} has the Orientation {turns[k]}, {paths[0]} {turns[0]}; all images of a sequence lie one way"
        )
    stored = TiffSource(
        names=tuple(frame_names), shape=kinds[0][1], dtype=kinds[0][2], frames=tuple(frames), warnings=tuple(warnings)
    )
    return stored if turns[0] == UPRIGHT else upright(stored, turns[0])


def date_time(path: Path) -> str | None:
    """When a TIFF says that it was made (DateTime, tag 306), as `YYYY-MM-DD HH:MM:SS`; None where it does not say."""
    import tifffile

    with reading(path, "TIFF"):
        require_sound_tiff(path)
        with tifffile.TiffFile(path) as tif:
            tag = tif.pages.first.tags.get(DATE_TIME)
            value = "" if tag is None else str(tag.value)
    word = value.strip().strip("\0")
    return f"{word[:10].replace(':', '-')}{word[10:]}" if word[:1].isdigit() else None


def _pages(path: Path) -> TiffPages:
    """What the headers of a file say."""
    import tifffile

    frames: list[TiffFrame] = []
    shapes: list[tuple[int, int]] = []
    inverted, thumbnails, turns = False, 0, []
    with reading(path, "TIFF (truncated?)"):
        size = path.stat().st_size
        if size == 0:
            raise FileError(f"{path} is empty (0 bytes); copy it again", path=path)
        require_sound_tiff(path)
        with tifffile.TiffFile(path) as tif:
            for k, entry in enumerate(tif.pages):
                page: Any = entry
                if int(page.subfiletype) & REDUCED_OR_MASK:
                    thumbnails += 1
                    continue
                _require_usable(path, k, page, size)
                dtype = np.dtype(page.dtype).newbyteorder(tif.byteorder)
                plain = page.is_contiguous and page.bitspersample == 8 * dtype.itemsize and page.fillorder == 1
                frames.append(TiffFrame(path=path, page=k, offset=page.dataoffsets[0] if plain else None, dtype=dtype))
                shapes.append((page.imagelength, page.imagewidth))
                inverted |= page.photometric == MIN_IS_WHITE
                turns.append(_orientation(path, page))
            count = _frames_behind_one_header(tif)
            if count > 1 and frames and frames[0].offset is not None:
                frames = _behind(path, frames[0], shapes[0], count, size)
                shapes *= count
    if not frames:
        raise FileError(f"{path} holds no images", path=path)
    if len(set(turns)) > 1:
        raise InputError(
            f"{path}: its pages have different Orientations ({turns[0]}, {next(t for t in turns if t != turns[0])})"
        )
    return TiffPages(frames=frames, shapes=shapes, inverted=inverted, orientation=turns[0], thumbnails=thumbnails)


def _orientation(path: Path, page: Any) -> int:
    """The page's Orientation, 1 where it does not say; InputError for a value that TIFF does not know."""
    tag = page.tags.get(ORIENTATION)
    value = UPRIGHT if tag is None else int(tag.value)
    if value == 0:
        return UPRIGHT  # what writers leave that do not fill the tag
    if value not in TURNS:
        raise InputError(f"{path}: the Orientation is {value}; TIFF knows 1 to 8")
    return value


def _behind(path: Path, first: TiffFrame, shape: tuple[int, int], count: int, size: int) -> list[TiffFrame]:
    """Frames that lie one behind the other after the header of the first."""
    step = shape[0] * shape[1] * first.dtype.itemsize
    start = first.offset or 0
    if start + count * step > size:
        raise _truncated(path, start + count * step, size)
    return [TiffFrame(path=path, page=k, offset=start + k * step, dtype=first.dtype) for k in range(count)]


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
