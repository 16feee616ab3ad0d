"""One kind of foreign file: how it is recognised, what it holds, who reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions
from tomopose.io.foreign.scanner_draft import ScannerDraft


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of file.

    name:         the word of --format.
    maker, what:  for messages: "KUKA", "a KRL program".
    recognise:    whether a file is of this kind, from its content first and its name's ending second.
    read_poses, read_scanner: the readers of what it holds; None where it does not hold that.
    holds_geometry: whether `import-geometry` reads it.
    way_on:       what to do where tomopose does not read it.
    """

    name: str
    maker: str
    what: str
    recognise: Callable[[ForeignFile], bool]
    read_poses: Callable[[ForeignFile, PoseOptions], PoseLog] | None = None
    read_scanner: Callable[[ForeignFile], ScannerDraft] | None = None
    holds_geometry: bool = False
    way_on: str = ""
