"""Results that contradict themselves: what an edited, mixed or damaged file says in two places is compared here.

Each check names the file, what was found and its value.  Nothing is repaired.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array

ASYMMETRY = 1e-6
"""Of a correlation matrix.  Solvers make symmetric matrices to some 1e-12; an edited entry differs by far more."""
LEAST_EIGENVALUE = -1e-3
"""Of a correlation matrix, whose eigenvalues add up to its size: entries rounded to four digits leave up to -2e-4."""
SAME = 1e-6
"""Relative difference of one number that is written twice with all its digits."""
SHORT_DIGITS, ROUNDING = 4, 5e-4
"""A number of at most four significant digits may be the other one rounded."""


def require_unique(names: Iterable[object], what: str, where: str) -> None:
    """InputError for a name or number that occurs twice."""
    twice = [name for name, count in Counter(map(str, names)).items() if count > 1]
    if twice:
        raise InputError(f"{where}: {what} {twice[0]!r} occurs more than once ({len(twice)} repeat)")


def require_whole(value: object, what: str, where: str) -> int:
    """A whole number; InputError for a truth value, text, a fraction, or a number that is not finite."""
    number = value.item() if isinstance(value, (np.generic, np.ndarray)) and np.size(value) == 1 else value
    if isinstance(number, bool) or not isinstance(number, (int, float)) or not math.isfinite(number):
        raise InputError(f"{where}: {what} is {str(number)[:40]}; a whole number is needed")
    if number != int(number):
        raise InputError(f"{where}: {what} is {number:.6g}; a whole number is needed")
    return int(number)


def require_covariance(matrix: Array, names: Sequence[str], where: str) -> None:
    """InputError unless a covariance (m, m) is finite, symmetric and positive semidefinite.

    A direction that the poses do not determine may have an infinite or unknown variance: its row and column are left
    out, both as a whole.
    """
    C = np.asarray(matrix, dtype=np.float64)
    known = np.isfinite(np.diag(C))
    inside = C[np.ix_(known, known)]
    if not np.isfinite(inside).all():
        i, j = np.argwhere(~np.isfinite(inside))[0]
        shown = [names[int(k)] for k in np.flatnonzero(known)[[i, j]]]
        raise InputError(f"{where}: the covariance of {shown[0]} and {shown[1]} is not finite")
    variance = np.diag(inside)
    if (variance < 0).any():
        k = int(np.flatnonzero(known)[np.argmin(variance)])
        raise InputError(f"{where}: the variance of {names[k]} is {C[k, k]:.4g}; a variance is not negative")
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = inside / np.outer(scale, scale)
    if not correlation.size:
        return
    off = np.abs(correlation - correlation.T)
    if off.max() > ASYMMETRY:
        i, j = np.flatnonzero(known)[list(np.unravel_index(int(np.argmax(off)), off.shape))]
        raise InputError(
            f"{where}: the covariance is not symmetric: {names[i]}, {names[j]} is {C[i, j]:.6g}, the other way round "
            f"{C[j, i]:.6g}"
        )
    least = float(np.linalg.eigvalsh((correlation + correlation.T) / 2)[0])
    if least < LEAST_EIGENVALUE:
        raise InputError(f"{where}: the covariance is not positive: an eigenvalue of its correlations is {least:.4g}")


def require_same(one: float, other: float, what: str, where: str, *, floor: float = 0.0) -> None:
    """InputError where one number is written twice with different values.  floor: a difference that rounding makes."""
    if not abs(one - other) <= SAME * max(abs(one), abs(other)) + floor and not _rounded(one, other):
        raise InputError(f"{where}: {what} is {one:.9g} in one place and {other:.9g} in another; the file was edited")


def _rounded(one: float, other: float) -> bool:
    """Whether one number is the other, rounded to four significant digits."""
    digits = len(repr(abs(one)).partition("e")[0].replace(".", "").strip("0"))
    return digits <= SHORT_DIGITS and abs(one - other) <= ROUNDING * max(abs(one), abs(other))


def require_consistent_calibration(document: Mapping[str, object], where: str, *, version: int) -> None:
    """InputError where calibration.json contradicts itself.

    The covariance, and numbers that are written twice, are checked from schema 2 on: older files load as they are.
    """
    ids, balls = _list(document, "ball_ids"), _list(document, "t_mm")
    for number in ids:
        require_whole(number, "a ball id", where)
    require_unique(ids, "the ball id", where)
    if "dof" in document:
        require_whole(document["dof"], "dof", where)
    residuals, covariance = _object(document, "residuals"), _object(document, "covariance")
    require_unique(_list(residuals, "pose_id"), "the pose id", f"{where}: residuals")
    names = [str(n) for n in _list(covariance, "names")]
    require_unique(names, "the direction", f"{where}: covariance")
    matrix = _numbers(covariance.get("matrix"), (len(names), len(names)))
    if matrix is not None and version >= 2:
        require_covariance(matrix, names, where)
    parameters = [p for p in _list(document, "parameters") if isinstance(p, Mapping)]
    require_unique([p.get("name") for p in parameters], "the parameter", where)
    for p in parameters:
        u = p.get("standard_uncertainty")
        if isinstance(u, (int, float)) and u < 0:
            raise InputError(f"{where}: the standard uncertainty of {p.get('name')} is {u:.4g}; it is not negative")
    if version >= 2:
        _require_values_twice(document, parameters, ids, balls, where)


def _require_values_twice(
    document: Mapping[str, object],
    parameters: Sequence[Mapping[str, object]],
    ids: Sequence[object],
    balls: Sequence[object],
    where: str,
) -> None:
    """The parameters against T_HT, the balls and the scanner; sums against what they sum."""
    T_HT, scanner = _object(document, "T_HT"), _object(document, "scanner")
    places: dict[str, object] = {}
    for block, key in (("t_HT", "t_mm"), ("phi_HT", "angles_rad")):
        values = _list(T_HT, key)
        places |= {f"{block}_{axis}": value for axis, value in zip("xyz", values, strict=False)}
    for number, ball in zip(ids, balls, strict=False):
        values = ball if isinstance(ball, list) else []
        stem = "t" if len(ids) == 1 else f"t[{number}]"
        places |= {f"{stem}_{axis}": value for axis, value in zip("xyz", values, strict=False)}
    if not document.get("runs"):  # several runs have a scanner each
        places |= {key.rpartition("_")[0]: value for key, value in scanner.items()}
    for p in parameters:
        name, value = str(p.get("name")), p.get("value")
        other = places.get(name)
        if isinstance(value, (int, float)) and isinstance(other, (int, float)):
            require_same(float(value), float(other), name, where, floor=1e-12)
        u, expanded = p.get("standard_uncertainty"), p.get("expanded_uncertainty_k2")
        if isinstance(u, (int, float)) and isinstance(expanded, (int, float)):
            require_same(2 * float(u), float(expanded), f"the expanded uncertainty of {name}", where)
    chi2, dof, share = (document.get(k) for k in ("chi2", "dof", "chi2_dof"))
    if isinstance(chi2, (int, float)) and isinstance(dof, int) and isinstance(share, (int, float)) and dof > 0:
        require_same(chi2 / dof, float(share), "chi2_dof", where)
    columns = [
        _numbers(_object(document, "residuals").get(k), (-1,)) for k in ("residual_u_px", "residual_v_px", "d_px")
    ]
    u_px, v_px, d_px = columns
    if u_px is not None and v_px is not None and d_px is not None and u_px.shape == v_px.shape == d_px.shape:
        off = np.abs(np.hypot(u_px, v_px) - d_px)
        if off.size and float(np.nanmax(off, initial=0.0)) > SAME * float(np.nanmax(d_px, initial=1.0)):
            k = int(np.nanargmax(off))
            raise InputError(
                f"{where}: residual {k} is {np.hypot(u_px[k], v_px[k]):.6g} px long, d_px says {d_px[k]:.6g}"
            )


def _object(document: Mapping[str, object], key: str) -> Mapping[str, object]:
    value = document.get(key)
    return value if isinstance(value, Mapping) else {}


def _list(document: Mapping[str, object], key: str) -> Sequence[object]:
    value = document.get(key)
    return value if isinstance(value, list) else []


def _numbers(value: object, shape: tuple[int, ...]) -> Array | None:
    """Numbers of that shape; None where they have another, which the reader itself names."""
    special = {None: math.nan, "inf": math.inf, "-inf": -math.inf}

    def plain(v: object) -> object:
        if isinstance(v, list):
            return [plain(w) for w in v]
        return special[v] if v is None or (isinstance(v, str) and v in special) else v

    try:
        found = np.array(plain(value), dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if found.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, found.shape, strict=True)):
        return None
    return found


def require_one_handedness(P: Array, names: Sequence[str], where: str) -> None:
    """InputError where some views of (n, 3, 4) matrices are mirrored and others are not: no scanner does that."""
    sign = np.sign(np.linalg.det(np.asarray(P)[:, :, :3]))
    usual = 1.0 if (sign > 0).sum() > (sign < 0).sum() else -1.0
    odd = np.flatnonzero(sign != usual)
    if odd.size and len(sign) > 1:
        what = "mirrored" if sign[odd[0]] else "flat (its matrix has no inverse)"
        raise InputError(f"{where}: view {names[odd[0]]} is {what}, unlike {len(sign) - odd.size} others")
