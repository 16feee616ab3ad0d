"""Intermediate results that survive an interruption: one small JSON file a step, whole or absent.

A step belongs to the code that made it: its key holds a digest of the module that computes it and of all modules of
this package which that one imports.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tomopose.errors import FileError
from tomopose.files import plain, read_json, write_json
from tomopose.kept import Key, key_of, same_key

SCHEMA_NAME = "study-step"
PACKAGE = Path(__file__).resolve().parents[2]


def module_file(name: str) -> Path | None:
    """The source file of a module of this package, by its dotted name; None for any other."""
    first, *parts = name.split(".")
    place = PACKAGE.joinpath(*parts)
    if first != PACKAGE.name:
        return None
    return next((p for p in (place.with_suffix(".py"), place / "__init__.py") if p.is_file()), None)


@functools.cache
def sources(module: str) -> str:
    """SHA-256 over a module of this package and all of its modules that it imports, directly or not; empty for any
    other module."""
    found: dict[str, bytes] = {}
    left = [module]
    while left:
        name = left.pop()
        path = module_file(name)
        if name in found or path is None:
            continue
        found[name] = path.read_bytes()
        imports = rf"from ({PACKAGE.name}[\w.]*) import ([^(\n]+|\([^)]*\))"
        for package, names in re.findall(imports, found[name].decode()):
            left += [package, *(f"{package}.{n}" for n in re.findall(r"\w+", names))]
    return hashlib.sha256(b"".join(found[n] for n in sorted(found))).hexdigest() if found else ""


@dataclass(frozen=True, kw_only=True)
class Steps:
    """folder: where steps are kept, or None to keep none.  key: what a kept step must have been made with (study,
    scale, seed ...); a step of another key is made again, and StartsAnewWarning says so."""

    folder: Path | None = None
    key: Mapping[str, object] = field(default_factory=dict)

    def of(self, name: str, compute: Callable[[], Mapping[str, object]], **settings: object) -> dict[str, Any]:
        """The content of a step: kept from an earlier run with the same key and code, or computed (and kept) now.

        settings: what this step depends on beside the key of all steps, arrays and values whole.

        The content is plain JSON, also where nothing is kept, so that a resumed run gives the same numbers.
        """
        key = key_of("study-step", sources=sources(compute.__module__), **self.key, **settings)
        path = None if self.folder is None else self.folder / f"{name}.json"
        if path is not None and path.exists():
            try:
                kept = read_json(path, SCHEMA_NAME)
            except FileError:
                kept = {}  # half of a file of another making: it is made again
            belongs = same_key(Key.from_json(kept.get("key")), key, what=f"the kept step {path}")
            if belongs and isinstance(kept.get("content"), dict):
                return dict(kept["content"])
        content = plain(compute())
        if path is not None:
            write_json(path, SCHEMA_NAME, {"key": key.to_json(), "content": content})
        return dict(json.loads(json.dumps(content)))
