"""DICOM and DICONDE radiographs as scanners: pixel spacing at the detector, and the distances of the machine."""

from __future__ import annotations

import warnings
from typing import Any

from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible
from tomopose.io.images.formats.dicom import stated_geometry
from tomopose.reading import reading


def recognise(file: ForeignFile) -> bool:
    """The mark DICM, or the name's ending."""
    return file.head[128:132] == b"DICM" or (file.suffix in (".dcm", ".dicom", ".ima") and not file.is_text)


def read(file: ForeignFile) -> ScannerDraft:
    """Pitch, size and distances of a DICOM image."""
    import pydicom

    with reading(file.path, "DICOM image"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data: Any = pydicom.dcmread(file.path, force=True, stop_before_pixels=True)
        said = stated_geometry(data)
        size = {"n_u_px": float(data.Columns), "n_v_px": float(data.Rows)}
    return ScannerDraft(
        path=file.path,
        kind="a DICOM image",
        maker=str(data.get("Manufacturer", "") or "DICOM"),
        values=sensible({**said.values, **size}, str(file.path)),
        readings=said.readings,
        notes=said.notes,
        image_rows="top-first",
    )


KIND = Kind(name="dicom", maker="DICOM", what="a radiograph", recognise=recognise, read_scanner=read)
