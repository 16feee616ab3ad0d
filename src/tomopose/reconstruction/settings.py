"""What a reconstruction is asked for, as values: the algorithm, and how it is executed.

reconstruct(images, matrices, grid, algorithm=SART(iterations=2), execution=Execution(memory_gib=8, scratch="scratch"))
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal, TypedDict

import numpy as np
import numpy.typing as npt

from tomopose.errors import InputError
from tomopose.reconstruction.line_integrals import Correction

Order = str | tuple[int, ...]
"""Of the views: "golden", "random" (from a seed), "sequential", or a permutation of their indices; see `view_order`."""


def require_count(name: str, value: object) -> int:
    """A positive whole number, or InputError."""
    number = value if isinstance(value, (int, float, np.integer, np.floating)) else 0.5
    if isinstance(value, bool) or not (np.isfinite(number) and int(number) == number and number >= 1):
        raise InputError(f"{name} is {value!r}; a positive whole number is needed")
    return int(number)


@dataclass(frozen=True, kw_only=True)
class FDK:
    """Filtered back-projection along the source's path.

    preview: also where it is not defined (holes in the turn, jumps, an object wider than the panel), for a quick look.
    """

    preview: bool = False


@dataclass(frozen=True, kw_only=True)
class SART:
    """Simultaneous algebraic reconstruction.

    iterations:  sweeps over all views.
    relaxation:  above 0 and below 2; one factor, or one a sweep.
    order:       "golden", "random", "sequential", or a permutation of the views' indices.
    seed:        of the random order.
    subset_size: views that share an update.
    nonnegative: cut negative values after each update.
    start:       FDK() to begin with; None to begin from zero; "auto" for FDK where it is defined.
    """

    iterations: int = 1
    relaxation: float | tuple[float, ...] = 0.8
    order: Order = "golden"
    seed: int = 0
    subset_size: int = 1
    nonnegative: bool = False
    start: FDK | Literal["auto"] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "iterations", require_count("iterations", self.iterations))
        object.__setattr__(self, "subset_size", require_count("subset_size", self.subset_size))
        if not isinstance(self.order, str):
            object.__setattr__(self, "order", tuple(int(j) for j in self.order))
        if not isinstance(self.relaxation, float):
            given = np.asarray(self.relaxation, dtype=np.float64)
            factors = float(given) if given.ndim == 0 else tuple(float(f) for f in given)
            object.__setattr__(self, "relaxation", factors)
        if len(self.factors) != self.iterations:
            raise InputError(f"{len(self.factors)} relaxation factors but {self.iterations} iterations")
        if not all(0 < f < 2 for f in self.factors):
            raise InputError(f"relaxation is {self.relaxation!r}; SART needs factors above 0 and below 2")

    @property
    def factors(self) -> tuple[float, ...]:
        """The relaxation of each sweep."""
        return self.relaxation if isinstance(self.relaxation, tuple) else (self.relaxation,) * self.iterations


@dataclass(frozen=True, kw_only=True)
class OSSART(SART):
    """SART with ordered subsets of five views."""

    subset_size: int = 5


@dataclass(frozen=True, kw_only=True)
class CGLS:
    """Conjugate gradients on the least squares problem, with the volume whole in memory."""

    iterations: int = 20

    def __post_init__(self) -> None:
        object.__setattr__(self, "iterations", require_count("iterations", self.iterations))


Algorithm = FDK | SART | CGLS

NAMED: Mapping[str, Algorithm] = MappingProxyType(
    {
        "fdk": FDK(),
        "fdk+sart": SART(start=FDK()),
        "sart": SART(),
        "ossart": OSSART(),
        "cgls": CGLS(),
        "fdk-preview": FDK(preview=True),
    }
)
"""Short names of algorithms; "auto" is the choice of `choice.py`."""

PAPER = SART(iterations=1, relaxation=0.8, order="random")
"""As in Butzhammer et al., Meas. Sci. Technol. 34 (2023) 015403, sec. 6.2: one iteration of SART, relaxation 0.8.

The paper does not say in which order the views were taken.  From zero, one sweep in random order left ball centres
0.003 voxel beside their place, in golden order 0.008 (docs/validation/reconstruction.md).
"""


@dataclass(frozen=True, kw_only=True)
class Execution:
    """Where and within what a reconstruction runs; it changes the numbers by rounding only.

    memory_gib:  memory to keep within; what is free unless given.
    scratch:     folder for the slabs of a volume that does not fit.
    checkpoint, checkpoint_seconds: folder in which the state is kept, at most that often (0: after every update); a
                 second call with the same images, matrices and settings continues from there.
    client:      a dask.distributed client: its workers hold the volume in slabs.
    slabs:       number of slabs; as many as needed, or one a worker, unless given.
    engine_options: what the engine takes: threads, kernels (cpu).
    """

    memory_gib: float | None = None
    scratch: str | Path | None = None
    checkpoint: str | Path | None = None
    checkpoint_seconds: float = 60.0
    client: object | None = None
    slabs: int | None = None
    engine_options: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "engine_options", MappingProxyType(dict(self.engine_options)))

    @property
    def pieces(self) -> tuple[str, ...]:
        """Names of the settings given here that ask for a volume in pieces or one that is kept."""
        asked = ("checkpoint", "scratch", "client", "slabs")
        return tuple(name for name in asked if getattr(self, name) is not None)


def algorithm_of(asked: Algorithm | str | None) -> Algorithm | None:
    """The algorithm of that name, or the value itself; None for "auto"."""
    if asked is None or asked == "auto":
        return None
    if isinstance(asked, str):
        if asked not in NAMED:
            raise InputError(f"algorithm is {asked!r}; auto, {', '.join(NAMED)} are known")
        return NAMED[asked]
    if not isinstance(asked, (FDK, SART, CGLS)):
        raise InputError(f"algorithm is a {type(asked).__name__}; a name, FDK, SART, OSSART or CGLS is needed")
    return asked


def with_options(algorithm: Algorithm | None, options: Mapping[str, object]) -> Algorithm | None:
    """The algorithm with some of its values changed; without an algorithm SART, with FDK as a start where defined.

    Raises InputError for a value that the algorithm does not have.
    """
    if not options:
        return algorithm
    base = SART(start="auto") if algorithm is None else algorithm
    known = [f.name for f in fields(base)]
    for name in options:
        if name not in known:
            raise InputError(f"{name_of(base)} has no {name}; it has {', '.join(known)}")
    return replace(base, **options)  # type: ignore[arg-type]


def name_of(algorithm: Algorithm) -> str:
    """The short name of an algorithm's kind."""
    if isinstance(algorithm, FDK):
        return "fdk-preview" if algorithm.preview else "fdk"
    if isinstance(algorithm, CGLS):
        return "cgls"
    return "fdk+sart" if algorithm.start is not None else "ossart" if isinstance(algorithm, OSSART) else "sart"


def described(algorithm: Algorithm) -> dict[str, object]:
    """The algorithm in words and numbers, for settings and provenance."""
    found: dict[str, object] = {"algorithm": name_of(algorithm)}
    if isinstance(algorithm, CGLS):
        return found | {"iterations": algorithm.iterations}
    if isinstance(algorithm, FDK):
        return found
    return found | {
        "iterations": algorithm.iterations,
        "relaxation": list(algorithm.factors),
        "order": algorithm.order if isinstance(algorithm.order, str) else "given",
        "seed": algorithm.seed,
        "subset_size": algorithm.subset_size,
        "nonnegative": algorithm.nonnegative,
    }


Level = float | npt.NDArray[np.generic]


class EarlierOptions(TypedDict, total=False):
    """The options of `reconstruct` in tomopose 0.1 that belong to `Correction`, an algorithm or `Execution` now."""

    white: Level
    dark: Level
    bad_pixels: npt.NDArray[np.bool_] | None
    invalid: Literal["error", "exclude"]
    beam_hardening: Sequence[float]
    ring_width: int | None
    relaxation: float | Sequence[float]
    iterations: int | None
    order: str | Sequence[int]
    seed: int
    subset_size: int | None
    nonnegative: bool
    memory_gib: float | None
    scratch: str | Path | None
    checkpoint: str | Path | None
    checkpoint_seconds: float
    client: object | None
    slabs: int | None
    engine_options: Mapping[str, object] | None


OF_CORRECTION = ("white", "dark", "bad_pixels", "invalid", "beam_hardening", "ring_width")
OF_ALGORITHM = ("relaxation", "iterations", "order", "seed", "subset_size", "nonnegative")


def with_earlier(
    algorithm: Algorithm | None,
    correction: Correction | None,
    execution: Execution | None,
    earlier: Mapping[str, object],
) -> tuple[Algorithm | None, Correction | None, Execution]:
    """The values with the options of tomopose 0.1 put where they belong, and a DeprecationWarning that says where.

    Raises TypeError for an option that never was, InputError where one contradicts a value that is given too.
    """
    unknown = [name for name in earlier if name not in EarlierOptions.__annotations__]
    if unknown:
        raise TypeError(f"reconstruct() got an unexpected keyword argument {unknown[0]!r}")
    if earlier:
        warnings.warn(
            f"reconstruct({next(iter(earlier))}=...) belongs to Correction(...), SART(...) or Execution(...) since "
            "tomopose 0.2",
            DeprecationWarning,
            stacklevel=3,
        )
    given = {name: value for name, value in earlier.items() if value is not None}
    for_images = {name: given.pop(name) for name in OF_CORRECTION if name in given}
    for_algorithm = {name: given.pop(name) for name in OF_ALGORITHM if name in given}
    if (for_images and correction is not None) or (given and execution is not None):
        name = next(iter(for_images or given))
        raise InputError(
            f"{name} is given beside a value that holds it; put it into {'Correction' if for_images else 'Execution'}"
        )
    if for_images:
        correction = Correction(**for_images)  # type: ignore[arg-type]
    if given:
        execution = Execution(**given)  # type: ignore[arg-type]
    return with_options(algorithm, for_algorithm), correction, execution or Execution()
