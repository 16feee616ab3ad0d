"""Diondo: the scan's XML with Geometrie, Recon and ScanParameter.  Lengths in mm.

Source: SourceDetectorDist, SourceObjectDist, ProjectionDimX/Y, ProjectionPixelSizeX/Y as diControl writes them.
"""

from __future__ import annotations

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible
from tomopose.io.foreign.xml_text import child_text, parse_xml


def recognise(file: ForeignFile) -> bool:
    """XML with <Geometrie> and <SourceDetectorDist>."""
    return file.is_text and "<Geometrie" in file.text and "<SourceDetectorDist" in file.text


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of a Diondo scan."""
    root = parse_xml(file)

    def number(*path: str) -> float | None:
        word = child_text(root, *path)
        if not word:
            return None
        try:
            return float(word.replace(",", "."))
        except ValueError as error:
            raise InputError(f"{file.path}: {'/'.join(path)} is {word[:40]!r}; a number is needed") from error

    values = sensible(
        {
            "d_SD_mm": number("Geometrie", "SourceDetectorDist"),
            "d_SR_mm": number("Geometrie", "SourceObjectDist"),
            "p_u_mm": number("Recon", "ProjectionPixelSizeX"),
            "p_v_mm": number("Recon", "ProjectionPixelSizeY"),
            "n_u_px": number("Recon", "ProjectionDimX"),
            "n_v_px": number("Recon", "ProjectionDimY"),
        },
        str(file.path),
    )
    centre = child_text(root, "Recon", "ProjectionCenterOffsetX")
    special = [
        k for k in ("HelixMode", "Laminography") if (child_text(root, "ScanParameter", k) or "").lower() == "true"
    ]
    return ScannerDraft(
        path=file.path,
        kind="a Diondo scan description (.xml)",
        maker="Diondo",
        values=values,
        readings=("ProjectionCenterOffsetX (the rotation axis) is part of the mount that a calibration finds",),
        unused=() if not centre else (f"ProjectionCenterOffsetX = {centre}",),
        notes=tuple(f"{k} is true: the scan is no plain circle" for k in special),
    )


KIND = Kind(name="diondo", maker="Diondo", what="a scan description (.xml)", recognise=recognise, read_scanner=read)
