"""North Star Imaging: .nsipro and .nsihdr, lines of <name>value inside one another.  mm and micrometres.

Source: the fields `source to detector distance`, `source to table distance`, `pixel width microns`, `width pixels` of
the files that efX-DR and efX-CT write.
"""

from __future__ import annotations

import re

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import NUM
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible

FIELD = re.compile(r"<(?P<name>[^/>][^>]*)>\s*(?P<value>[^<\r\n]*)")
UM = 1e-3


def recognise(file: ForeignFile) -> bool:
    """The field `source to detector distance`."""
    return file.is_text and "<source to detector distance>" in file.text.lower()


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of an .nsipro file: the values of its last configuration."""
    said: dict[str, list[str]] = {}
    for match in FIELD.finditer(file.text):
        if match["value"].strip():
            said.setdefault(match["name"].strip().lower(), []).append(match["value"].strip())
    pitch_u, pitch_v = (_number(said, f"pixel {side} microns", file) for side in ("width", "height"))
    values = sensible(
        {
            "d_SD_mm": _number(said, "source to detector distance", file),
            "d_SR_mm": _number(said, "source to table distance", file),
            "p_u_mm": None if pitch_u is None else round(pitch_u * UM, 12),
            "p_v_mm": None if pitch_v is None else round(pitch_v * UM, 12),
            "n_u_px": _number(said, "width pixels", file),
            "n_v_px": _number(said, "height pixels", file),
        },
        str(file.path),
    )
    changed = [k for k in ("source to detector distance", "source to table distance") if len(set(said.get(k, ()))) > 1]
    turned = said.get("rotation description", [""])[-1]
    readings = ["`source to table distance` is taken as the distance to the rotation axis"]
    readings += [f"{k} appears more than once with different values; the last is taken" for k in changed]
    if re.search(r"[1-9]", turned):
        readings.append(f"the detector's images are turned ({turned}); width and height may be exchanged")
    return ScannerDraft(
        path=file.path,
        kind="a North Star project (.nsipro)",
        maker="North Star Imaging",
        values=values,
        readings=tuple(readings),
        image_rows="top-first",
    )


def _number(said: dict[str, list[str]], name: str, file: ForeignFile) -> float | None:
    if name not in said:
        return None
    found = re.match(rf"\s*({NUM})", said[name][-1].replace(",", "."))
    if not found:
        raise InputError(f"{file.path}: <{name}> is {said[name][-1][:40]!r}; a number is needed")
    return float(found[1])


KIND = Kind(
    name="north-star", maker="North Star Imaging", what="a project (.nsipro)", recognise=recognise, read_scanner=read
)
