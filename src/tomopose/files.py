"""Files that are either whole or absent: atomic writes, and JSON with a schema.

Everything is written to a temporary file in the same folder, flushed to disk and renamed (see `atomic`), so that
neither a full disk nor Ctrl-C leaves half a file.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.atomic import atomic_file, atomic_folder, require_absent, sync_folder
from tomopose.errors import FileError, SchemaVersionError
from tomopose.reading.border import as_path, require_file
from tomopose.reading.text import parse_json, read_text

__all__ = [
    "SCHEMA",
    "atomic_file",
    "atomic_folder",
    "plain",
    "read_json",
    "require_absent",
    "sync_folder",
    "write_json",
    "write_text",
]

NUMBER_RUN = re.compile(r"(\d+)")
SCHEMA = re.compile(r"tomopose/(?P<name>[a-z0-9-]+)/(?P<version>\d+)")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that counts: pose_2 before pose_10."""
    return tuple(
        (0, int(part), part) if part.isdigit() else (1, 0, part.lower()) for part in NUMBER_RUN.split(name) if part
    )


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

    Raises FileError where it cannot be read, is no JSON object or holds a key twice, SchemaVersionError where the
    schema is missing, of another kind or newer.
    """
    path = as_path(path, f"{name}.json")
    require_file(path, "JSON file")
    document = parse_json(read_text(path), path)
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
