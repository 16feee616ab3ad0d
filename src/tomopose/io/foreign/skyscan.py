"""Bruker SkyScan: .log.  Distances in mm, pixel sizes in micrometres.

Source: the sections [System] and [Acquisition] as the scanners write them; the image pixel size is the camera's,
divided by the magnification, which shows whether the stated camera pixel is that of the binned image.
"""

from __future__ import annotations

import re

from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.ini_text import IniText
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, compared, kept, sensible

BINNING = re.compile(r"(\d+)\s*[xX]\s*(\d+)")
UM = 1e-3


def recognise(file: ForeignFile) -> bool:
    """A text that names a SkyScan, or its distance keys."""
    return (
        file.is_text and re.search(r"^\s*Scanner\s*=\s*skyscan|^Camera to Source", file.text, re.I | re.M) is not None
    )


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of a SkyScan log."""
    ini = IniText(file)
    d_SD, d_SR = ini.number("Camera to Source (mm)"), ini.number("Object to Source (mm)")
    camera, image = ini.number("Camera Pixel Size (um)"), ini.number("Image Pixel Size (um)")
    ratio = ini.number("CameraXYRatio") or ini.number("Camera X/Y Ratio") or 1.0
    readings = []
    notes: list[str] = []
    at_camera = image * d_SD / d_SR if image and d_SD and d_SR else None
    found = BINNING.search(ini.word("Camera binning") or "")
    if camera and at_camera and found and compared(at_camera, camera, "", ""):
        binned = camera * int(found[1])
        if not compared(at_camera, binned, "", ""):
            readings.append(
                f"Camera Pixel Size {camera:g} um is that of the unbinned camera ({found[0]}); {binned:g} um is taken"
            )
            camera = binned
    if camera is None and at_camera is not None:
        camera = at_camera
        readings.append("the camera's pixel size is not stated; it is that of the image times the magnification")
    notes += kept(compared(at_camera, camera, "Image Pixel Size times the magnification", "Camera Pixel Size would"))
    line, rows = ini.number("Optical Axis (line)"), ini.number("Number Of Rows")
    if line is not None and rows is not None:
        readings.append(
            f"Optical Axis (line) = {line:g}: whether it counts from the top row or the bottom one is not documented "
            f"(v_0 = {rows - 1 - line:g} or {line:g}); not used"
        )
    if crop := ini.said("Image crop origin X", "Image crop origin Y"):
        readings.append(f"the images are cropped ({', '.join(crop)}); the panel's middle is not the image's")
    values = sensible(
        {
            "d_SD_mm": d_SD,
            "d_SR_mm": d_SR,
            "p_u_mm": None if camera is None else round(camera * UM, 12),
            "p_v_mm": None if camera is None else round(camera * UM / ratio, 12),
            "n_u_px": ini.number("Number Of Columns"),
            "n_v_px": rows,
        },
        str(file.path),
    )
    return ScannerDraft(
        path=file.path,
        kind="a SkyScan scan log (.log)",
        maker="Bruker",
        values=values,
        readings=tuple(readings),
        unused=ini.said(
            "Scanner",
            "Number Of Files",
            "Source Voltage (kV)",
            "Rotation Step (deg)",
            "Rotation Direction",
            "Image Rotation",
            "Use 360 Rotation",
        ),
        notes=tuple(notes),
        angles_deg=_angles(ini),
        image_rows="top-first",
    )


def _angles(ini: IniText) -> tuple[float, ...] | None:
    n, step = ini.number("Number Of Files"), ini.number("Rotation Step (deg)")
    return tuple(k * step for k in range(int(n))) if n and step else None


KIND = Kind(name="skyscan", maker="Bruker", what="a SkyScan scan log", recognise=recognise, read_scanner=read)
