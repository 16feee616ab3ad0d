"""Read a geometry of another package back into projection matrices.

A file that tomopose exported is recognised by the manifest.json beside it (same SHA-256), which then supplies detector
size, pitch, row order and names of the views, so that nothing is typed twice.  Other files need them as options where
the format does not hold them; a missing one is an error that names the option, and so is one that contradicts the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from tomopose.errors import ConventionError, FileError, InputError, SchemaVersionError
from tomopose.exports.astra import from_astra
from tomopose.exports.cera import cera_config, from_cera
from tomopose.exports.cil import from_cil
from tomopose.exports.ctsimu import from_ctsimu
from tomopose.exports.folder import FORMATS, MANIFEST
from tomopose.exports.leap import from_leap
from tomopose.exports.openct import from_openct
from tomopose.exports.panel import Given, Rows
from tomopose.exports.pyronn import from_pyronn
from tomopose.exports.rtk import from_rtk
from tomopose.exports.tigre import from_tigre
from tomopose.files import read_json
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.provenance import sha256
from tomopose.reading import parse_json, read_text, reader, reading, require_file, require_inside
from tomopose.reading.arrays import MAGIC, ZIP_MAGIC, read_npy, read_npz


@reader("geometry file", folder=True)
def read_geometry(
    path: Path | str,
    *,
    format: str | None = None,
    n_u: int | None = None,
    n_v: int | None = None,
    p_u: float | None = None,
    p_v: float | None = None,
    rows: Rows | None = None,
    side: Path | str | None = None,
) -> ProjectionMatrices:
    """Projection matrices, points of W (mm) to pixels of D, of a geometry file of another package.

    Parameters
    ----------
    path:     an RTK XML, ASTRA .npy, CERA .config (or its table), openCT or CTSimU JSON, the npz (or JSON of the same
              keys) of leap, tigre, cil or pyronn; or the manifest.json or folder of an export.
    format:   its name; without it the content must be unmistakable.  Of an export folder: which file (default: first).
    n_u, n_v: detector size, px.  p_u, p_v: pitch, mm.  Needed where the file does not hold them.
    rows:     which detector row is row 0 of the arrays the geometry was made for; "bottom": v = r, "top":
              v = n_v - 1 - r.  astra, leap and pyronn need it.  rtk and tigre state it themselves and refuse a
              contradiction.  cil, cera, openct and ctsimu count v upwards by definition or name their own frame: it
              changes nothing there.
    side:     rtk.json of an RTK XML: origin (mm) of pixel (0, 0), spacing, world axes.

    Raises
    ------
    FileError where a file cannot be read, SchemaVersionError for a newer one, InputError for everything else: a missing
    or contradicting option, a count that does not match, a value that is not finite.
    """
    path = Path(path)
    if path.is_dir() or path.name == MANIFEST:
        path, format = _file_of_export(path if path.is_dir() else path.parent, format)
    elif not path.exists():
        raise FileError(f"{path} does not exist", path=path)
    if format is not None and format not in FORMATS:
        raise ConventionError(f"unknown format {format!r}; known are {', '.join(FORMATS)}")
    given = Given(n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v, rows=rows)
    record = _record_of(path)
    if record is not None:
        given = _filled(given, record, path, format)
    if side is None and record is not None and "rtk.json" in record.siblings:
        side = path.parent / "rtk.json"
        require_described(side, record.manifest["formats"][record.format]["files"]["rtk.json"])
    content = _load(path)
    found = _format_of(content)
    if format is not None and found is not None and format != found:
        raise ConventionError(f"{path} is a file of format {found}, not {format}")
    name = format or found
    if name is None:
        raise ConventionError(
            f"the format of {path} cannot be told from its content; give it (--format); known are {', '.join(FORMATS)}"
        )
    if name == "rtk":
        return _read_rtk(content, given, side, path)
    if name == "cera":
        return _read_cera(content, given, path)
    _require_kind(content, np.ndarray if name == "astra" else Mapping, name, path)
    return _FROM[name](content, given, where=str(path))


_FROM: Mapping[str, Callable[..., ProjectionMatrices]] = {
    "astra": from_astra,
    "leap": from_leap,
    "tigre": from_tigre,
    "cil": from_cil,
    "openct": from_openct,
    "ctsimu": from_ctsimu,
    "pyronn": from_pyronn,
}


def _load(path: Path) -> Any:
    """Content by the file's first bytes: an array, a mapping of arrays, a JSON object or text."""
    require_file(path, "geometry file")
    with reading(path, "geometry file"), open(path, "rb") as stream:
        head = stream.read(6)
    if head == MAGIC:
        return read_npy(path, "geometry file")
    if head[:4] == ZIP_MAGIC:
        return read_npz(path, "geometry file")
    text = read_text(path)
    return parse_json(text, path, constants=True) if text.lstrip().startswith("{") else text


def _format_of(content: Any) -> str | None:
    """The format, from unmistakable content only; None where there is doubt."""
    if isinstance(content, np.ndarray):
        return "astra" if content.ndim == 2 and content.shape[1] == 12 else None
    if isinstance(content, str):
        if "<RTKThreeDCircularGeometry" in content:
            return "rtk"
        is_cera = content.startswith(("projtable.txt version", "#CERACONFIG")) or "ProjectionMatrixFilename" in content
        return "cera" if is_cera else None
    if "OpenCTJSON" in content:
        return "openct"
    file = content.get("file")
    if isinstance(file, Mapping) and file.get("file_type") == "CTSimU Scenario":
        return "ctsimu"
    telling = {"leap": "module_centers", "tigre": "rotDetector", "cil": "direction_x", "pyronn": "projection_matrices"}
    matches = [name for name, key in telling.items() if key in content]
    return matches[0] if len(matches) == 1 else None


def _require_kind(content: Any, kind: Any, format: str, path: Path) -> None:
    if not isinstance(content, kind):
        raise ConventionError(f"{path} is no file of format {format}")


def _read_text(path: Path) -> str:
    content = _load(path)
    _require_kind(content, str, "cera", path)
    return str(content)


def _read_rtk(content: Any, given: Given, side: Path | str | None, path: Path) -> ProjectionMatrices:
    _require_kind(content, str, "rtk", path)
    if side is None:
        raise InputError(
            f"{path}: an RTK geometry does not hold where pixel (0, 0) lies; give side (--side rtk.json), a JSON with "
            '"origin": [ox, oy] and "spacing": [p_u, p_v] in mm and, unless it is W to (y, z, x), "world_to_rtk"'
        )
    data = _load(Path(side)) if Path(side).exists() else None
    if not isinstance(data, Mapping):
        raise FileError(f"{side} does not exist or holds no JSON object", path=side)
    return from_rtk(content, data, given, where=str(path))


def _read_cera(content: Any, given: Given, path: Path) -> ProjectionMatrices:
    _require_kind(content, str, "cera", path)
    if content.startswith("projtable.txt"):
        return from_cera(content, given, where=str(path))
    # The names in a .config come from Windows: both kinds of separators occur.
    name = PureWindowsPath(cera_config(content, where=str(path))[1])
    table = require_inside(path.parent, name.name if name.anchor else str(name), str(path))
    if not table.is_file():
        raise FileError(f"{path} names the table {table.name}, but {table} does not exist", path=table)
    return from_cera(_read_text(table), given, config=content, where=str(path))


@dataclass(frozen=True, kw_only=True)
class _Record:
    """What a manifest says about one file: the export's detector and views, its row order, the files beside it."""

    manifest: Mapping[str, Any]
    format: str
    row0: str
    siblings: frozenset[str]


def _manifest(folder: Path) -> Mapping[str, Any]:
    """The manifest of an export folder, its parts of the right kinds; FileError where it is damaged."""
    path = folder / MANIFEST
    manifest = read_json(path, "exports")
    formats, names = manifest.get("formats"), manifest.get("pose_id", [])
    if not isinstance(formats, Mapping) or not isinstance(names, list):
        raise FileError(f"{path} is damaged: formats is no object, or pose_id no list", path=path)
    for format, entry in formats.items():
        files = entry.get("files") if isinstance(entry, Mapping) else None
        if not isinstance(files, Mapping) or not files or not all(isinstance(f, str) for f in files.values()):
            raise FileError(f"{path} is damaged: format {format!r} names no files with their SHA-256", path=path)
        for name in files:
            require_inside(folder, name, str(path))
    return manifest


def _record_of(path: Path) -> _Record | None:
    """The manifest's entry for this very file, or None where no manifest beside it names it.

    FileError where the manifest names it with another SHA-256: the file was changed, or belongs to another export.
    """
    manifest_path = path.parent / MANIFEST
    if not manifest_path.is_file():
        return None
    try:
        manifest = _manifest(path.parent)
    except SchemaVersionError:
        return None  # another program's manifest.json: it says nothing about this file
    for name, entry in manifest["formats"].items():
        if path.name in entry["files"]:
            require_described(path, entry["files"][path.name])
            return _Record(
                manifest=manifest, format=name, row0=entry.get("row0", "bottom"), siblings=frozenset(entry["files"])
            )
    return None


def require_described(path: Path, digest: str) -> None:
    """FileError unless the file has the SHA-256 that the manifest beside it says."""
    require_file(path, "file of an export")
    if sha256(path) != digest:
        raise FileError(
            f"{path} is not the file that {MANIFEST} beside it describes (its SHA-256 differs): it was edited, or an "
            "export was interrupted; export again, or move the file to another folder if it is meant as it is",
            path=path,
        )


def _filled(given: Given, record: _Record, path: Path, format: str | None) -> Given:
    """The caller's values completed by the manifest's; InputError where they contradict."""
    if format is not None and format != record.format:
        raise ConventionError(f"{path} is a file of format {record.format}, not {format}")
    where = str(path.parent / MANIFEST)
    keys = {"n_u": "n_u_px", "n_v": "n_v_px", "p_u": "p_u_mm", "p_v": "p_v_mm"}
    values = {k: given.settle(k, record.manifest.get(v), where) for k, v in keys.items()}
    if record.format in ("astra", "leap", "pyronn"):
        values["rows"] = given.settle("rows", record.row0, where)
    return replace(given, **values, pose_id=tuple(record.manifest.get("pose_id", ())) or None)


def _file_of_export(folder: Path, format: str | None) -> tuple[Path, str]:
    """The file of an export folder that holds the geometry in that format, or in its first one."""
    formats = _manifest(folder)["formats"]
    name = format or next(iter(formats), "")
    if name not in formats:
        raise InputError(f"{folder} holds no format {name!r}; it holds {', '.join(formats) or 'none'}")
    path = folder / next(iter(formats[name]["files"]))
    if not path.is_file():
        raise FileError(f"{folder / MANIFEST} names {path.name}, but it does not exist", path=path)
    for sibling, digest in formats[name]["files"].items():
        require_described(folder / sibling, digest)
    return path, name
