"""Scanner parameters by name: which are freed, with which prior, and where each acts in the scanner vector."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS
from tomopose.errors import InputError
from tomopose.geometry.scanner import LARGEST_TILT, PARAMETER_UNITS, Scanner
from tomopose.units import Array

UNITS: Mapping[str, str] = MappingProxyType({**PARAMETER_UNITS, "pitch_ratio": "", "translation_scale": ""})
"""Every name that may be freed.  pitch_ratio is p_u / p_v at constant p_v."""

PER_RUN = ("d_SR", "axis_y")
"""Where several runs are solved together these belong to one run each (the table was moved); the others are shared."""

MATTERS: Mapping[str, float] = MappingProxyType(
    {
        "d_SD": 1.5,
        "d_SR": 0.3,
        "p_u": 2e-4,
        "p_v": 2e-4,
        "u_0": 1.0,
        "v_0": 1.0,
        "eta": 1e-3,
        "theta": 5e-3,
        "phi": 5e-3,
        "pitch_ratio": 1e-3,
        "axis_y": 0.05,
        "axis_tilt_x": 1e-3,
        "axis_tilt_y": 1e-3,
        "translation_scale": 1e-3,
    }
)
"""An error of this size spoils a scan; data that leave a parameter more uncertain than this do not determine it."""


@dataclass(frozen=True, kw_only=True)
class FreeParameters:
    """The freed parameters, in order.

    names: as in `Calibration.tangent` (NAME, or NAME[RUN] where it belongs to one of several runs).
    value: (f,) nominal;  sigma: (f,) prior standard deviation, inf where there is no limit.
    cols, col_run, factor: where each acts, see `kernel`.
    """

    names: tuple[str, ...]
    value: Array
    sigma: Array
    cols: Any
    col_run: Any
    factor: Array

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def information(self) -> Array:
        """(f,) 1 / sigma^2."""
        return np.where(np.isfinite(self.sigma), 1.0 / np.asarray(self.sigma) ** 2, 0.0)


def base_name(name: str) -> str:
    """The parameter's name without its run."""
    return name.split("[", maxsplit=1)[0]


def unit_of(name: str) -> str:
    return UNITS[base_name(name)]


def nominal(scanner: Scanner, name: str) -> float:
    """A parameter's value before the calibration."""
    if name == "pitch_ratio":
        return scanner.p_u / scanner.p_v
    return 1.0 if name == "translation_scale" else float(getattr(scanner, name))


def _known(names: Iterable[str], word: str) -> None:
    for name in names:
        if name not in UNITS:
            raise InputError(f"{word} names {name!r}; known are {', '.join(UNITS)}")


def free_parameters(
    scanners: tuple[Scanner, ...],
    *,
    free: Iterable[str] = (),
    fix: Iterable[str] = (),
    priors: Mapping[str, float] | None = None,
) -> FreeParameters:
    """Decide what is freed.

    A parameter with a prior standard deviation (in scanner.sigma or `priors`, which wins) is freed with that prior,
    since its uncertainty is part of the result's; one in `free` is freed, with its prior where it has one; one in
    `fix`, or with the standard deviation 0 (exact) and not in `free`, is held.  Units: mm, px, rad; pitch_ratio and
    translation_scale are pure numbers.  Defaults for values that nobody stated are not added here; see `assumed`.
    """
    if isinstance(free, str) or isinstance(fix, str):
        raise InputError("free and fix are sequences of names, such as free=('d_SR', 'u_0'); a single text was given")
    free, fix = tuple(free), tuple(fix)
    sigma = {**scanners[0].sigma, **dict(priors or {})}
    _known(free, "free")
    _known(fix, "fix")
    _known(sigma, "priors")
    for name, s in sigma.items():
        if not (math.isfinite(s) and s >= 0):
            raise InputError(
                f"the prior standard deviation of {name} is {s}; a positive number is needed, or 0 for an exact value"
            )
    both = [n for n in free if n in fix]
    if both:
        raise InputError(f"{both[0]} is named in free and in fix")
    sigma = {name: s for name, s in sigma.items() if s > 0}
    chosen = [n for n in UNITS if n not in fix and (n in free or n in sigma)]
    if "pitch_ratio" in chosen and "p_u" in chosen:
        raise InputError("pitch_ratio and p_u both change p_u; free one of them")
    names: list[str] = []
    rows: list[tuple[float, float, int, int, float]] = []
    for name in chosen:
        split = len(scanners) > 1 and name in PER_RUN
        for r in range(len(scanners)) if split else (-1,):
            scanner = scanners[max(r, 0)]
            column = SCANNER_COLUMNS.index("p_u" if name == "pitch_ratio" else name)
            names.append(f"{name}[{r}]" if split else name)
            factor = scanner.p_v if name == "pitch_ratio" else 1.0
            rows.append((nominal(scanner, name), sigma.get(name, math.inf), column, r, factor))
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return FreeParameters(
        names=tuple(names),
        value=table[:, 0].copy(),
        sigma=table[:, 1].copy(),
        cols=table[:, 2].astype(np.int64),
        col_run=table[:, 3].astype(np.int64),
        factor=table[:, 4].copy(),
    )


class ImpossibleScannerError(InputError):
    """A fit moved freed scanner values to where no scanner is: they cannot explain the data."""


def scanner_vectors_at(s_0: Array, free: FreeParameters, delta: Array) -> Array:
    """(a, runs, 13): the scanner vectors s_0 (runs, 13) with each of the deviations delta (a, f) applied."""
    s = np.repeat(s_0[None], len(delta), axis=0)
    for r in range(len(s_0)):
        mine = (free.col_run < 0) | (free.col_run == r)
        s[:, r, free.cols[mine]] += (free.factor * delta)[:, mine]
    return s


def scanners_can_be(s: Array) -> npt.NDArray[np.bool_]:
    """(a,): whether scanner vectors s (a, runs, 13) are ones that a `Scanner` accepts."""
    of = dict(zip(SCANNER_COLUMNS, np.moveaxis(s, -1, 0), strict=True))
    can_be = (
        np.isfinite(s).all(axis=-1) & (of["d_SR"] > 0) & (of["d_SD"] > of["d_SR"]) & (of["p_u"] > 0) & (of["p_v"] > 0)
    )
    for name in ("theta", "phi", "axis_tilt_x", "axis_tilt_y"):
        can_be &= abs(of[name]) <= LARGEST_TILT
    return np.asarray(can_be.all(axis=1))


def adjusted_scanners(scanners: tuple[Scanner, ...], free: FreeParameters, delta: Array) -> tuple[Scanner, ...]:
    """The scanners with the deviations delta (f,) applied.  translation_scale is not part of a scanner."""
    result = []
    for r, scanner in enumerate(scanners):
        change: dict[str, Any] = {}
        for column, run, off in zip(
            free.cols.tolist(), free.col_run.tolist(), (free.factor * delta).tolist(), strict=True
        ):
            name = SCANNER_COLUMNS[column]
            if run in (-1, r) and name != "translation_scale":
                change[name] = change.get(name, getattr(scanner, name)) + off
        try:
            result.append(replace(scanner, **change) if change else scanner)
        except InputError as error:
            raise ImpossibleScannerError(f"the fit ended at a scanner that cannot be: {error}") from error
    return tuple(result)


def translation_scale(free: FreeParameters, delta: Array) -> float:
    """The estimated scale of the manipulator's translations, 1 where it was held."""
    return 1.0 + sum(float(d) for n, d in zip(free.names, delta, strict=True) if n == "translation_scale")
