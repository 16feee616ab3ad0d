"""An append-only journal of finished images, so that an interrupted run continues where it stopped.

The first line holds the run's key: scanner, diameter, mask, settings and the versions that calculate.  Each further
line is one image, with the digest of all its pixels (corrected by flat and dark field, where there are any) and of the
place where the ball was expected: an image that changed is measured again, and under another key the journal begins
anew, which a warning says.
A last line cut short by a crash is ignored.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tomopose.detection.reading import Image
from tomopose.detection.run.checks import Row
from tomopose.errors import FileError
from tomopose.kept import Key, digest_of, same_key


def fingerprint(image: Image, predicted: tuple[float, float] | None, origin: tuple[int, int]) -> str:
    """Digest of an image's pixels, all of them, and of where the ball is expected in it."""
    rows, columns = getattr(image, "shape", None) or np.shape(image)
    whole = image.region(0, rows, 0, columns) if hasattr(image, "region") else image
    pixels: npt.NDArray[np.generic] = np.asarray(whole)
    return digest_of((pixels, predicted, origin))


def open_journal(path: Path, key: Key) -> dict[str, Row]:
    """Finished rows by image name of a journal with that key; otherwise it is begun anew, and none are."""
    rows = _rows(path)
    kept = Key.from_json(rows[0].get("key")) if rows and "name" not in rows[0] else None
    if rows and same_key(kept, key, what=f"the journal {path}"):
        return {str(row["name"]): row for row in rows[1:] if "name" in row}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"key": key.to_json()}) + "\n", encoding="utf-8", newline="\n")
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}", path=path) from error
    return {}


def append(path: Path, row: Row) -> None:
    """Adds one finished image and flushes it."""
    try:
        with open(path, "a", encoding="utf-8", newline="\n") as stream:
            stream.write(json.dumps(row) + "\n")
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}", path=path) from error


def _rows(path: Path) -> list[Row]:
    """The journal's lines that are whole."""
    if not path.exists():
        return []
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}", path=path) from error
    rows = []
    for line in text.splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(row, dict):
            rows.append(row)
    return rows
