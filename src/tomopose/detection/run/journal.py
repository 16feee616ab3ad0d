"""An append-only journal of finished images, so that an interrupted run goes on where it stopped.

One JSON line an image, keyed by its name, the content of a sample of its rows and the call's settings: an image or a
setting that changed is measured again.  A last line cut short by a crash is ignored.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError

SAMPLED_ROWS = 64


def fingerprint(image: Any, settings: str) -> str:
    """Hash of the settings, the image's shape and type, and of about 64 of its rows, evenly spread."""
    digest = hashlib.blake2b(settings.encode(), digest_size=16)
    rows = int(image.shape[0])
    step = max(1, rows // SAMPLED_ROWS)
    for v in range(0, rows, step):
        line = image.region(v, v + 1, 0, image.shape[1]) if hasattr(image, "region") else image[v]
        digest.update(str(np.asarray(line).dtype).encode() + np.ascontiguousarray(line).tobytes())
    digest.update(repr(tuple(image.shape)).encode())
    return digest.hexdigest()


def read_journal(path: Path | None) -> dict[str, dict[str, Any]]:
    """Finished rows by image name; empty where there is no journal."""
    if path is None or not path.exists():
        return {}
    done = {}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}", path=path) from error
    for line in lines:
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        done[str(row["name"])] = row
    return done


def append(path: Path, row: dict[str, Any]) -> None:
    """Adds one finished image and flushes it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a", encoding="utf-8", newline="\n") as stream:
            stream.write(json.dumps(row) + "\n")
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}", path=path) from error
