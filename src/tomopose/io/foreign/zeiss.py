"""Zeiss Xradia: .txrm, .xrm and .txm, an OLE container of streams.  Distances in mm, pixel sizes in micrometres.

Source: the streams ImageInfo/StoRADistance, DtoRADistance, CamPixelSize, PixelSize, ImageWidth, ImageHeight, Angles as
Scout-and-Scan writes them and as dxchange and CIL read them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.errors import EngineMissingError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, compared, kept, sensible
from tomopose.reading import reading

OLE = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"
ENDINGS = (".txrm", ".xrm", ".txm")
UM = 1e-3


def recognise(file: ForeignFile) -> bool:
    """An OLE container by that name."""
    return file.head[:8] == OLE and file.suffix in ENDINGS


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of an Xradia file.  EngineMissingError where olefile is not installed."""
    try:
        import olefile
    except ImportError as error:
        raise EngineMissingError(
            f"{file.path} is a Zeiss Xradia file; reading it needs the package olefile",
            install_line="pip install 'tomopose[zeiss]'",
        ) from error
    with reading(file.path, "Xradia file (truncated?)"), olefile.OleFileIO(str(file.path)) as ole:
        said = {name: _stream(ole, f"ImageInfo/{name}", kind) for name, kind in STREAMS.items()}
    return _draft(file, said)


STREAMS = {
    "StoRADistance": "<f4",
    "DtoRADistance": "<f4",
    "CamPixelSize": "<f4",
    "PixelSize": "<f4",
    "ImageWidth": "<u4",
    "ImageHeight": "<u4",
    "NoOfImages": "<u4",
    "CameraBinning": "<u4",
    "OpticalMagnification": "<f4",
    "Angles": "<f4",
}


def _stream(ole: Any, name: str, kind: str) -> np.ndarray | None:
    if not ole.exists(name):
        return None
    raw = ole.openstream(name).read()
    size = np.dtype(kind).itemsize
    return np.frombuffer(raw[: len(raw) // size * size], kind).astype(np.float64)


def _draft(file: ForeignFile, said: dict[str, np.ndarray | None]) -> ScannerDraft:
    def first(name: str) -> float | None:
        values = said[name]
        return None if values is None or not len(values) else float(values[0])

    source, detector = first("StoRADistance"), first("DtoRADistance")
    camera, voxel = first("CamPixelSize"), first("PixelSize")
    d_SR = None if source is None else abs(source)
    d_SD = abs(source) + abs(detector) if source is not None and detector is not None else None
    at_panel = voxel * d_SD / d_SR if voxel and d_SD and d_SR else None
    readings = ["the distances count from the rotation axis, the source's is negative; d_SD is their sum"]
    pitch = at_panel or camera
    if at_panel is not None:
        readings.append(
            "the pixel pitch is PixelSize (at the object) times the geometric magnification: behind an objective the "
            "camera's own pixel is not what the beam meets"
        )
    angles, n = said["Angles"], first("NoOfImages")
    return ScannerDraft(
        path=file.path,
        kind="a Zeiss Xradia file (.txrm)",
        maker="Zeiss",
        values=sensible(
            {
                "d_SD_mm": d_SD,
                "d_SR_mm": d_SR,
                "p_u_mm": None if pitch is None else pitch * UM,
                "p_v_mm": None if pitch is None else pitch * UM,
                "n_u_px": first("ImageWidth"),
                "n_v_px": first("ImageHeight"),
            },
            str(file.path),
        ),
        readings=tuple(readings),
        notes=kept(compared(camera, at_panel, "CamPixelSize", "PixelSize and the distances")),
        angles_deg=None if angles is None or n is None or len(angles) < n else tuple(angles[: int(n)].tolist()),
    )


KIND = Kind(name="zeiss", maker="Zeiss", what="an Xradia file (.txrm, .xrm)", recognise=recognise, read_scanner=read)
