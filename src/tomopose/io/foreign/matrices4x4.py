"""Homogeneous matrices 4 x 4 (tool or plate in its base): text in blocks or one matrix a row, .npy, .npz, .json.

The last row 0 0 0 1 distinguishes rows from columns; lists that store columns first (as Franka's O_T_EE) have the
translation in their last row and are recognised by it.  The unit of the translation is never guessed.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from tomopose.errors import InputError, TomoposeError, UnitError
from tomopose.geometry.rotations import convention_from_rotation
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.number_words import NUM, UNIT_FACTORS
from tomopose.io.foreign.pose_log import PoseLog, PoseOptions
from tomopose.reading import parse_json
from tomopose.reading.arrays import read_npy
from tomopose.units import Array

CONVENTION = "quaternion-wxyz"
"""How the rotations are written: no angle order, no singularity."""
ORTHONORMAL = 1e-3
"""Largest error of R R^T - I that still is rounding of a few printed digits."""
UNITS = re.compile(r"#\s*units?\s*[:=]\s*(?P<unit>\S+)", re.IGNORECASE)


def recognise(file: ForeignFile) -> bool:
    """Arrays of 4 x 4 matrices, or text in which every fourth row is 0 0 0 1."""
    if file.head[:6] == b"\x93NUMPY":
        return _loaded(file).shape[-2:] == (4, 4)
    if not file.is_text:
        return False
    if file.suffix == ".json" or file.text.lstrip()[:1] in ("[", "{"):
        return _json_matrices(file) is not None
    try:
        return _text_matrices(file) is not None
    except InputError:
        return False


def read(file: ForeignFile, options: PoseOptions) -> PoseLog:
    """The poses of matrices."""
    if file.head[:6] == b"\x93NUMPY":
        found: Array | None = _loaded(file).reshape(-1, 4, 4).astype(np.float64)
    elif file.suffix == ".json" or file.text.lstrip()[:1] in ("[", "{"):
        found = _json_matrices(file)
    else:
        found = _text_matrices(file)
    if found is None:
        raise InputError(f"{file.path} holds no 4 x 4 matrices with a last row 0 0 0 1")
    T, notes = _rows_first(found, file)
    said = UNITS.search(file.text)
    unit = options.units or (said["unit"].strip(",;").lower() if said else _json_unit(file))
    if unit is None:
        raise UnitError(
            f"{file.path}: the unit of the translations is not stated; add --units mm (or m), or a line '# units: mm'"
        )
    if unit not in UNIT_FACTORS:
        raise UnitError(f"{file.path}: unit {unit!r} is not known; known are {', '.join(UNIT_FACTORS)}")
    R = T[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero(~(off < ORTHONORMAL) | ~(np.linalg.det(R) > 0))
    if bad.size:
        raise InputError(
            f"{file.path}: matrix {bad[0]} is not a rotation (R R^T differs from 1 by {off[bad[0]]:.3g}, det "
            f"{np.linalg.det(R)[bad[0]]:.3g})"
        )
    q = convention_from_rotation(R, CONVENTION)
    factor = float(UNIT_FACTORS[unit])
    rows = tuple(
        (*(repr(float(v) * factor) for v in t), *map(repr, r)) for t, r in zip(T[:, :3, 3], q.tolist(), strict=True)
    )
    notes.append(f"translations in {unit}; rotations are written as quaternions w, x, y, z")
    return PoseLog(path=file.path, convention=CONVENTION, rows=rows, notes=tuple(notes))


def _json_unit(file: ForeignFile) -> str | None:
    """What a JSON object says under "units" or "unit"."""
    if not file.text.lstrip().startswith("{"):
        return None
    content: Any = parse_json(file.text, file.path)
    said = content.get("units", content.get("unit"))
    return said.strip().lower() if isinstance(said, str) else None


def _rows_first(T: Array, file: ForeignFile) -> tuple[Array, list[str]]:
    """The matrices with the translation in the last column."""
    if not np.isfinite(T).all():
        raise InputError(f"{file.path}: a matrix holds values that are not finite")
    last = np.array([0.0, 0.0, 0.0, 1.0])
    if np.abs(T[:, 3] - last).max() < 1e-9:
        return T, []
    if np.abs(T[:, :, 3] - last).max() < 1e-9:
        return np.swapaxes(T, 1, 2), ["the matrices are stored column by column and were transposed"]
    bad = int(np.flatnonzero(np.abs(T[:, 3] - last).max(axis=1) >= 1e-9)[0])
    raise InputError(f"{file.path}: the last row of matrix {bad} is {T[bad, 3].tolist()}, not 0 0 0 1")


def _loaded(file: ForeignFile) -> Array:
    return np.asarray(read_npy(file.path, "list of matrices"))


def _text_matrices(file: ForeignFile) -> Array | None:
    """(n, 4, 4) of text: four rows of four numbers, or rows of sixteen (or twelve); None where it is something else."""
    rows: list[list[float]] = []
    order: list[int] | None = None
    for number, line in enumerate(file.lines, start=1):
        line = line.split("#", 1)[0].strip().strip("[],;")
        if not line:
            continue
        words = re.split(r"[\s,;]+", line.replace("[", " ").replace("]", " ").strip())
        if not all(re.fullmatch(NUM, w) for w in words):
            if not rows and order is None and (order := _named_elements(words)) is not None:
                continue
            if rows:
                raise InputError(f"{file.path}: line {number} is {line[:40]!r}, between rows of numbers")
            return None
        rows.append([float(w) for w in words])
    widths = {len(r) for r in rows}
    if order is not None:
        if widths and min(widths) <= max(order):
            raise InputError(f"{file.path}: a row has {min(widths)} numbers, fewer than the header has columns")
        top = np.array([[r[k] for k in order] for r in rows]).reshape(-1, 3, 4)
        return np.concatenate([top, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(top), 1, 1))], axis=1) if len(top) else None
    if widths == {16}:
        return np.array(rows).reshape(-1, 4, 4)
    if widths != {4} or len(rows) % 4:
        return None
    T = np.array(rows).reshape(-1, 4, 4)
    return T if _is_homogeneous(T) else None


def _named_elements(names: list[str]) -> list[int] | None:
    """Where the twelve elements of [R | t] are, row by row, under a header such as r11, r12, r13, tx; else None."""
    at = {name.strip("\"'").lower(): k for k, name in enumerate(names)}
    for letter in "rmt":
        for base in (1, 0):
            moved = [
                (f"{letter}{i + base}{3 + base}", f"t{a}", f"p{a}", a, f"t{i + base}") for i, a in enumerate("xyz")
            ]
            wanted = [[(f"{letter}{i + base}{j + base}",) for j in range(3)] + [moved[i]] for i in range(3)]
            found = [next((at[n] for n in of if n in at), None) for row in wanted for of in row]
            if None not in found:
                return [k for k in found if k is not None]
    return None


def _is_homogeneous(T: Array) -> bool:
    last = np.array([0.0, 0.0, 0.0, 1.0])
    return bool(np.abs(T[:, 3] - last).max() < 1e-9 or np.abs(T[:, :, 3] - last).max() < 1e-9)


def _json_matrices(file: ForeignFile) -> Array | None:
    """(n, 4, 4) of a JSON list, or of the one list of matrices in a JSON object; None otherwise."""
    try:
        content: Any = parse_json(file.text, file.path)
    except TomoposeError:
        return None
    candidates = list(content.values()) if isinstance(content, dict) else [content]
    found = [T for c in candidates if (T := _as_matrices(c)) is not None]
    return found[0] if len(found) == 1 else None


def _as_matrices(value: object) -> Array | None:
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if T.ndim == 2 and T.shape[1] == 16:
        T = T.reshape(-1, 4, 4)
    return T if T.ndim == 3 and T.shape[1:] == (4, 4) and len(T) and _is_homogeneous(T) else None


KIND = Kind(
    name="matrix4",
    maker="any maker",
    what="a list of homogeneous 4 x 4 matrices",
    recognise=recognise,
    read_poses=read,
)
