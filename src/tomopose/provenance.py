"""Provenance: what made a result.  A block of it is in every file that tomopose writes."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import platform
from collections.abc import Iterable, Mapping
from dataclasses import field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tomopose.values import value

MEASUREMENT = "measurement"
"""The argument that holds what a project file says for its reports: machine, operator, certificates."""
DEPENDENCIES = ("numpy", "scipy", "numba", "tifffile", "h5py")


@value
class Provenance:
    """Who made a result, from what, when.

    version: of tomopose; dependencies: name -> version; inputs: file name -> SHA-256;
    arguments: of the call; seed: of the random numbers, where any were drawn; time_utc: ISO 8601.
    """

    version: str
    dependencies: Mapping[str, str]
    inputs: Mapping[str, str] = field(default_factory=dict)
    arguments: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    time_utc: str = ""
    platform: str = ""

    def to_json(self) -> dict[str, Any]:
        return {
            "software": "tomopose",
            "version": self.version,
            "dependencies": dict(self.dependencies),
            "inputs": dict(self.inputs),
            "arguments": dict(self.arguments),
            "seed": self.seed,
            "time_utc": self.time_utc,
            "platform": self.platform,
        }

    @classmethod
    def from_json(cls, block: Mapping[str, Any]) -> Provenance:
        return cls(
            version=str(block.get("version", "")),
            dependencies=dict(block.get("dependencies", {})),
            inputs=dict(block.get("inputs", {})),
            arguments=dict(block.get("arguments", {})),
            seed=block.get("seed"),
            time_utc=str(block.get("time_utc", "")),
            platform=str(block.get("platform", "")),
        )


@functools.cache
def package_version(name: str = "tomopose") -> str:
    """Installed version of a package, or "not installed"."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def sha256(path: str | Path) -> str:
    """SHA-256 of a file, read in pieces."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def provenance(
    *, inputs: Iterable[str | Path] = (), arguments: Mapping[str, object] | None = None, seed: int | None = None
) -> Provenance:
    """The provenance of a result made now.  Inputs are named without their folders."""
    return Provenance(
        version=package_version(),
        dependencies={name: package_version(name) for name in DEPENDENCIES},
        inputs={Path(p).name: sha256(p) for p in inputs},
        arguments=dict(arguments or {}),
        seed=seed,
        time_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        platform=f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    )
