"""Nikon (X-Tek): .xtekct, with the angles of .ang or _ctdata.txt beside it.  Lengths in mm, angles in deg.

Published readers disagree on some fields (the sign of angles, whether _ctdata.txt counts, what ObjectRoll turns); each
draft says which reading it takes.  Sources: the section [XTekCT] as Inspect-X and CT Pro write it; Core Imaging
Library, NikonDataReader; TIGRE, NikonDataLoader.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tomopose.errors import InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.ini_text import IniText
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import NUM
from tomopose.io.foreign.scanner_draft import ScannerDraft, compared, kept, sensible

MIXED = "the sign of the angles differs between published readers; they are given as the file states them"
ANGLE_LINE = re.compile(rf"^\s*\d+\s*[:\t,;]\s*({NUM})|^\s*\d+\s+({NUM})\s")
EVEN_DEG = 0.02
"""deg; listed angles that leave the even steps of the .xtekct by more than this are worth a note."""


def recognise(file: ForeignFile) -> bool:
    """The section [XTekCT], or its keys."""
    return file.is_text and re.search(r"^\s*\[XTekCT\]|^SrcToDetector\s*=", file.text, re.M | re.I) is not None


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of an .xtekct file."""
    ini = IniText(file)
    where = str(file.path)
    values = sensible(
        {
            "d_SD_mm": ini.number("SrcToDetector"),
            "d_SR_mm": ini.number("SrcToObject"),
            "p_u_mm": ini.number("DetectorPixelSizeX"),
            "p_v_mm": ini.number("DetectorPixelSizeY"),
            "n_u_px": ini.number("DetectorPixelsX"),
            "n_v_px": ini.number("DetectorPixelsY"),
        },
        where,
    )
    readings: list[str] = []
    for axis, n, p, key in (("X", "n_u_px", "p_u_mm", "u_0_px"), ("Y", "n_v_px", "p_v_mm", "v_0_px")):
        offset = ini.number(f"DetectorOffset{axis}")
        if offset and n in values and p in values:
            values[key] = (values[n] - 1) / 2 - offset / values[p]
            readings.append(
                f"DetectorOffset{axis} = {offset:g} mm is read as a shift of the panel to positive {key[0]}, as CIL "
                "and "
                f"TIGRE read it: {key} = {values[key]:g} (the opposite sign would give "
                f"{(values[n] - 1) / 2 + offset / values[p]:g})"
            )
    if ini.number("ObjectOffsetX") or ini.number("CentreOfRotationTop"):
        readings.append(
            "ObjectOffsetX (the rotation axis) is part of the mount that a calibration finds; not in the draft"
        )
    if ini.number("ObjectRoll") or ini.number("ObjectTilt"):
        readings.append(
            "ObjectRoll and ObjectTilt turn the axis in one published reader and nothing in another; not used"
        )
    angles, notes = _angles(ini, file.path)
    if angles is not None:
        readings.append(MIXED)
    voxel, d_SD, d_SR = ini.number("VoxelSizeX"), values.get("d_SD_mm"), values.get("d_SR_mm")
    at_object = values["p_u_mm"] * d_SR / d_SD if d_SD and d_SR and "p_u_mm" in values else None
    return ScannerDraft(
        path=file.path,
        kind="a Nikon scan description (.xtekct)",
        maker="Nikon Metrology",
        values=values,
        readings=tuple(readings),
        unused=ini.said(
            "Name",
            "ObjectOffsetX",
            "ObjectTilt",
            "ObjectRoll",
            "CentreOfRotationTop",
            "CentreOfRotationBottom",
            "WhiteLevel",
            "XraykV",
            "XrayuA",
            "Projections",
        ),
        notes=(*notes, *kept(compared(voxel, at_object, "VoxelSizeX", "pixel size and distances"))),
        angles_deg=angles,
        image_rows="top-first",
    )


def _angles(ini: IniText, path: Path) -> tuple[tuple[float, ...] | None, tuple[str, ...]]:
    """The table angles: of the list beside the file, or InitialAngle + k AngularStep."""
    n, start, step = ini.number("Projections"), ini.number("InitialAngle"), ini.number("AngularStep")
    even = None
    if n and step is not None:
        even = tuple(((start or 0.0) + step * np.arange(int(n))).tolist())
    listed = _listed(path)
    if listed is None:
        return even, ()
    name, angles = listed
    if even is not None and len(even) != len(angles):
        return angles, (f"{name} lists {len(angles)} angles, the .xtekct announces {len(even)} projections",)
    off = 0.0 if even is None else _largest_step_error(angles, step or 0.0)
    note = (
        f"{name} is used; its steps leave the even ones by up to {off:.3g} deg" if off > EVEN_DEG else f"{name} is used"
    )
    return angles, (note,)


def _largest_step_error(angles: tuple[float, ...], step: float) -> float:
    steps = np.diff(np.array(angles))
    steps = (steps + 180.0) % 360.0 - 180.0
    return float(min(np.abs(steps - step).max(initial=0.0), np.abs(steps + step).max(initial=0.0)))


def _listed(path: Path) -> tuple[str, tuple[float, ...]] | None:
    for beside in (*sorted(path.parent.glob("*.ang")), *sorted(path.parent.glob("*_ctdata.txt"))):
        if path.stem not in beside.stem and len(list(path.parent.glob("*.xtekct"))) > 1:
            continue
        found = [ANGLE_LINE.match(line) for line in ForeignFile(beside).lines]
        angles = tuple(float(m[1] or m[2]) for m in found if m)
        if not angles:
            raise InputError(f"{beside} lists no angles (NUMBER: ANGLE, or NUMBER tab ANGLE a line)")
        return beside.name, angles
    return None


KIND = Kind(
    name="nikon", maker="Nikon Metrology", what="a scan description (.xtekct)", recognise=recognise, read_scanner=read
)
