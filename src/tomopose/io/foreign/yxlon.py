"""Comet Yxlon: ScanParameter.xml (lengths in pixels of PixelPitch mm) and the tab-separated parameter text.

Source: ConeBeamScanParameter with PixelSize, ProjectionSize, ScanTrajectory (PixelPitch, Fdd, Fod) and
DejustmentParameter; lines `VALUE tab NAME` with `FOD [mm]`, `FDD [mm]`.
"""

from __future__ import annotations

import re

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, kept, sensible
from tomopose.io.foreign.xml_text import child_text, local_name, parse_xml

TILTS = ("DetectorTiltA", "DetectorTiltB", "DetectorTiltC")


def recognise(file: ForeignFile) -> bool:
    """XML with cone-beam scan parameters, or the text with FOD [mm] and FDD [mm]."""
    if not file.is_text:
        return False
    return "<ConeBeamScanParameter" in file.text or ("FDD [mm]" in file.text and "FOD [mm]" in file.text)


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of a Yxlon scan."""
    return _xml(file) if "<ConeBeamScanParameter" in file.text else _table(file)


def _xml(file: ForeignFile) -> ScannerDraft:
    root = parse_xml(file)
    scan = next((e for e in root.iter() if local_name(e) == "ConeBeamScanParameter"), root)

    def number(*path: str) -> float | None:
        word = child_text(scan, *path)
        return None if not word else _float(word, "/".join(path), file)

    scale = number("ScanTrajectory", "PixelPitch")
    d_SD, d_SR = number("ScanTrajectory", "Fdd"), number("ScanTrajectory", "Fod")
    values = sensible(
        {
            "d_SD_mm": None if d_SD is None or scale is None else round(d_SD * scale, 9),
            "d_SR_mm": None if d_SR is None or scale is None else round(d_SR * scale, 9),
            "p_u_mm": number("PixelSize", "Width"),
            "p_v_mm": number("PixelSize", "Height"),
            "n_u_px": number("ProjectionSize", "Width"),
            "n_v_px": number("ProjectionSize", "Height"),
        },
        str(file.path),
    )
    readings = ["Fdd and Fod are in pixels of PixelPitch and were multiplied by it"]
    offsets = {k: number("DejustmentParameter", f"{k}DetectorOffset") for k in ("Horizontal", "Vertical")}
    said = [f"{k}DetectorOffset = {v:g} px" for k, v in offsets.items() if v]
    if said:
        readings.append(f"{', '.join(said)}: the sign is not documented; u_0 and v_0 are left at the panel's middle")
    tilts = {k: number("DejustmentParameter", k) for k in TILTS}
    turned = [f"{k} = {v:g} deg" for k, v in tilts.items() if v]
    if turned:
        readings.append(f"{', '.join(turned)}: which axis each turns about is not documented; not used")
    notes = [
        _pixels_moved(child_text(scan, "DetectorOrientation"), "original", "DetectorOrientation"),
        _pixels_moved(child_text(scan, "DetectorFlipDirections"), "none", "DetectorFlipDirections"),
    ]
    return ScannerDraft(
        path=file.path,
        kind="a Yxlon scan description (ScanParameter.xml)",
        maker="Comet Yxlon",
        values=values,
        readings=tuple(readings),
        notes=kept(*notes),
    )


def _pixels_moved(word: str | None, plain: str, name: str) -> str:
    if word is None or word.lower() == plain:
        return ""
    return f"{name} is {word}: the image files are turned or mirrored; compare an image with the panel before use"


def _table(file: ForeignFile) -> ScannerDraft:
    said = {}
    for line in file.lines:
        words = [w.strip() for w in line.split("\t") if w.strip()]
        if len(words) >= 2:
            said[words[-1]] = words[0]

    def number(name: str) -> float | None:
        return _float(said[name], name, file) if name in said else None

    pitch, binning, n = (
        number("2D-Pixel Size [mm]"),
        number("Pixelbinning") or 1.0,
        number("Number of Detector Elements"),
    )
    values = sensible(
        {
            "d_SD_mm": number("FDD [mm]"),
            "d_SR_mm": number("FOD [mm]"),
            "p_u_mm": None if pitch is None else pitch * binning,
            "p_v_mm": None if pitch is None else pitch * binning,
            "n_u_px": n,
            "n_v_px": n,
        },
        str(file.path),
    )
    readings = ["`Number of Detector Elements` is taken for both sides of the panel, as TIGRE takes it"]
    if binning != 1:
        readings.append(f"the pixel size was multiplied by Pixelbinning = {binning:g}")
    return ScannerDraft(
        path=file.path,
        kind="a Yxlon parameter text",
        maker="Comet Yxlon",
        values=values,
        readings=tuple(readings),
        unused=tuple(f"{k} = {said[k]}" for k in ("Center Offset [mm]", "CT: Number of Projections") if k in said),
    )


def _float(word: str, name: str, file: ForeignFile) -> float:
    try:
        return float(re.sub(r"(?<=\d),(?=\d)", ".", word))
    except ValueError as error:
        raise InputError(f"{file.path}: {name} is {word[:40]!r}; a number is needed") from error


KIND = Kind(
    name="yxlon",
    maker="Comet Yxlon",
    what="a scan description (ScanParameter.xml)",
    recognise=recognise,
    read_scanner=read,
)
