"""Read a geometry of another package back into projection matrices.

A file that tomopose exported is recognised by the manifest.json beside it (same SHA-256), which then supplies detector
size, pitch, row order and names of the views, so that nothing is typed twice.  Other files need them as options where
the format does not hold them; a missing one is an error that names the option, and so is one that contradicts the file.
Numbers in another unit and mirrored images are caught here, not when they are exported again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tomopose.errors import ConventionError, FileError, InputError, SchemaVersionError, UnknownKindError
from tomopose.exports.content import load
from tomopose.exports.folder import FORMATS, MANIFEST
from tomopose.exports.import_checks import require_millimetres, require_unmirrored, scaled_to_mm
from tomopose.exports.panel import Given, Rows
from tomopose.exports.readers import READERS, Source, format_of
from tomopose.exports.robot_json import is_robot_json
from tomopose.files import natural_key, read_json
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.provenance import sha256
from tomopose.reading import reader, require_file, require_inside

KNOWN = ", ".join([*FORMATS, "matrices"])
STATE_THEIR_UNIT = ("openct", "ctsimu", "thd")
"""Formats whose files name the unit of their lengths: what looks like another unit is then a rare geometry."""
HOLD_THEIR_PITCH = ("astra", "leap", "tigre", "cil", "rx", "thd")
"""Formats whose own numbers give the pitch, in their own unit."""


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
    unit_mm: float | None = None,
    mirrored: bool = False,
) -> ProjectionMatrices:
    """Projection matrices, points of W (mm) to pixels of D, of a geometry file of another package.

    Parameters
    ----------
    path:     an RTK XML, ASTRA .npy, CERA .config (or its table), openCT or CTSimU JSON, the npz (or JSON of the same
              keys) of leap, tigre, cil or pyronn; bare matrices (n, 3, 4) as .npy, .mat or text of twelve numbers a
              row; robot-CT JSON (a view, or a folder of views); geom.csv of RX Solutions; or the manifest.json or
              folder of an export.
    format:   its name; without it the content must be unmistakable.  Of an export folder: which file (default: first).
    n_u, n_v: detector size, px.  p_u, p_v: pitch, mm.  Needed where the file does not hold them.
    rows:     which detector row is row 0 of the arrays the geometry was made for; "bottom": v = r, "top":
              v = n_v - 1 - r.  astra, leap, pyronn and bare matrices need it.  rtk and tigre state it themselves and
              refuse a contradiction.  cil, cera, openct, ctsimu, thd and rx count v upwards by definition or name their
              own frame: it changes nothing there.
    side:     rtk.json of an RTK XML: origin (mm) of pixel (0, 0), spacing, world axes.
    unit_mm:  what one unit of the file is, mm; without it mm are taken, and numbers that cannot be are refused.
    mirrored: the images are mirror images, seen from the source, and that is right.

    Raises
    ------
    FileError where a file cannot be read, UnknownKindError where its format is not certain, SchemaVersionError for a
    newer one, UnitError for another unit, InputError for everything else: a missing or contradicting option, a count
    that does not match, a value that is not finite, mirrored images.
    """
    path = Path(path)
    if path.is_dir() and not (path / MANIFEST).is_file():
        content, record = _views_of_folder(path), _record_of(path)
    else:
        if path.is_dir() or path.name == MANIFEST:
            path, format = _file_of_export(path if path.is_dir() else path.parent, format)
        content, record = None, _record_of(path)
    if format is not None and format not in READERS:
        raise ConventionError(f"unknown format {format!r}; known are {KNOWN}")
    given = Given(n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v, rows=rows)
    if record is not None:
        given = _filled(given, record, path, format)
    if side is None and record is not None and "rtk.json" in record.siblings:
        side = path.parent / "rtk.json"
        require_described(side, record.manifest["formats"][record.format]["files"]["rtk.json"])
    if content is None:
        content = _views_of_folder(path) if path.is_dir() else load(path)
    name = _name(content, format, path)
    source = Source(content=content, path=path, side=None if side is None else Path(side))
    if unit_mm is not None and name in HOLD_THEIR_PITCH:  # the file's own pitch is in its own unit
        inner = given.with_values(
            p_u=None if given.p_u is None else given.p_u / unit_mm,
            p_v=None if given.p_v is None else given.p_v / unit_mm,
        )
    else:
        inner = given
    matrices = READERS[name].read(source, inner)
    if unit_mm is None:
        if record is None and name not in STATE_THEIR_UNIT:
            require_millimetres(matrices, str(path))
    else:
        matrices = scaled_to_mm(matrices, unit_mm, scale_pitch=name in HOLD_THEIR_PITCH)
    if record is None and not mirrored:
        require_unmirrored(matrices, str(path), rows=given.rows)
    return matrices


def _name(content: object, format: str | None, path: Path) -> str:
    """The format's name; ConventionError where the file is of another one than the caller says."""
    found = format_of(content)
    if format is None:
        if found is None:
            raise UnknownKindError(
                f"the format of {path} cannot be determined from its content; give it (--format); known are {KNOWN}",
                path=path,
            )
        return found
    # Twelve numbers a row can be vectors or matrices: there the caller's word decides.
    if found is not None and format != found and {format, found} != {"astra", "matrices"}:
        raise ConventionError(f"{path} is a file of format {found}, not {format}")
    return format


def _views_of_folder(folder: Path) -> list[Any]:
    """The views of a robot scanner in a folder, one JSON each, in the order of their names."""
    files = sorted(folder.glob("*.json"), key=lambda p: natural_key(p.name))
    views = [load(f) for f in files]
    if not views or not all(is_robot_json(v) for v in views):
        raise FileError(
            f"{folder} is a folder without {MANIFEST} and without the views (JSON) of a robot scanner; give the "
            "geometry's "
            "file",
            path=folder,
        )
    return views


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
    """The manifest's entry for this very file (or for a folder of its files); None where no manifest names it.

    FileError where the manifest names it with another SHA-256: the file was changed, or belongs to another export.
    """
    manifest_path = path.parent / MANIFEST
    if not manifest_path.is_file():
        return None
    try:
        manifest = _manifest(path.parent)
    except SchemaVersionError:
        return None  # another program's manifest.json: it says nothing about this file
    for format, entry in manifest["formats"].items():
        mine = [f for f in entry["files"] if f == path.name or f.startswith(f"{path.name}/")]
        for name in mine:
            require_described(path.parent / name, entry["files"][name])
        if mine:
            return _Record(
                manifest=manifest, format=format, row0=entry.get("row0", "bottom"), siblings=frozenset(entry["files"])
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
    first = next(iter(formats[name]["files"]))
    path = folder / first.split("/")[0]
    if not (folder / first).is_file():
        raise FileError(f"{folder / MANIFEST} names {path.name}, but it does not exist", path=path)
    for sibling, digest in formats[name]["files"].items():
        require_described(folder / sibling, digest)
    return path, name
