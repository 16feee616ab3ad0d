"""Zeiss Xradia: .txrm, .xrm and .txm, an OLE container of streams.  Distances in mm, pixel sizes in micrometres.

Source: the streams ImageInfo/StoRADistance, DtoRADistance, PixelSize, ImageWidth, ImageHeight, Angles and
DetAssemblyInfo/CamPixelSize as dxchange, CIL and mbirjax read them.
"""

from __future__ import annotations

from contextlib import closing

from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible
from tomopose.io.images.formats.xradia import first, numbers, open_container, stated_by
from tomopose.reading import reading

OLE = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"
ENDINGS = (".txrm", ".xrm", ".txm")


def recognise(file: ForeignFile) -> bool:
    """An OLE container by that name."""
    return file.head[:8] == OLE and file.suffix in ENDINGS


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of an Xradia file.  EngineMissingError where olefile is not installed."""
    with closing(open_container(file.path)) as container, reading(file.path, "Xradia file (truncated?)"):
        stated = stated_by(container)
        camera = first(container, "<f4", "DetAssemblyInfo/CamPixelSize", "ImageInfo/CamPixelSize")
        width, height, n = (
            first(container, "<i4", f"ImageInfo/{k}") for k in ("ImageWidth", "ImageHeight", "NoOfImages")
        )
        optics = first(container, "<f4", "DetAssemblyInfo/OpticalMagnification", "ImageInfo/OpticalMagnification")
        shift = first(container, "<f4", "AutoRecon/CenterShift", "ReconSettings/CenterShift")
        angles = numbers(container, "ImageInfo/Angles", "<f4")
    notes = []
    if camera is not None and optics is not None:
        notes.append(f"CamPixelSize is {camera:g} um behind an optical magnification of {optics:g}; neither is used")
    if shift:
        notes.append(f"CenterShift is {shift:g} px: the axis is that far off the panel's centre; its sign is not used")
    return ScannerDraft(
        path=file.path,
        kind="a Zeiss Xradia file (.txrm)",
        maker="Zeiss",
        values=sensible({**stated.values, "n_u_px": width, "n_v_px": height}, str(file.path)),
        readings=stated.readings,
        notes=tuple(notes),
        angles_deg=None if angles is None or n is None or len(angles) < n else tuple(angles[: int(n)].tolist()),
    )


KIND = Kind(name="zeiss", maker="Zeiss", what="an Xradia file (.txrm, .xrm)", recognise=recognise, read_scanner=read)
