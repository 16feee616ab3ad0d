"""Somebody's own notes: `name = value` lines with the keys of scanner.json, or with SDD, SOD and their like in mm."""

from __future__ import annotations

from tomopose.errors import UnitError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.ini_text import IniText
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import GEOMETRY, PIERCING, ScannerDraft, sensible

KEYS = (*GEOMETRY, *PIERCING)
OTHER_NAMES = {
    "sdd_mm": "d_SD_mm",
    "fdd_mm": "d_SD_mm",
    "sid_mm": "d_SD_mm",
    "sod_mm": "d_SR_mm",
    "fod_mm": "d_SR_mm",
    "pixel_pitch_mm": "p_u_mm",
    "pixel_size_mm": "p_u_mm",
    "columns": "n_u_px",
    "rows": "n_v_px",
}
FEWEST = 3


def recognise(file: ForeignFile) -> bool:
    """Three or more of the keys."""
    if not file.is_text or file.text.lstrip()[:1] in ("{", "<"):
        return False
    found = {k for section in IniText(file).sections.values() for k in section}
    return len(found & {k.lower() for k in (*KEYS, *OTHER_NAMES)}) >= FEWEST


def read(file: ForeignFile) -> ScannerDraft:
    """The values of the known keys."""
    ini = IniText(file)
    bare = [k for k in ("SDD", "SOD", "FDD", "FOD", "d_SD", "d_SR", "p_u", "p_v") if ini.word(k) is not None]
    if bare:
        raise UnitError(f"{file.path}: {bare[0]!r} states no unit; write {bare[0]}_mm and give it in mm")
    values: dict[str, float | None] = {k: ini.number(k) for k in KEYS}
    readings = []
    for name, key in OTHER_NAMES.items():
        if values.get(key) is None and (value := ini.number(name)) is not None:
            values[key] = value
            readings.append(f"{name} is read as {key}")
    if values["p_u_mm"] is not None and values["p_v_mm"] is None:
        values["p_v_mm"] = values["p_u_mm"]
        readings.append("one pitch is stated; square pixels are taken")
    known = {k.lower() for k in (*KEYS, *OTHER_NAMES)}
    unused = [f"{k} = {v}" for section in ini.sections.values() for k, v in section.items() if k not in known]
    return ScannerDraft(
        path=file.path,
        kind="a list of names and values",
        maker="your own notes",
        values=sensible(values, str(file.path)),
        readings=tuple(readings),
        unused=tuple(unused),
    )


KIND = Kind(
    name="key-values", maker="your own notes", what="a list of names and values", recognise=recognise, read_scanner=read
)
