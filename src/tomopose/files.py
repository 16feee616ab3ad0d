"""Files that are either whole or absent: atomic writes, and JSON with a schema.

Everything is written to a temporary file in the same folder, flushed to disk and renamed, so that neither a full disk
nor Ctrl-C leaves half a file.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError, SchemaVersionError

SCHEMA = re.compile(r"tomopose/(?P<name>[a-z0-9-]+)/(?P<version>\d+)")


def require_absent(path: str | Path, *, force: bool = False) -> Path:
    """The path, if nothing is there or `force` allows to overwrite it; FileError otherwise."""
    path = Path(path)
    if path.exists() and not force:
        raise FileError(f"{path} exists already; give another name or --force to overwrite it", path=path)
    return path


@contextlib.contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary path in the same folder (same suffix); on leaving without error it takes the place of `path`.

    Raises FileError where the folder cannot be made or written, or the disk is full.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem[:40]}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}", path=path) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Flush a folder's list of names to the disk, so that a rename outlives a power cut; where the system allows it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextlib.contextmanager
def atomic_folder(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path`; on leaving without error its files move into `path`, all or none.

    Files of the same name are overwritten only with `force`; FileError says which stands in the way, before anything
    moved.  Other files in `path` stay.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        if path.exists() and not path.is_dir():
            raise FileError(f"{path} is a file; a folder is needed", path=path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name[:40]}-", dir=path.parent))
        yield temporary
        made = sorted(p.relative_to(temporary) for p in temporary.rglob("*") if p.is_file())
        for name in made:
            require_absent(path / name, force=force)
        for name in made:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(temporary / name, path / name)
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}", path=path) from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def plain(value: Any) -> Any:
    """A value as JSON knows it: arrays become lists, numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (np.integer, np.bool_)):
        return value.item()
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


def write_text(path: str | Path, text: str) -> None:
    """UTF-8 text, atomically."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: str | Path, name: str, content: Mapping[str, Any], *, version: int = 1) -> None:
    """JSON of schema `tomopose/NAME/VERSION`, atomically, floats with all their digits."""
    document = {"schema": f"tomopose/{name}/{version}", **plain(content)}
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: str | Path, name: str, *, version: int = 1) -> dict[str, Any]:
    """The content of a JSON file of schema `tomopose/NAME/1..VERSION`.

    Raises FileError where it cannot be read or is no JSON object, SchemaVersionError where the schema is missing, of
    another kind or newer.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise FileError(f"{path} does not exist", path=path) from error
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}", path=path) from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileError(f"{path} is no JSON: {error}", path=path) from error
    if not isinstance(document, dict):
        raise FileError(f"{path} holds no JSON object", path=path)
    found = SCHEMA.fullmatch(str(document.get("schema", "")))
    if not found or found["name"] != name:
        raise SchemaVersionError(
            f'{path}: schema is {document.get("schema")!r}; "tomopose/{name}/{version}" is needed', path=path
        )
    if int(found["version"]) > version:
        raise SchemaVersionError(
            f"{path}: schema version {found['version']} is newer than {version}, the newest that this tomopose reads; "
            "update tomopose",
            path=path,
        )
    return document
