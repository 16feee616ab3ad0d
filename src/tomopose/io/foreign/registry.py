"""All kinds of foreign files that are known, most specific first, and the one that a file is."""

from __future__ import annotations

from pathlib import Path

from tomopose.errors import ConventionError, FileError
from tomopose.io.foreign import (
    abb,
    ctsimu_scenario,
    dicom_file,
    diondo,
    fanuc,
    key_values,
    kuka,
    matrices4x4,
    nikon,
    north_star,
    nxtomo,
    phoenix,
    pi_dictionaries,
    pi_gcs,
    pi_recorder,
    pose_table,
    robot_json,
    rx_solutions,
    skyscan,
    staubli,
    universal_robots,
    yaskawa,
    yxlon,
    zeiss,
)
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.unread_kinds import likely_kind

KINDS: tuple[Kind, ...] = (
    nxtomo.KIND,
    dicom_file.KIND,
    zeiss.KIND,
    nikon.KIND,
    phoenix.KIND,
    skyscan.KIND,
    rx_solutions.KIND,
    rx_solutions.VIEWS,
    north_star.KIND,
    yxlon.KIND,
    diondo.KIND,
    ctsimu_scenario.KIND,
    robot_json.KIND,
    pi_recorder.KIND,
    universal_robots.RECORDING,
    kuka.KIND,
    fanuc.KIND,
    abb.KIND,
    yaskawa.KIND,
    staubli.KIND,
    universal_robots.SCRIPT,
    pi_dictionaries.KIND,
    pi_gcs.KIND,
    matrices4x4.KIND,
    key_values.KIND,
    pose_table.KIND,
)
"""A file is of the first kind that recognises it."""
ALIASES = {
    "kuka-krl": ("kuka",),
    "abb-rapid": ("abb",),
    "ur-script": ("ur",),
    "ur": ("ur", "ur-rtde"),
    "pi-gcs": ("pi-gcs", "pi-recorder", "pi-python"),
    "pi": ("pi-gcs", "pi-recorder", "pi-python"),
    "table": ("csv",),
}
"""Words of --format that denote one kind or several."""


def kind_of(file: ForeignFile) -> Kind | None:
    """The kind of a file, None where it is of no known one."""
    return next((kind for kind in KINDS if kind.recognise(file)), None)


def pose_kind(file: ForeignFile, format: str | None) -> Kind:
    """The kind whose reader gives a file's poses.

    Raises ConventionError for an unknown format, FileError, with how to proceed, where the file is of another kind.
    """
    readers = {k.name: k for k in KINDS if k.read_poses is not None}
    if format is not None:
        names = ALIASES.get(format, (format,))
        asked = [readers[n] for n in names if n in readers]
        if not asked:
            raise ConventionError(f"unknown format {format!r} of poses; known are {', '.join(readers)}")
        found = next((k for k in asked if k.recognise(file)), None)
        if found is not None or len(asked) == 1 or (asked[0].name == format and kind_of(file) is pose_table.KIND):
            return found or asked[0]
        raise FileError(f"{file.path} is not of format {format}; {_what_it_is(file, 'poses')}", path=file.path)
    kind = kind_of(file)
    if kind is None or kind.read_poses is None:
        raise FileError(f"{file.path}: {_what_it_is(file, 'poses')}", path=file.path)
    return kind


def scanner_kind(file: ForeignFile) -> Kind:
    """The kind whose reader gives a file's scanner; FileError, with how to proceed, where it is of another kind."""
    kind = kind_of(file)
    if kind is None or kind.read_scanner is None:
        raise FileError(f"{file.path}: {_what_it_is(file, 'scanner')}", path=file.path)
    return kind


def describe(path: str | Path, wanted: str) -> str:
    """What a file likely is and how to proceed, for whoever wanted `poses`, `scanner`, `geometry` or `images` of it."""
    return _what_it_is(ForeignFile(Path(path)), wanted)


def _what_it_is(file: ForeignFile, wanted: str) -> str:
    kind = kind_of(file)
    if kind is None:
        return likely_kind(file, wanted)
    verbs = []
    if kind.read_poses is not None and wanted != "poses":
        verbs.append(f"its poses: tomopose import-poses {file.path.name} --out poses.csv")
    if kind.read_scanner is not None and wanted != "scanner":
        verbs.append(f"its scanner: tomopose import-scanner {file.path.name} --out scanner.json")
    if kind.holds_geometry and wanted != "geometry":
        verbs.append(f"its geometry: tomopose import-geometry {file.path.name} --out matrices.npz")
    way = "; ".join(verbs) or kind.way_on
    return f"this is {kind.what} of {kind.maker}, which holds no {wanted}" + (f"; read {way}" if way else "")
