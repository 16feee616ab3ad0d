"""What an NXtomo entry says about the scan: distances, pixel sizes, table angles, each with the unit that it states.

NeXus counts distances from the sample: the source's is negative, the detector's positive.  A value whose unit is
missing is named and not used.  Source: NeXus application definition NXtomo; nxtomo 3 (instrument/source/distance).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from tomopose.io.images.stated import Stated
from tomopose.units import Array

if TYPE_CHECKING:
    import h5py

LENGTHS = {"m": 1000.0, "metre": 1000.0, "meter": 1000.0, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "nm": 1e-6}
ANGLES = {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "rad": 180 / np.pi, "radian": 180 / np.pi, "radians": 180 / np.pi}
DATA = "instrument/detector/data"
KEYS = "instrument/detector/image_key"


@dataclass
class NexusValues:
    """Datasets of an NXtomo entry in mm and deg; what has no usable unit is collected by name."""

    entry: Any
    without_unit: list[str] = field(default_factory=list)

    def read(self, name: str, units: Mapping[str, float]) -> Array | None:
        """A dataset in the unit that `units` scales to; None where it or its unit is missing."""
        if name not in self.entry:
            return None
        data = self.entry[name]
        unit = data.attrs.get("units", b"")
        unit = unit.decode() if isinstance(unit, bytes) else str(unit)
        if unit.strip().lower() not in units:
            self.without_unit.append(f"{name} ({unit or 'no unit'})")
            return None
        return np.atleast_1d(np.asarray(data[()], dtype=np.float64)) * units[unit.strip().lower()]

    def length(self, *names: str) -> float | None:
        """The first number of the first dataset that is there, mm."""
        for name in names:
            found = self.read(name, LENGTHS)
            if found is not None and found.size and np.isfinite(found).all():
                return float(found.reshape(-1)[0])
        return None

    def angles(self, n: int) -> Array | None:
        """The table angle of each of n frames, deg; None where they are not all there."""
        found = self.read("sample/rotation_angle", ANGLES)
        return found if found is not None and found.shape == (n,) and np.isfinite(found).all() else None


def entries(nexus: h5py.File) -> Iterator[Any]:
    """The entries of a file that have a detector's data and a sample's angle."""
    for entry in nexus.values():
        if hasattr(entry, "values") and DATA in entry and "sample/rotation_angle" in entry:
            yield entry


def stated_by(entry: object) -> Stated:
    """Distances and pixel sizes of an entry, mm."""
    values = NexusValues(entry)
    source = values.length("instrument/source/distance", "instrument/SOURCE/distance")
    detector = values.length("instrument/detector/distance")
    found = {
        "d_SR_mm": None if source is None else abs(source),
        "d_SD_mm": None if source is None or detector is None else abs(source) + abs(detector),
        "p_u_mm": values.length("instrument/detector/x_pixel_size"),
        "p_v_mm": values.length("instrument/detector/y_pixel_size"),
    }
    fields = {"d_SR_mm": "source distance", "d_SD_mm": "source distance + detector distance"}
    fields |= {"p_u_mm": "x_pixel_size", "p_v_mm": "y_pixel_size"}
    notes = [f"no usable unit, not used: {', '.join(values.without_unit)}"] if values.without_unit else []
    if found["d_SD_mm"] is None:
        notes.append("source and detector distance are not both stated (a parallel beam has none)")
    both = found["d_SD_mm"] is not None
    return Stated(
        values={k: v for k, v in found.items() if v is not None and v > 0},
        fields=fields,
        readings=("distances count from the sample; d_SD is the sum of source and detector distance",) if both else (),
        notes=tuple(notes),
    )
