"""Intermediate results that survive an interruption: one small JSON file a step, whole or absent."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tomopose.errors import FileError
from tomopose.files import plain, read_json, write_json
from tomopose.provenance import package_version

SCHEMA_NAME = "study-step"


@dataclass(frozen=True, kw_only=True)
class Steps:
    """folder: where steps are kept, or None to keep none.  key: what a kept step must have been made with (study,
    scale, seed ...); a step of another key is made again."""

    folder: Path | None = None
    key: Mapping[str, Any] = field(default_factory=dict)

    def of(self, name: str, compute: Callable[[], Mapping[str, Any]], **key: Any) -> dict[str, Any]:
        """The content of a step: kept from an earlier run with the same key, or computed (and kept) now.

        The content is plain JSON, also where nothing is kept, so that a resumed run gives the same numbers.
        """
        wanted = json.loads(json.dumps(plain({"version": package_version(), **self.key, **key})))
        path = None if self.folder is None else self.folder / f"{name}.json"
        if path is not None and path.exists():
            try:
                kept = read_json(path, SCHEMA_NAME)
            except FileError:
                kept = {}  # half of a file of another making: it is made again
            if kept.get("key") == wanted and isinstance(kept.get("content"), dict):
                return dict(kept["content"])
        content = plain(compute())
        if path is not None:
            write_json(path, SCHEMA_NAME, {"key": wanted, "content": content})
        return dict(json.loads(json.dumps(content)))
