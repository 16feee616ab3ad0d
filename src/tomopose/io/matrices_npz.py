"""matrices.npz: projection matrices of a scan.  No pickled objects, so that any program and any version can read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.files import SCHEMA, atomic_file, require_absent
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.io.scanner_json import scanner_document, scanner_from_document
from tomopose.io.table_text import unknown_column
from tomopose.provenance import Provenance
from tomopose.reading import parse_json, reader
from tomopose.reading.arrays import read_npz

REQUIRED = ("P", "n_u", "n_v", "p_u", "p_v", "pose_id")
SIGMA = {"P_points_sigma_px": "points_sigma", "P_points_sigma_shared_px": "points_sigma_shared"}
KNOWN = ("schema", *REQUIRED, *SIGMA, "in_front_mm", "scanner", "provenance")


def write_matrices(
    path: str | Path, P: ProjectionMatrices, *, provenance: Provenance | None = None, force: bool = False
) -> None:
    """Write matrices.npz.  FileError if the file exists and `force` is not given."""
    path = require_absent(path, force=force)
    content: dict[str, Any] = {
        "schema": "tomopose/matrices/1",
        "P": P.P,
        "n_u": np.int64(P.n_u),
        "n_v": np.int64(P.n_v),
        "p_u": np.float64(P.p_u),
        "p_v": np.float64(P.p_v),
        "pose_id": np.array(P.pose_id, dtype=np.str_),
    }
    content |= {key: getattr(P, name) for key, name in SIGMA.items() if getattr(P, name) is not None}
    if np.any(P.in_front):
        content["in_front_mm"] = P.in_front
    if P.scanner is not None:
        content["scanner"] = json.dumps({"schema": "tomopose/scanner/1", **scanner_document(P.scanner)})
    if provenance is not None:
        content["provenance"] = json.dumps(provenance.to_json())
    with atomic_file(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **content)


@reader("matrices.npz")
def read_matrices(path: str | Path) -> ProjectionMatrices:
    """Read matrices.npz.

    Raises FileError where it cannot be read, SchemaVersionError, InputError by key where a part is missing, unknown or
    does not fit.
    """
    path = Path(path)
    content = _load(path)
    found = SCHEMA.fullmatch(str(content.get("schema", "")))
    if not found or found["name"] != "matrices" or int(found["version"]) > 1:
        raise SchemaVersionError(
            f'{path}: schema is {str(content.get("schema"))!r}; this tomopose reads "tomopose/matrices/1"', path=path
        )
    for key in content:
        if key not in KNOWN:
            raise InputError(f"{path}: unknown key {key!r}{unknown_column(key, KNOWN)}")
    missing = [key for key in REQUIRED if key not in content]
    if missing:
        raise InputError(f"{path}: {', '.join(missing)} missing")
    try:
        scanner = None
        if "scanner" in content:
            scanner = scanner_from_document(parse_json(str(content["scanner"]), f"{path}: scanner"), "scanner")
        return ProjectionMatrices(
            P=content["P"],
            n_u=int(content["n_u"]),
            n_v=int(content["n_v"]),
            p_u=float(content["p_u"]),
            p_v=float(content["p_v"]),
            pose_id=tuple(content["pose_id"].tolist()),
            scanner=scanner,
            in_front=content.get("in_front_mm", np.zeros(3)),
            **{name: content.get(key) for key, name in SIGMA.items()},
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise FileError(f"{path} is damaged: {error}", path=path) from error


@reader("matrices.npz")
def read_matrices_provenance(path: str | Path) -> Provenance | None:
    """The provenance that stands in matrices.npz, or None."""
    content = _load(Path(path))
    if "provenance" not in content:
        return None
    return Provenance.from_json(parse_json(str(content["provenance"]), f"{path}: provenance"))


def _load(path: Path) -> dict[str, Any]:
    return dict(read_npz(path, "matrices.npz"))
