"""What the formats share: the source and panel behind each matrix, refusals by name, and the values a reader needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import ConventionError, InputError, NotRepresentableError, ShapeError
from tomopose.geometry.projection import ProjectionMatrices, ViewGeometry, compose
from tomopose.units import Array

Rows = Literal["bottom", "top"]
"""Which detector row is row 0 of the arrays that a geometry is made for: r = v, or r = n_v - 1 - v."""

OPTIONS: Mapping[str, str] = {
    "n_u": "--n-u-px",
    "n_v": "--n-v-px",
    "p_u": "--p-u-mm",
    "p_v": "--p-v-mm",
    "rows": "--rows",
}
PITCH_TOLERANCE = 1e-6
"""Largest relative difference of two statements of one pitch: files written in float32 still agree."""


def check_rows(rows: object) -> None:
    """ConventionError unless rows is "bottom" or "top"."""
    if rows not in ("bottom", "top"):
        raise ConventionError(f"rows is {rows!r}; 'bottom' (row 0 is v = 0) or 'top' (row 0 is v = n_v - 1) is needed")


@dataclass(frozen=True, kw_only=True)
class Given:
    """What the caller knows beside the file: detector size (px), pitch (mm), row order, names of the views.

    folder: where the file lies, for other files that it names.
    """

    n_u: int | None = None
    n_v: int | None = None
    p_u: float | None = None
    p_v: float | None = None
    rows: Rows | None = None
    pose_id: tuple[str, ...] | None = None
    folder: Path | None = None

    def __post_init__(self) -> None:
        if self.rows is not None:
            check_rows(self.rows)

    def with_values(self, **values: Any) -> Given:
        """The same with some values settled."""
        return replace(self, **values)

    def settle(self, name: str, found: object, where: str) -> Any:
        """The value of n_u, n_v, p_u, p_v or rows from the file (`found`, or None) and from the caller.

        InputError where the two contradict, or where neither has it: nothing is guessed.
        """
        given = getattr(self, name)
        if found is None and given is None:
            raise InputError(f"{where} does not hold {name}; give {name} ({OPTIONS[name]})")
        if name != "rows":
            for value, source in ((found, f" in {where}"), (given, "")):
                _require_sensible(name, value, source)
        if found is None:
            return given
        if given is not None:
            same = abs(found - given) <= PITCH_TOLERANCE * given if name in ("p_u", "p_v") else found == given
            if not same:
                raise InputError(
                    f"{name} is {found!r} in {where}, but {given!r} was given ({OPTIONS[name]}); leave it out, or "
                    "correct it"
                )
        return found

    def matrices(self, P: Array, *, n_u: int, n_v: int, p_u: float, p_v: float) -> ProjectionMatrices:
        """The result of a reader, with the views' names where they are known, 0 ... n-1 otherwise."""
        names = self.pose_id or tuple(str(k) for k in range(len(P)))
        return ProjectionMatrices(P=P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v, pose_id=names)


def _require_sensible(name: str, value: Any, source: str) -> None:
    """InputError for a size that is no positive whole number and a pitch that is no positive number."""
    if value is None:
        return
    whole = name in ("n_u", "n_v")
    if not (np.isfinite(value) and value > 0) or (whole and value != int(value)):
        needed = "whole number of pixels" if whole else "number of millimetres"
        raise InputError(f"{name} is {value!r}{source}; a positive {needed} is needed")


def panels(matrices: ProjectionMatrices, format: str) -> ViewGeometry:
    """Source and panel of each view, or NotRepresentableError with the views whose matrix no flat panel has."""
    try:
        return matrices.decompose()
    except InputError as error:
        bad = [k for k in range(len(matrices)) if not _has_panel(matrices, k)]
        raise NotRepresentableError(
            f"{format} holds a source and a flat panel of rectangular pixels; {error}", format=format, indices=bad
        ) from error


def _has_panel(matrices: ProjectionMatrices, view: int) -> bool:
    try:
        matrices.select([view]).decompose()
    except InputError:
        return False
    return True


def unmirrored_panels(matrices: ProjectionMatrices, format: str) -> ViewGeometry:
    """As `panels`, for formats that place the panel by a rotation: mirrored views are refused too.

    With u to the right and v up, seen from the source, det P[:, :3] is negative; a positive one is a mirrored image.
    """
    bad = np.flatnonzero(np.linalg.det(matrices.P[:, :, :3]) > 0)
    if bad.size:
        raise NotRepresentableError(
            f"{format} places the panel by a rotation and cannot hold mirrored images; "
            f"det P[:, :3] is positive in {bad.size} of {len(matrices)} views, the first is view {bad[0]}",
            format=format,
            indices=bad.tolist(),
        )
    return panels(matrices, format)


def matrices_of_panels(
    source: ArrayLike, centre: ArrayLike, U: ArrayLike, V: ArrayLike, *, given: Given, rows: Rows, where: str
) -> ProjectionMatrices:
    """Matrices of sources, panel centres and steps (each (n, 3), mm) per column and per array row.

    The pitch is the length of the steps; it must be one pitch for all views and agree with what the caller says.
    """
    arrays = tuple(np.asarray(x, dtype=np.float64) for x in (source, centre, U, V))
    shapes = {a.shape for a in arrays}
    if len(shapes) != 1 or arrays[0].ndim != 2 or arrays[0].shape[1] != 3 or len(arrays[0]) == 0:
        raise ShapeError(f"{where}: source, centre and steps must all be (n, 3); found {sorted(shapes)}")
    bad = np.flatnonzero(~np.isfinite(np.hstack(arrays)).all(axis=1))
    if bad.size:
        raise InputError(f"{where}: view {bad[0]} holds values that are not finite ({bad.size} of {len(arrays[0])})")
    source, centre, U, V = arrays
    n_u, n_v = given.settle("n_u", None, where), given.settle("n_v", None, where)
    p_u = given.settle("p_u", one_pitch(np.linalg.norm(U, axis=1), "column", where), where)
    p_v = given.settle("p_v", one_pitch(np.linalg.norm(V, axis=1), "row", where), where)
    flat = np.abs(np.linalg.det(np.stack([U, V, centre - source], axis=-1))) / (p_u * p_v)
    bad = np.flatnonzero(flat < 1e-9 * np.linalg.norm(centre - source, axis=1))
    if bad.size:
        raise InputError(f"{where}: in view {bad[0]} the source lies in the plane of the panel")
    P = compose(source, centre, U, -V if rows == "top" else V, n_u=n_u, n_v=n_v)
    bad = np.flatnonzero(P[:, 2, 3] <= 0)
    if bad.size:
        raise InputError(f"{where}: in view {bad[0]} the world origin does not lie in front of the source")
    return given.matrices(P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v)


def one_pitch(lengths: Array, what: str, where: str) -> float:
    """The one length that all views share, mm."""
    if not lengths.min() > 0 or lengths.max() / lengths.min() - 1 > PITCH_TOLERANCE:
        raise InputError(
            f"{where}: the {what} steps are {lengths.min():.9g} to {lengths.max():.9g} mm long; "
            "one positive pitch for all views is needed"
        )
    return float(np.median(lengths))


def require_keys(content: Mapping[str, object], keys: Sequence[str], where: str) -> None:
    """InputError names the keys that a file lacks, and those it has instead."""
    missing = [k for k in keys if k not in content]
    if missing:
        raise InputError(f"{where} lacks {', '.join(missing)}; it holds {', '.join(map(str, content)) or 'nothing'}")


def numbers(values: object, shape: tuple[int, ...], where: str) -> Array:
    """A float64 array of that shape (-1: any length) with finite values only; InputError says what was found."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} holds no table of numbers of shape {shape}: {error}") from error
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        raise ShapeError(f"{where} has shape {array.shape}; {tuple('n' if n < 0 else n for n in shape)} is needed")
    if not np.isfinite(array).all():
        raise InputError(f"{where} holds values that are not finite")
    return array
