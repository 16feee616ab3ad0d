"""NXtomo (NeXus): the scanner of an entry, and the table angle and translations of its sample as poses.

Source: NeXus application definition NXtomo; nxtomo 3.  io/images/formats/nexus.py reads values with their units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tomopose.errors import FileError, InputError
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible
from tomopose.io.images.formats.nexus import DATA, KEYS, LENGTHS, NexusValues, entries, stated_by
from tomopose.reading import reading
from tomopose.reading.hdf5 import checked_hdf5

if TYPE_CHECKING:
    import h5py

HDF5 = b"\x89HDF"
PROJECTION = 0


def recognise(file: ForeignFile) -> bool:
    """HDF5 with an entry that has a detector with data and a sample with rotation_angle."""
    if file.head[:4] != HDF5:
        return False
    import h5py

    try:
        with reading(file.path, "HDF5 file"), h5py.File(checked_hdf5(file.path), "r") as nexus:
            return next(entries(nexus), None) is not None
    except FileError:
        return False


def _open(file: ForeignFile) -> Any:
    import h5py

    with reading(file.path, "HDF5 file (truncated?)"):
        return h5py.File(checked_hdf5(file.path), "r")


def read(file: ForeignFile) -> ScannerDraft:
    """The scanner of an NXtomo entry."""
    with _open(file) as nexus:
        entry = _only(nexus, file)
        said = stated_by(entry)
        shape = entry[DATA].shape
        angles = NexusValues(entry).angles(shape[0])
        keep = _projections(entry, shape[0])
    return ScannerDraft(
        path=file.path,
        kind="an NXtomo file (NeXus)",
        maker="NeXus",
        values=sensible({**said.values, "n_u_px": float(shape[2]), "n_v_px": float(shape[1])}, str(file.path)),
        readings=said.readings,
        notes=said.notes,
        angles_deg=None if angles is None else tuple(angles[keep].tolist()),
    )


def _only(nexus: h5py.File, file: ForeignFile) -> Any:
    found = list(entries(nexus))
    if len(found) != 1:
        raise InputError(f"{file.path} holds {len(found)} NXtomo entries; one is needed")
    return found[0]


def _projections(entry: h5py.Group, n: int) -> Any:
    """The frames that are projections: image_key 0."""
    keys = entry.get(KEYS)
    keep = np.ones(n, dtype=bool) if keys is None else np.asarray(keys[()]).reshape(-1) == PROJECTION
    if len(keep) != n:
        raise InputError(f"image_key has {len(keep)} entries for {n} frames")
    return keep


def read_poses(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """Table angle and x, y, z translation of each projection; the plate does not rotate."""
    with _open(file) as nexus:
        entry = _only(nexus, file)
        n = entry[DATA].shape[0]
        keep = np.flatnonzero(_projections(entry, n))
        values = NexusValues(entry)
        angles = values.angles(n)
        moved = [values.read(f"sample/{a}_translation", LENGTHS) for a in "xyz"]
        if angles is None:
            raise InputError(f"{file.path}: sample/rotation_angle has no unit, or not one value for each of {n} frames")
        if values.without_unit:
            raise InputError(f"{file.path}: {', '.join(values.without_unit)}: a unit is needed")
    x = [np.zeros(n) if m is None else np.broadcast_to(m, (n,)) for m in moved]
    rows = tuple((*(repr(float(c[k])) for c in x), "0.0", "0.0", "0.0") for k in keep)
    return PoseLog(
        path=file.path,
        convention="pi-hexapod",
        rows=rows,
        alpha=tuple(repr(float(angles[k])) for k in keep),
        image=tuple(f"{file.path.name}[{k}]" for k in keep),
        notes=(
            "rotation_angle is the table angle, x, y, z_translation the plate's position; NXtomo holds no tilts: the "
            "plate's rotation is taken as none",
        ),
    )


KIND = Kind(
    name="nxtomo",
    maker="NeXus",
    what="an NXtomo file",
    recognise=recognise,
    read_scanner=read,
    read_poses=read_poses,
)
