"""Waygate (phoenix): .pca, the scan description of datos|x.  Lengths in mm.

FDD is source to detector, FOD source to rotation axis.  Source: the sections [Geometry], [CT], [Image] and [Detector]
as datos|x acquisition writes them.
"""

from __future__ import annotations

import re

from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.ini_text import IniText
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, compared, kept, sensible


def recognise(file: ForeignFile) -> bool:
    """The keys FDD and FOD in a text with [Geometry]."""
    return file.is_text and re.search(r"^\s*\[Geometry\]", file.text, re.M | re.I) is not None and _has(file, "FDD")


def _has(file: ForeignFile, key: str) -> bool:
    return re.search(rf"^\s*{key}\s*=", file.text, re.MULTILINE | re.IGNORECASE) is not None


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of a .pca file."""
    ini = IniText(file)
    d_SD, d_SR = ini.number("FDD", "Geometry"), ini.number("FOD", "Geometry")
    pitch = ini.number("PixelsizeX", "Detector") or ini.number("PixelsizeX")
    pitch_v = ini.number("PixelsizeY", "Detector") or ini.number("PixelsizeY") or pitch
    values = sensible(
        {
            "d_SD_mm": d_SD,
            "d_SR_mm": d_SR,
            "p_u_mm": pitch,
            "p_v_mm": pitch_v,
            "n_u_px": ini.number("DimX", "Image"),
            "n_v_px": ini.number("DimY", "Image"),
        },
        str(file.path),
    )
    readings = []
    top, left = ini.number("Top", "Image") or 0.0, ini.number("Left", "Image") or 0.0
    if top or left:
        readings.append(
            f"the images are a window of the panel (Left {left:g}, Top {top:g}); u_0 and v_0 of the draft are those of "
            "the window's middle, the panel's middle lies elsewhere"
        )
    binning = ini.word("Binning", "Detector")
    if binning not in (None, "0", "1"):
        readings.append(f"Binning = {binning}: the pixel size is taken as that of the binned pixels; see VoxelSizeX")
    ratio = d_SD / d_SR if d_SD and d_SR else None
    voxel = pitch / ratio if pitch and ratio else None
    return ScannerDraft(
        path=file.path,
        kind="a phoenix scan description (.pca)",
        maker="Waygate Technologies",
        values=values,
        readings=tuple(readings),
        unused=ini.said("cx", "cy", "NumberImages", "RotationSector", "Voltage", "Current", "Binning", "Top", "Left"),
        notes=kept(
            compared(ini.number("Magnification"), ratio, "Magnification", "FDD and FOD"),
            compared(ini.number("VoxelSizeX"), voxel, "VoxelSizeX", "pixel size, FDD and FOD"),
        ),
        image_rows="top-first",
    )


KIND = Kind(
    name="phoenix",
    maker="Waygate Technologies",
    what="a scan description (.pca)",
    recognise=recognise,
    read_scanner=read,
)
