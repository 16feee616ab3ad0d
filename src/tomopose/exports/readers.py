"""The geometry formats that are read: how each is recognised from content, and which reader takes it.

One entry a format; a file is of the first format that recognises it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from tomopose.errors import ConventionError, FileError, InputWarning
from tomopose.exports.astra import from_astra
from tomopose.exports.cera import cera_config, from_cera, is_cera_table
from tomopose.exports.cil import from_cil
from tomopose.exports.content import load
from tomopose.exports.ctsimu import from_ctsimu
from tomopose.exports.leap import from_leap
from tomopose.exports.openct import from_openct
from tomopose.exports.panel import Given
from tomopose.exports.plain_matrices import from_matrices, matrices_in
from tomopose.exports.pyronn import from_pyronn
from tomopose.exports.robot_json import from_robot_json, is_robot_json
from tomopose.exports.rtk import from_rtk
from tomopose.exports.rx_views import from_rx_views, is_rx_views
from tomopose.exports.tigre import from_tigre
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reading import require_inside


@dataclass(frozen=True, kw_only=True)
class Source:
    """A file to be read: its content, where it is, and its side file."""

    content: Any
    path: Path
    side: Path | None = None

    def require(self, kind: type | tuple[type, ...], format: str) -> Any:
        """The content, if it is of that type; ConventionError otherwise."""
        if not isinstance(self.content, kind):
            raise ConventionError(f"{self.path} is not a file of format {format}")
        return self.content


@dataclass(frozen=True, kw_only=True)
class Reader:
    """How one format is recognised, from unmistakable content alone, and read."""

    recognise: Callable[[Any], bool]
    read: Callable[[Source, Given], ProjectionMatrices]


def _keyed(format: str, key: str, read: Callable[..., ProjectionMatrices]) -> Reader:
    """A format of named arrays, recognised by one of its keys."""

    def reading(source: Source, given: Given) -> ProjectionMatrices:
        return read(source.require(Mapping, format), given, where=str(source.path))

    return Reader(recognise=lambda c: isinstance(c, Mapping) and key in c, read=reading)


def _is_astra(content: object) -> bool:
    return isinstance(content, np.ndarray) and content.ndim == 2 and content.shape[1] == 12


def _read_astra(source: Source, given: Given) -> ProjectionMatrices:
    content = source.content
    if isinstance(content, str):  # twelve numbers a row, as text
        P = matrices_in(content)
        content = content if P is None else P.reshape(-1, 12)
    if not isinstance(content, np.ndarray):
        raise ConventionError(f"{source.path} is not a file of format astra")
    return from_astra(content, given, where=str(source.path))


def _read_rtk(source: Source, given: Given) -> ProjectionMatrices:
    text = source.require(str, "rtk")
    side = None
    if source.side is not None:
        side = load(source.side) if source.side.exists() else None
        if not isinstance(side, Mapping):
            raise FileError(f"{source.side} does not exist or holds no JSON object", path=source.side)
    matrices = from_rtk(text, side, given, where=str(source.path))
    if side is None:
        warnings.warn(
            f"{source.path}: no side file says where pixel (0, 0) lies; the panel is taken as centred on RTK's "
            "detector "
            "origin, and W as RTK's axes (y, z, x)",
            InputWarning,
            stacklevel=2,
        )
    return matrices


def _is_cera(content: object) -> bool:
    if not isinstance(content, str):
        return False
    return is_cera_table(content) or content.startswith("#CERACONFIG") or "ProjectionMatrixFilename" in content


def _read_cera(source: Source, given: Given) -> ProjectionMatrices:
    text, path = source.require(str, "cera"), source.path
    if is_cera_table(text):
        return from_cera(text, given, where=str(path))
    table = _table_of(path, cera_config(text, where=str(path))[1])
    content = load(table)
    if not isinstance(content, str):
        raise ConventionError(f"{table} is not a table of projection matrices")
    return from_cera(content, given, config=text, where=str(path))


def _table_of(config: Path, name: str) -> Path:
    """The table that a .config names: as it is named, or, where that folder is another computer's, beside the
    .config.
    """
    # The names in a .config come from Windows: both kinds of separators occur.
    said = PureWindowsPath(name)
    named = require_inside(config.parent, said.name if said.anchor else said.as_posix(), str(config))
    beside = config.parent / said.name
    if named.is_file() and not said.anchor:
        return named
    if not beside.is_file():
        raise FileError(f"{config} names the table {name}; it does not exist, nor does {beside}", path=beside)
    warnings.warn(
        f"{config} names the table {name}, which is not here; {beside.name} beside it was read",
        InputWarning,
        stacklevel=2,
    )
    return beside


def _read_robot_json(source: Source, given: Given) -> ProjectionMatrices:
    content = source.require((Mapping, list), "thd")
    return from_robot_json(content, given, where=str(source.path))


def _is_ctsimu(content: object) -> bool:
    file = content.get("file") if isinstance(content, Mapping) else None
    return isinstance(file, Mapping) and file.get("file_type") == "CTSimU Scenario"


def _read_ctsimu(source: Source, given: Given) -> ProjectionMatrices:
    content = source.require(Mapping, "ctsimu")
    return from_ctsimu(content, given.with_values(folder=source.path.parent), where=str(source.path))


READERS: Mapping[str, Reader] = {
    "rtk": Reader(recognise=lambda c: isinstance(c, str) and "<RTKThreeDCircularGeometry" in c, read=_read_rtk),
    "cera": Reader(recognise=_is_cera, read=_read_cera),
    "rx": Reader(
        recognise=lambda c: isinstance(c, str) and is_rx_views(c),
        read=lambda s, given: from_rx_views(s.require(str, "rx"), given, where=str(s.path)),
    ),
    "thd": Reader(recognise=is_robot_json, read=_read_robot_json),
    "openct": _keyed("openct", "OpenCTJSON", from_openct),
    "ctsimu": Reader(recognise=_is_ctsimu, read=_read_ctsimu),
    "leap": _keyed("leap", "module_centers", from_leap),
    "tigre": _keyed("tigre", "rotDetector", from_tigre),
    "cil": _keyed("cil", "direction_x", from_cil),
    "pyronn": _keyed("pyronn", "projection_matrices", from_pyronn),
    "astra": Reader(recognise=_is_astra, read=_read_astra),
    "matrices": Reader(
        recognise=lambda c: matrices_in(c) is not None,
        read=lambda s, given: from_matrices(s.content, given, where=str(s.path)),
    ),
}
"""Format -> reader, most specific first."""


def format_of(content: object) -> str | None:
    """The format of a content; None where none is certain."""
    found = [name for name, reader in READERS.items() if reader.recognise(content)]
    keyed = [name for name in found if name in ("leap", "tigre", "cil", "pyronn")]
    if len(keyed) > 1:
        return None
    return found[0] if found else None
