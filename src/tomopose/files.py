"""Files that are either whole or absent: atomic writes, and JSON with a schema.

Everything is written to a temporary file in the same folder, flushed to disk and renamed (see `atomic`), so that
neither a full disk nor Ctrl-C leaves half a file.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import warnings
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
    "EditedWarning",
    "atomic_file",
    "atomic_folder",
    "plain",
    "read_json",
    "require_absent",
    "sync_folder",
    "warn_edited",
    "warn_if_edited",
    "was_edited",
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


def plain(value: object) -> Any:
    """A value as JSON knows it: arrays become lists, numbers that are not finite become null."""
    kind = type(value)
    if value is None or kind in (str, int, bool):  # most of a document
        return value
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


def write_json(path: str | Path, name: str, content: Mapping[str, object], *, version: int = 1) -> None:
    """JSON of schema `tomopose/NAME/VERSION`, atomically, floats with all their digits."""
    document = {"schema": f"tomopose/{name}/{version}", **plain(content)}
    if name in SEALED:
        document[DIGEST] = _digest(document)
    write_text(path, json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


SEALED = frozenset(
    {"calibration", "truth", "measurement", "exports", "study", "refined", "scan-plan", "comparison", "resolution"}
)
"""Results: files that nobody writes by hand.  Each holds the SHA-256 of its own content."""
DIGEST = "content_sha256"


class EditedWarning(UserWarning):
    """A result was changed after it was written."""


def _digest(document: Mapping[str, Any]) -> str:
    """SHA-256 over a JSON object's content, whatever its layout and order, except for the digest itself and the time at
    which it was written: the same input gives the same digest."""
    content = {key: value for key, value in document.items() if key != DIGEST}
    if isinstance(content.get("provenance"), dict):
        content["provenance"] = {k: v for k, v in content["provenance"].items() if k != "time_utc"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def was_edited(document: Mapping[str, object]) -> bool:
    """Whether a result's content is another than it was written with; False where it holds no digest (schema 1)."""
    return DIGEST in document and document[DIGEST] != _digest(document)


def warn_if_edited(document: Mapping[str, object], path: str | Path) -> None:
    """EditedWarning, by name, where a result was changed after it was written."""
    if was_edited(document):
        warn_edited(path)


def warn_edited(path: str | Path) -> None:
    """EditedWarning for this file."""
    warnings.warn(
        f"{path} was edited after it was written: its content has another SHA-256 than it says. Its numbers may "
        "not belong together; make it again from its inputs",
        EditedWarning,
        stacklevel=3,
    )


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
