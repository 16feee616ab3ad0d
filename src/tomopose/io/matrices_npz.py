"""matrices.npz: projection matrices of a scan.  No pickled objects, so that any program and any version can read it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.files import DIGEST, SCHEMA, atomic_file, require_absent, warn_edited
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.io.scanner_json import scanner_document, scanner_from_document
from tomopose.io.table_text import unknown_column
from tomopose.provenance import Provenance
from tomopose.reading import parse_json, reader
from tomopose.reading.arrays import read_npz
from tomopose.reading.contradictions import require_one_handedness, require_same, require_unique, require_whole
from tomopose.values import require_types

REQUIRED = ("P", "n_u", "n_v", "p_u", "p_v", "pose_id")
SIGMA = {"P_points_sigma_px": "points_sigma", "P_points_sigma_shared_px": "points_sigma_shared"}
KNOWN = ("schema", *REQUIRED, *SIGMA, "in_front_mm", "scanner", "provenance", DIGEST)


@require_types
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
    content[DIGEST] = _digest({key: np.asarray(value) for key, value in content.items()})
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
    # The names of the arrays are the format; scripts write them without a schema.
    found = SCHEMA.fullmatch(str(content.get("schema", "tomopose/matrices/1")))
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
    _require_consistent(content, str(path))
    try:
        scanner = None
        if "scanner" in content:
            scanner = scanner_from_document(parse_json(str(content["scanner"]), f"{path}: scanner"), "scanner")
        matrices = ProjectionMatrices(
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
        _require_scanner_of(matrices, str(path))
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise FileError(f"{path} is damaged: {error}", path=path) from error
    digest = content.get(DIGEST)
    if digest is not None and str(digest) != _digest(content):
        warn_edited(path)
    return matrices


@reader("matrices.npz")
def read_matrices_provenance(path: str | Path) -> Provenance | None:
    """The provenance in matrices.npz, or None."""
    content = _load(Path(path))
    if "provenance" not in content:
        return None
    return Provenance.from_json(parse_json(str(content["provenance"]), f"{path}: provenance"))


def _digest(content: Mapping[str, Any]) -> str:
    """SHA-256 over the names, types, shapes and bytes of all arrays but the digest's own."""
    whole = hashlib.sha256()
    for key in sorted(set(content) - {DIGEST}):
        array = np.ascontiguousarray(content[key])
        whole.update(f"{key} {array.dtype.str} {np.shape(content[key])}\n".encode() + array.tobytes())
    return whole.hexdigest()


def _require_consistent(content: Mapping[str, Any], where: str) -> None:
    """InputError where the arrays contradict each other: sizes, names, uncertainties, mirrored single views."""
    for key in ("n_u", "n_v"):
        require_whole(content[key], key, where)
    if content["pose_id"].ndim != 1:
        raise InputError(f"{where}: pose_id has shape {content['pose_id'].shape}; one name for each view is needed")
    names = [str(name) for name in content["pose_id"].tolist()]
    require_unique(names, "the pose id", where)
    P = content["P"]
    if P.ndim == 3 and P.shape[1:] == (3, 4) and P.dtype.kind == "f" and np.isfinite(P).all() and len(P) == len(names):
        require_one_handedness(P, names, where)
    for key in SIGMA:
        if key in content and not (np.isfinite(content[key]).all() and (content[key] >= 0).all()):
            raise InputError(f"{where}: {key} holds values that are negative or not finite")


def _require_scanner_of(matrices: ProjectionMatrices, where: str) -> None:
    """InputError where the scanner in the file has another panel than the matrices beside it."""
    scanner = matrices.scanner
    if scanner is None:
        return
    for name in ("n_u", "n_v", "p_u", "p_v"):
        require_same(float(getattr(scanner, name)), float(getattr(matrices, name)), f"{name} of the scanner", where)


def _load(path: Path) -> dict[str, Any]:
    return dict(read_npz(path, "matrices.npz"))
