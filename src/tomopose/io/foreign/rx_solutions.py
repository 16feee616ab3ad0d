"""RX Solutions: unireconstruction.xml (distances) and geom.csv (a source and a panel a view).

The XML holds no pixel pitch and no image size; published readers type them in.  Source:
conebeam/acquisitioninfo/geometry (sdd, sod, mm) and volume_acquisition/voxelSize as EasyTom and DeskTom write them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible
from tomopose.io.foreign.xml_text import parse_xml


def recognise(file: ForeignFile) -> bool:
    """XML with the root <unireconstruction>."""
    return file.is_text and "<unireconstruction" in file.text


def read(file: ForeignFile) -> ScannerDraft:
    """The distances of unireconstruction.xml; the image size from the folder Proj beside it, where it is there."""
    root = parse_xml(file)
    geometry = root.find("conebeam/acquisitioninfo/geometry")
    if geometry is None:
        raise InputError(f"{file.path} has no conebeam/acquisitioninfo/geometry")
    size = _image_size(file.path.parent / "Proj")
    values = sensible(
        {
            "d_SD_mm": _number(geometry, "sdd", file),
            "d_SR_mm": _number(geometry, "sod", file),
            "n_u_px": None if size is None else float(size[0]),
            "n_v_px": None if size is None else float(size[1]),
        },
        str(file.path),
    )
    unused = [f"{e.tag} {k} = {v}" for e in root.iter() if e.tag in ("correction", "voxelSize") for k, v in e.items()]
    return ScannerDraft(
        path=file.path,
        kind="an RX Solutions scan description (unireconstruction.xml)",
        maker="RX Solutions",
        values=values,
        readings=("the file holds no pixel pitch; the panel's data sheet does (for example 0.127 or 0.15 mm)",),
        unused=tuple(unused),
        image_rows="top-first",
    )


def _number(element: ET.Element, name: str, file: ForeignFile) -> float | None:
    word = element.get(name)
    if word is None:
        return None
    try:
        return float(word.replace(",", "."))
    except ValueError as error:
        raise InputError(f"{file.path}: {name} is {word!r}; a number is needed") from error


def _image_size(folder: Path) -> tuple[int, int] | None:
    """Columns and rows of the first projection of the scan's folder."""
    first = next(iter(sorted(folder.glob("*.tif"))), None) if folder.is_dir() else None
    if first is None:
        return None
    from tomopose.io.images import open_images

    rows, columns = open_images(first).shape
    return columns, rows


def recognise_views(file: ForeignFile) -> bool:
    """geom.csv: two header lines, source, panel and two edge points a view."""
    return file.is_text and "src_x" in file.text[:400] and "det_x" in file.text[:400]


KIND = Kind(
    name="rx",
    maker="RX Solutions",
    what="a scan description (unireconstruction.xml)",
    recognise=recognise,
    read_scanner=read,
)
VIEWS = Kind(
    name="rx-views",
    maker="RX Solutions",
    what="the geometry of each view (geom.csv)",
    recognise=recognise_views,
    holds_geometry=True,
)
