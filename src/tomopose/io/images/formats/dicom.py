"""DICOM: portal and radiographic images, one or more frames a file, as their pixel values are."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.io.images.frames import Band, Image, require_grey, require_one_kind
from tomopose.io.images.stated import Stated
from tomopose.reading import reading, require_plausible


@dataclass(frozen=True, kw_only=True)
class DicomSource:
    """Frames of DICOM files.  See FrameSource."""

    names: tuple[str, ...]
    shape: tuple[int, int]
    dtype: np.dtype[Any]
    frames: tuple[tuple[Path, int], ...]
    warnings: tuple[str, ...] = ()
    stated: Stated | None = None

    def read(self, index: int, band: Band) -> Image:
        path, k = self.frames[index]
        r0, r1, c0, c1 = band
        return _pixels(path)[k, r0:r1, c0:c1]


def open_dicom(paths: list[Path], names: list[str]) -> DicomSource:
    """The frames of DICOM files.  Values are scaled by RescaleSlope and RescaleIntercept where a file has them."""
    frames: list[tuple[Path, int]] = []
    frame_names: list[str] = []
    kinds: list[tuple[str, tuple[int, int], np.dtype[Any]]] = []
    notes: list[str] = []
    stated: Stated | None = None
    for path, name in zip(paths, names, strict=True):
        with reading(path, "DICOM file"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # values are converted when they are asked for
            data = _dataset(path, pixels=False)
            require_grey(str(path), np.dtype(np.uint16), int(data.get("SamplesPerPixel", 1)))
            if str(data.get("LossyImageCompression", "00")) == "01":
                raise InputError(f"{path} is compressed with loss; export it without")
            if data.get("PhotometricInterpretation") == "MONOCHROME1" and not notes:
                notes.append(
                    f"{name}: the file says that low values are white (MONOCHROME1); values are used as stored"
                )
            if stated is None:
                stated = stated_geometry(data)
            count = int(data.get("NumberOfFrames", 1) or 1)
            _require_room(path, data, count)
            kinds.append((str(path), (int(data.Rows), int(data.Columns)), _dtype(data)))
            for k in range(count):
                frames.append((path, k))
                frame_names.append(f"{name}[{k}]" if count > 1 else name)
    require_one_kind(kinds)
    return DicomSource(
        names=tuple(frame_names),
        shape=kinds[0][1],
        dtype=kinds[0][2],
        frames=tuple(frames),
        warnings=tuple(notes),
        stated=stated,
    )


SPACINGS = ("ImagerPixelSpacing", "ImagePlanePixelSpacing", "PixelSpacing")
"""[row, column] spacing, mm: at the panel, at the plane of RTImageSID, or somewhere that the file does not say."""
DISTANCES = {
    "d_SD_mm": ("DistanceSourceToDetector", "RTImageSID"),
    "d_SR_mm": ("RadiationMachineSAD", "DistanceSourceToPatient"),
}


def stated_geometry(data: Any) -> Stated:
    """Pixel pitch at the panel and distances in a header, mm.  Source: DICOM PS3.3, RT Image, DX and X-ray modules."""
    values: dict[str, float] = {}
    fields: dict[str, str] = {}
    readings: list[str] = []
    for name in SPACINGS:
        pair = data.get(name)
        if pair is None or len(pair) != 2:
            continue
        values["p_v_mm"], values["p_u_mm"] = float(pair[0]), float(pair[1])
        fields |= {"p_u_mm": name, "p_v_mm": name}
        if name == "ImagePlanePixelSpacing":
            readings.append("ImagePlanePixelSpacing is taken as that of the panel, at RTImageSID from the source")
        if name == "PixelSpacing":
            readings.append("PixelSpacing alone is stated; it is taken as that of the panel")
        break
    for key, names in DISTANCES.items():
        for name in names:
            value = data.get(name)
            if value is not None and float(value) > 0:
                values[key], fields[key] = float(value), name
                break
    values = {k: v for k, v in values.items() if np.isfinite(v) and v > 0}
    return Stated(values=values, fields=fields, readings=tuple(readings))


def _require_room(path: Path, data: Any, count: int) -> None:
    """FileError where the frames that a header claims cannot lie in the file."""
    rows, columns, stored = int(data.Rows), int(data.Columns), path.stat().st_size
    if count < 1 or rows < 1 or columns < 1:
        raise FileError(f"{path} claims {count} frames of {columns} x {rows} pixels", path=path)
    claimed = count * rows * columns * max(int(data.BitsAllocated) // 8, 1)
    if not data.file_meta.TransferSyntaxUID.is_compressed and claimed > stored:
        raise FileError(
            f"{path} is truncated: {count} frames of {columns} x {rows} pixels need {claimed} bytes, it has {stored}",
            path=path,
        )
    require_plausible(path, f"{count} frames of {columns} x {rows} pixels", claimed, stored)


def _rescale(data: Any) -> tuple[float, float]:
    return float(data.get("RescaleSlope", 1) or 1), float(data.get("RescaleIntercept", 0) or 0)


def _dtype(data: Any) -> np.dtype[Any]:
    if _rescale(data) != (1.0, 0.0):
        return np.dtype(np.float32)
    return np.dtype(f"{'i' if data.get('PixelRepresentation') else 'u'}{int(data.BitsAllocated) // 8}")


def _dataset(path: Path, *, pixels: bool) -> Any:
    """The data set of a file; without a file header its syntax is implicit little endian, DICOM's default."""
    import pydicom
    from pydicom.uid import ImplicitVRLittleEndian

    with reading(path, "DICOM file"):
        if path.stat().st_size == 0:
            raise FileError(f"{path} is empty (0 bytes); copy it again", path=path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # identifiers that break DICOM's rules do not concern pixels
            data = pydicom.dcmread(path, force=True, stop_before_pixels=not pixels)
            if not data.file_meta.get("TransferSyntaxUID"):
                data.file_meta.TransferSyntaxUID = ImplicitVRLittleEndian
    missing = [k for k in ("Rows", "Columns", "BitsAllocated") if k not in data]
    if missing:
        raise FileError(f"{path} is no DICOM image ({', '.join(missing)} missing; truncated?)", path=path)
    return data


def _pixels(path: Path) -> Image:
    """All frames of a file, [frame, row, column]."""
    data = _dataset(path, pixels=True)
    with reading(path, "DICOM file (damaged or truncated)"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pixels: Image = data.pixel_array
        slope, intercept = _rescale(data)
        if (slope, intercept) != (1.0, 0.0):
            pixels = (pixels * slope + intercept).astype(np.float32)
        return pixels.reshape(-1, int(data.Rows), int(data.Columns))
