"""Foreign files read: poses of a log, the scanner of a maker's file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.joining import LONGEST_GAP_S, joined, read_moments
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions
from tomopose.io.foreign.registry import pose_kind, scanner_kind
from tomopose.io.foreign.scanner_draft import ScannerDraft
from tomopose.reading import reader


@reader("pose log")
def read_pose_log(
    path: str | Path,
    *,
    format: str | None = None,
    convention: str | None = None,
    columns: Mapping[str, str] | None = None,
    units: str | None = None,
    join: str | Path | None = None,
    longest_gap_s: float = LONGEST_GAP_S,
    clock_offset_s: float = 0.0,
) -> PoseLog:
    """The poses of a controller's log, a robot's program, or a table.

    Parameters
    ----------
    path:           the file.
    format:         its kind, where the file is not to be asked: pi-gcs, kuka, abb, ur, fanuc, yaskawa, staubli,
                    matrix4, nxtomo, csv.
    convention:     whose angles they are, for tables: see `CONVENTIONS`.
    columns:        role -> column, for tables: {"x": "X_mm", "a": "A_deg"}.
    units:          unit of length of numbers that state none.
    join:           images (a folder) or a table with a time column; the poses at those times.
    longest_gap_s:  longest gap of the log across which is interpolated.
    clock_offset_s: how far the log's clock is ahead of the other.

    Returns
    -------
    PoseLog: `.poses()` is the PoseSequence, `.table()` the table for poses.csv, `.notes` what was read how.

    Raises
    ------
    FileError where the file is of another kind (the message says which, and how to proceed), InputError, UnitError and
    ConventionError by line for everything else.
    """
    file = ForeignFile(Path(path))
    kind = pose_kind(file, format)
    assert kind.read_poses is not None
    options = PoseOptions(convention=convention, columns=dict(columns or {}), units=units)
    log = kind.read_poses(file, options).with_notes()
    if join is not None:
        log = joined(log, read_moments(Path(join)), longest_gap_s=longest_gap_s, offset_s=clock_offset_s)
    return log


@reader("scanner file")
def read_scanner_draft(path: str | Path) -> ScannerDraft:
    """The scanner that a maker's file states: Nikon, phoenix, SkyScan, Zeiss, RX Solutions, North Star, Yxlon, Diondo,
    NXtomo, DICOM, CTSimU, robot-CT JSON, or `name = value` lines.

    Raises FileError where the file is of another kind (the message says which, and how to proceed), InputError where a
    value cannot be used.
    """
    file = ForeignFile(Path(path))
    kind = scanner_kind(file)
    assert kind.read_scanner is not None
    return kind.read_scanner(file)
