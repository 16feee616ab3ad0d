"""What every reader of a scanner's file gives: the values that it states, and what it does not say, by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tomopose.errors import InputError
from tomopose.values import value

GEOMETRY = ("d_SD_mm", "d_SR_mm", "p_u_mm", "p_v_mm", "n_u_px", "n_v_px")
PIERCING = ("u_0_px", "v_0_px")
COUNTS = ("n_u_px", "n_v_px")
CHECK_TOLERANCE = 2e-3
"""Two statements of one length in a file agree if they differ by less than this, relative: three digits."""


@value
class ScannerDraft:
    """The scanner as a maker's file states it.

    values:   keys of scanner.json (mm, px, rad) -> numbers.
    kind, maker: what the file is.
    readings: fields that can be read in two ways, and which way was taken.
    unused:   what the file says that scanner.json has no place for.
    notes:    contradictions and remarks.
    angles_deg: table angles of the scan's views, where the file lists them.
    image_rows: row order of the image files, where the file says it.
    """

    path: Path
    kind: str
    maker: str
    values: Mapping[str, float]
    readings: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    angles_deg: tuple[float, ...] | None = None
    image_rows: str | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """The keys that a scanner needs and the file does not state."""
        return tuple(k for k in GEOMETRY if k not in self.values)

    @property
    def assumed(self) -> tuple[str, ...]:
        """The keys that are assumed: the beam's perpendicular meets the middle of the panel."""
        return tuple(k for k in PIERCING if k not in self.values and all(c in self.values for c in COUNTS))

    def document(self) -> dict[str, Any]:
        """The content of scanner.json; a draft with missing keys is refused by name when it is read."""
        document: dict[str, Any] = {}
        for key in GEOMETRY[:4] + PIERCING + COUNTS:
            if key in self.values:
                value = self.values[key]
                document[key] = int(value) if key in COUNTS else float(value)
            elif key in self.assumed:
                document[key] = (self.values["n_u_px" if key == "u_0_px" else "n_v_px"] - 1) / 2
        document |= {k: float(v) for k, v in self.values.items() if k not in document}
        if self.image_rows is not None:
            document["image_rows"] = self.image_rows
        return document

    def lines(self) -> list[str]:
        """What was read, for people."""
        said = [f"  {k} = {v:g}" for k, v in self.values.items()]
        words = [f"{self.path.name} is {self.kind} ({self.maker}); it states:", *said]
        if self.missing:
            words.append(f"  not stated: {', '.join(self.missing)}; add them to the draft before it can be used")
        if self.assumed:
            words.append(
                f"  not stated: {', '.join(self.assumed)}; the middle of the panel is assumed, and a calibration "
                "treats it as uncertain"
            )
        words.append("  no uncertainty is stated: the documented defaults apply; add sigma where a certificate says it")
        words += [f"  reading: {r}" for r in self.readings]
        words += [f"  note: {n}" for n in self.notes]
        if self.unused:
            words.append(f"  not used: {'; '.join(self.unused)}")
        return words


def sensible(values: Mapping[str, float | None], where: str) -> dict[str, float]:
    """The values that are there; InputError names one that is no positive, finite number or no whole number of
    pixels.
    """
    out = {}
    for key, given in values.items():
        if given is None:
            continue
        positive = key in GEOMETRY
        if not math.isfinite(given) or (positive and given <= 0) or (key in COUNTS and given != int(given)):
            raise InputError(f"{where}: {key} would be {given:g}; a positive number is needed")
        out[key] = given
    if "d_SD_mm" in out and "d_SR_mm" in out and out["d_SR_mm"] >= out["d_SD_mm"]:
        raise InputError(
            f"{where}: the object ({out['d_SR_mm']:g} mm from the source) lies behind the detector "
            f"({out['d_SD_mm']:g} mm); are the two distances exchanged?"
        )
    return out


def compared(stated: float | None, computed: float | None, what: str, how: str) -> str:
    """A note where a file contradicts itself; "" where it agrees or says nothing."""
    if stated is None or computed is None or stated == 0:
        return ""
    if abs(computed / stated - 1) <= CHECK_TOLERANCE:
        return ""
    return f"the file contradicts itself: {what} is {stated:g}, but {how} give {computed:g}"


def kept(*notes: str) -> tuple[str, ...]:
    """The notes that say something."""
    return tuple(n for n in notes if n)


def named(pairs: Mapping[str, str], keys: Sequence[str]) -> tuple[str, ...]:
    """`key = value` of those keys that are there, for the list of what is not used."""
    return tuple(f"{k} = {pairs[k]}" for k in keys if k in pairs)
