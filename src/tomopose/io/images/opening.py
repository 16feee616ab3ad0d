"""open_images: which files, which format, which row order; then every check that needs no pixel, and two that do."""

from __future__ import annotations

import glob
import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import ConventionError, FileError, InputError, InputWarning
from tomopose.files import natural_key
from tomopose.geometry.scanner import Scanner
from tomopose.io.images.checks import endianness_note, middle, require_scanner_shape
from tomopose.io.images.correction import correction, require_uncorrected
from tomopose.io.images.formats.dicom import open_dicom
from tomopose.io.images.formats.hdf5 import Hdf5Source, open_hdf5
from tomopose.io.images.formats.orientation import TURNS, UprightSource
from tomopose.io.images.formats.raw import RawLayout, open_raw
from tomopose.io.images.formats.tiff import open_tiff
from tomopose.io.images.formats.xim import open_xim
from tomopose.io.images.formats.xradia import XradiaSource, open_xradia
from tomopose.io.images.frames import FrameSource, Image, missing_numbers
from tomopose.io.images.sequence import ImageSequence, Rows
from tomopose.io.images.stated import contradictions
from tomopose.reading import reading
from tomopose.values import require_types

SUFFIXES = {
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".dcm": "DICOM",
    ".dicom": "DICOM",
    ".ima": "DICOM",
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".nxs": "HDF5",
    ".hdf": "HDF5",
    ".txrm": "Xradia",
    ".xrm": "Xradia",
    ".xim": "XIM",
    ".raw": "RAW",
    ".bin": "RAW",
}
REFUSED = {
    ".jpg": "JPEG",
    ".jpeg": "JPEG",
    ".png": "PNG",
    ".bmp": "BMP",
    ".gif": "GIF",
    ".webp": "WebP",
    ".jp2": "JPEG 2000",
}
MAGIC = (
    (b"II*\0", "TIFF"),
    (b"MM\0*", "TIFF"),
    (b"II+\0", "TIFF"),
    (b"MM\0+", "TIFF"),
    (b"\x89HDF", "HDF5"),
    (b"VMS.XI", "XIM"),
)
SHOWN = 5

Source = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


@require_types
def open_images(
    source: Source,
    scanner: Scanner | None = None,
    *,
    dark: Source | Image | None = None,
    flat: Source | Image | None = None,
    bad_pixels: Image | None = None,
    rows: Rows | None = None,
    raw_layout: RawLayout | None = None,
    dataset: str | None = None,
) -> ImageSequence:
    """Open radiographs without reading them.

    Parameters
    ----------
    source:      a folder, a file, a glob pattern, or a list of files.  Folders and patterns are taken in natural order
                 (pose_2 before pose_10), lists as they are.  TIFF (single, multi-page, ImageJ), HDF5 and NXtomo,
                 DICOM, Zeiss .xrm and .txrm, Varian .xim; RAW with `raw_layout`.
    scanner:     checks the image size and gives the row order, if `rows` does not.
    dark, flat:  images[v, u], or files of them, which are averaged; with them images are transmission
                 T = (I - D) / (F - D), float32.  Flat and dark frames inside an NXtomo file are used if none are given.
    bad_pixels:  (n_v, n_u) bool, true where a pixel must not be used.
    rows:        row order of the files, "top-first" or "bottom-first"; default: what the file says (HDF5 written by
                 this package), then the scanner's, then "top-first".
    raw_layout:  for RAW files.
    dataset:     name of the stack in an HDF5 file with several.

    Returns
    -------
    ImageSequence: `len`, `names`, `shape`, `dtype`, `images[i]` -> image[v, u], `images.region(i, v0, v1, u0, u1)`.

    Raises
    ------
    FileError
        Missing, empty, truncated or unreadable files, by name.
    InputError
        Shapes or types that differ, colour, lossy compression, a shape that is not the scanner's, wrong endianness.
    """
    paths = find_files(source)
    kinds = {p: _kind(p, raw_layout) for p in paths}
    if len(set(kinds.values())) > 1:
        odd = next(p for p in paths if kinds[p] != kinds[paths[0]])
        raise InputError(f"{paths[0]} is {kinds[paths[0]]}, {odd} is {kinds[odd]}; give images of one format")
    frames = _open(paths, kinds[paths[0]], raw_layout, dataset)
    if 0 in frames.shape:
        raise FileError(f"{paths[0]} holds an image of {frames.shape[1]} x {frames.shape[0]} pixels", path=paths[0])
    order = _rows(frames, rows, scanner)
    if scanner is not None:
        require_scanner_shape(frames.shape, scanner, frames.names[0])
    plain = ImageSequence(source=frames, rows=order, index=tuple(range(len(frames.names))))
    notes = [*getattr(frames, "warnings", ())]
    stated = getattr(frames, "stated", None)
    said = "" if scanner is None or stated is None else contradictions(stated, scanner, frames.names[0])
    if said:
        warnings.warn(said, InputWarning, stacklevel=2)
    if frames.dtype.itemsize == 1:
        notes.append(f"{frames.names[0]}: 8 bits a pixel; the detector's own 16-bit data measure better")
    gaps = missing_numbers(frames.names)
    if gaps:
        notes.append(f"the numbering leaves out {len(gaps)} numbers, the first is {gaps[0]}")
    with reading(paths[0], "radiograph"):
        notes += endianness_note(plain.region(0, *middle(frames.shape)), frames.names[0])
    bad = None if bad_pixels is None else _mask(bad_pixels, frames.shape)
    D, F = _mean(dark, order, raw_layout), _mean(flat, order, raw_layout)
    if isinstance(frames, Hdf5Source | XradiaSource) and D is None and F is None and frames.flats:
        turn = slice(None, None, -1) if order == "top-first" else slice(None)
        D, F = (None if m is None else m[turn] for m in (frames.mean(frames.darks), frames.mean(frames.flats)))
        notes.append(f"{len(frames.flats)} flat and {len(frames.darks)} dark frames of the file were used")
    fix = None
    if D is not None or F is not None:
        if F is not None:
            require_uncorrected(plain[0], F)
        fix = correction(D, F, bad, frames.shape)
    return ImageSequence(
        source=frames, rows=order, index=plain.index, correction=fix, bad_pixels=bad, warnings=tuple(notes)
    )


def find_files(source: Source) -> list[Path]:
    """The image files that a folder, file, pattern or list means.  FileError where there are no images."""
    if not isinstance(source, (str, os.PathLike)):
        paths = [Path(p) for p in source]
        if not paths:
            raise FileError("the list of images is empty")
        return paths
    path = Path(source)
    if path.is_file():
        return [path]
    if path.is_dir():
        return _in_folder(path)
    if glob.has_magic(str(source)):
        found = [p for p in map(Path, glob.glob(str(source), recursive=True)) if p.is_file()]
        if not found:
            raise FileError(f"no file matches {source}", path=path)
        return sorted(found, key=lambda p: natural_key(str(p)))
    raise FileError(f"{path} does not exist", path=path)


def _in_folder(folder: Path) -> list[Path]:
    try:
        files = [p for p in folder.iterdir() if p.is_file() and p.name[0] != "."]
    except OSError as error:
        raise FileError(f"{folder} cannot be read: {error.strerror or error}", path=folder) from error
    files.sort(key=lambda p: natural_key(p.name))
    images = [p for p in files if p.suffix.lower() in SUFFIXES]
    if images:
        return images
    refused = [p for p in files if p.suffix.lower() in REFUSED]
    if refused:
        _kind(refused[0], None)
    there = ", ".join(p.name for p in files[:SHOWN]) or "nothing"
    raise FileError(
        f"{folder} holds no images ({', '.join(SUFFIXES)}); there is {there}{' ...' if len(files) > SHOWN else ''}",
        path=folder,
    )


def _kind(path: Path, raw_layout: RawLayout | None) -> str:
    suffix = path.suffix.lower()
    if suffix in REFUSED:
        raise InputError(
            f"{path} is a {REFUSED[suffix]} picture, which does not keep the detector's grey values; export 16-bit "
            "TIFF, RAW, HDF5 or DICOM"
        )
    kind = SUFFIXES.get(suffix) or _kind_by_content(path)
    if raw_layout is not None and kind in ("RAW", ""):
        return "RAW"
    if kind == "RAW":
        raise InputError(f"{path} is RAW; declare its shape, type and header with raw_layout=RawLayout(...)")
    if not kind:
        raise FileError(f"{path} is of no known image format ({', '.join(SUFFIXES)})", path=path)
    return kind


def _kind_by_content(path: Path) -> str:
    try:
        with open(path, "rb") as stream:
            head = stream.read(132)
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}", path=path) from error
    return next((kind for magic, kind in MAGIC if head.startswith(magic)), "DICOM" if head[128:] == b"DICM" else "")


def _open(paths: list[Path], kind: str, raw_layout: RawLayout | None, dataset: str | None) -> FrameSource:
    names = [p.name for p in paths]
    if len(set(names)) < len(names):  # files of the same name in several folders
        common = os.path.commonpath([p.absolute().parent for p in paths])
        names = [Path(os.path.relpath(p.absolute(), common)).as_posix() for p in paths]
    if len(set(names)) < len(names):
        twice = next(p for k, p in enumerate(paths) if p in paths[:k])
        raise InputError(f"{twice} appears more than once in the list of images")
    if kind == "TIFF":
        return open_tiff(paths, names)
    if kind == "DICOM":
        return open_dicom(paths, names)
    if kind == "RAW":
        assert raw_layout is not None
        return open_raw(paths, names, raw_layout)
    if kind == "Xradia":
        return open_xradia(paths, names)
    if kind == "XIM":
        return open_xim(paths, names)
    if len(paths) > 1:
        raise InputError(f"{len(paths)} HDF5 files were found ({names[0]}, {names[1]} ...); give one")
    return open_hdf5(paths[0], names[0], dataset)


def _rows(frames: FrameSource, rows: Rows | None, scanner: Scanner | None) -> Rows:
    """The row order of the frames as they are handed out: the file's own word first, then the caller's."""
    for value in (rows, getattr(frames, "image_rows", None)):
        if value not in (None, "top-first", "bottom-first"):
            raise ConventionError(f"row order {value!r} is unknown; 'top-first' or 'bottom-first' is needed")
    if isinstance(frames, UprightSource):
        _require_same_rows(frames, rows or (scanner.image_rows if scanner is not None else None))
        return "top-first"
    said: Any = getattr(frames, "image_rows", None)
    if rows is not None and said is not None and rows != said:
        raise ConventionError(f"{frames.names[0]}: the file says that its rows are {said}, rows={rows!r} contradicts")
    order: Rows = rows or said or (scanner.image_rows if scanner is not None else "top-first")
    return order


def _require_same_rows(frames: UprightSource, rows: Rows | None) -> None:
    """ConventionError where the caller says bottom-first and the file's Orientation says that row 0 is the top.

    The default of a scanner is top-first: it cannot be distinguished from a word of the user and contradicts nothing.
    """
    row_0 = TURNS[frames.orientation].row_0
    if rows == "bottom-first" and row_0 != "bottom":
        raise ConventionError(
            f"{frames.names[0]}: its Orientation {frames.orientation} says that the first stored row is the {row_0}, "
            "but "
            "the rows are said to be bottom-first (--rows or image_rows); one of them is wrong"
        )


def _mask(bad_pixels: Image, shape: tuple[int, int]) -> Image:
    mask = np.array(bad_pixels)
    if mask.shape != shape or mask.dtype != np.bool_:
        raise InputError(f"bad_pixels is {mask.dtype} of shape {mask.shape}; bool of shape {shape} is needed")
    mask.setflags(write=False)
    return mask


def _mean(source: Source | Image | None, rows: Rows, raw_layout: RawLayout | None) -> Image | None:
    """Mean of dark or flat images, float64, [v, u]."""
    if source is None:
        return None
    if isinstance(source, np.ndarray):
        image = np.asarray(source, dtype=np.float64)
        return image.mean(axis=0) if image.ndim == 3 else image
    images = open_images(source, rows=rows, raw_layout=raw_layout)
    total = np.zeros(images.shape)
    for image in images:
        total += image
    return total / len(images)
