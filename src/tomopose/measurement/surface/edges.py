"""Edges along many lines through a volume, piece by piece, so that the volume need not fit into memory.

Each line starts at a point and runs along a normal from material to background.  Flags say where no edge was measured:

    BORDER         the line leaves the volume           NOT_CONVERGED  the blurred step does not fit
    NO_EDGE        no falling edge within the search    LOW_CONTRAST   below the threshold share of the global contrast
    THIN           another edge right behind it         NOT_FLAT       a plateau is missing
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Literal

import numpy as np
import numpy.typing as npt

from tomopose.coverage import MAD_TO_SIGMA
from tomopose.errors import InputError, ShapeError
from tomopose.measurement.surface import edge_kernel as kernel
from tomopose.measurement.surface.plateaus import shared_plateaus
from tomopose.measurement.surface.splines import REACH, spline_coefficients
from tomopose.units import Array, float_array
from tomopose.values import value
from tomopose.volume import Volume

Method = Literal["esf", "local-50"]


class EdgeFlag(IntFlag):
    """Why a point has no measured edge; 0 is a good one."""

    GOOD = 0
    BORDER = kernel.BORDER
    NO_EDGE = kernel.NO_EDGE
    THIN = kernel.THIN
    NOT_CONVERGED = kernel.NOT_CONVERGED
    LOW_CONTRAST = 16
    NOT_FLAT = 32


LAYERS = 128
FEWEST_VOXELS = 4
"""Along each axis of the part of a volume that edges are searched in."""
SIGMA_SAMPLE, SIGMA_ROUNDS, SIGMA_TOLERANCE = 3000, 40, 2e-5
SIGMA_RANGE = (0.3, 4.0)
START_SIGMA = 1.0
LONGER, LEVEL, LEAST_LONGER = 4.0, 3e-3, 100
"""By how many voxels plateaus may be longer, the share of the contrast by which that may change the levels of the whole
surface, and the number of edges from which that can be decided."""
FLAT_SHARE, FLAT_NOISE = 0.1, 3.0
"""A plateau counts as missing where its halves differ by more than this share of the contrast plus so many rms."""


@dataclass(frozen=True, kw_only=True)
class EdgeSettings:
    """How edges are searched for.

    search_distance:    how far from its start an edge may lie, in voxels.
    window:             half length of the profile that is fitted, in voxels; from sigma where None: 2.5 sigma + 1.5,
                        with plateaus LONGER by 4 where they are shared, level so far, and no other edge is near.
    contrast_threshold: share of the global contrast below which an edge is not believed.
    method:             esf: fit of a blurred step; local-50: 50 % between the plateaus.
    sigma:              standard deviation of the blur, mm; estimated from the edges where None.
    plateau_radius:     neighbours within so many voxels share their plateaus; 0 leaves each edge its own.
    """

    search_distance: float = 2.0
    window: float | None = None
    contrast_threshold: float = 0.2
    method: Method = "esf"
    sigma: float | None = None
    plateau_radius: float = 3.0

    def __post_init__(self) -> None:
        if not self.search_distance > 0:
            raise InputError(f"search_distance is {self.search_distance} voxels; a positive number is needed")
        if self.window is not None and not 1.5 <= self.window <= 20:
            raise InputError(f"window is {self.window} voxels; 1.5 to 20 can be fitted")
        if not 0 <= self.contrast_threshold < 1:
            raise InputError(f"contrast_threshold is {self.contrast_threshold}; a share from 0 to below 1 is needed")
        if self.method not in ("esf", "local-50"):
            raise InputError(f"method is {self.method!r}; 'esf' or 'local-50' is needed")
        if self.sigma is not None and not self.sigma > 0:
            raise InputError(f"sigma is {self.sigma} mm; a positive length is needed")
        if not 0 <= self.plateau_radius <= 50:
            raise InputError(f"plateau_radius is {self.plateau_radius} voxels; 0 to 50 is possible")


@value
class Edges:
    """Edges along lines.

    offset:  (n,) mm along the normal from the start point; nan where a flag is set.
    inside, outside:  (n,) grey levels of the two plateaus;  residual: (n,) rms of the fit, in grey levels.
    u:       (n,) mm, standard uncertainty of the offset from the profile's own residuals, as if the noise of voxels
             were independent.
    flags:   (n,) EdgeFlag values, uint8;  sigma: blur, mm;  window: half length of the profiles, mm.
    longer:  number of edges whose plateaus reach LONGER voxels beyond it.
    """

    offset: Array
    inside: Array
    outside: Array
    residual: Array
    u: Array
    flags: np.ndarray
    sigma: float
    window: float
    longer: int = 0

    def __post_init__(self) -> None:
        for name in ("offset", "inside", "outside", "residual", "u"):
            object.__setattr__(self, name, float_array(getattr(self, name)))

    @property
    def good(self) -> np.ndarray:
        return np.asarray(self.flags == 0)

    def flag_counts(self) -> dict[str, int]:
        """How many lines carry each flag."""
        return flag_counts(self.flags)


def flag_counts(flags: np.ndarray) -> dict[str, int]:
    """How many of flags (n,) carry each EdgeFlag."""
    return {str(f.name): int(np.count_nonzero(flags & f)) for f in EdgeFlag if f}


def counts_in_words(flags: np.ndarray) -> str:
    return ", ".join(f"{n} {name}" for name, n in flag_counts(flags).items() if n)


def search_edges(
    volume: Volume,
    points: npt.ArrayLike,
    normals: npt.ArrayLike,
    settings: EdgeSettings,
    *,
    contrast: float | None = None,
    layers: int = LAYERS,
    progress: Callable[[int, int], None] | None = None,
) -> Edges:
    """Edges along the lines from points (n, 3) with normals (n, 3), mm in W, normals from material to background.

    contrast: global contrast, grey levels, for the threshold; the median of the edges' own unless given.
    Raises ShapeError for arrays of the wrong shape, InputError for normals of no length or where no edge is found.
    """
    x, n = _checked(points, normals)
    index = volume.grid.indices(x)
    unit = float(volume.grid.spacing.min())
    step = n[:, ::-1] * unit / volume.grid.spacing[::-1]
    sigma = None if settings.sigma is None else settings.sigma / unit
    if sigma is None:
        sigma = _estimated_sigma(volume, index, step, settings)
    window = fit_window(settings, sigma)
    result = np.full((len(x), kernel.N_COLUMNS), np.nan)
    flags = np.full(len(x), kernel.BORDER, dtype=np.uint8)
    n_z = volume.grid.shape[0]
    starts = range(0, n_z, layers)
    for done, z_0 in enumerate(starts):
        rows = np.flatnonzero((index[:, 0] >= z_0) & (index[:, 0] < min(z_0 + layers, n_z)))
        if rows.size:
            result[rows], flags[rows] = _piece(volume, index[rows], step[rows], sigma, window, settings)
        if progress is not None:
            progress(done + 1, len(starts))
    longer = _lengthen(result, flags)
    edges = replace(_judged(result, flags, sigma, window, unit, settings, contrast), longer=longer)
    return edges if settings.plateau_radius == 0 else _shared(edges, result, x, n, unit, settings.plateau_radius)


def _checked(points: npt.ArrayLike, normals: npt.ArrayLike) -> tuple[Array, Array]:
    x, n = np.asarray(points, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or n.shape != x.shape:
        raise ShapeError(f"points and normals are both (n, 3); got {x.shape} and {n.shape}")
    if not len(x):
        raise InputError("there are no points to search edges from")
    length = np.linalg.norm(n, axis=1)
    if not (np.isfinite(x).all() and np.isfinite(length).all() and (length > 0).all()):
        raise InputError("points and normals must be finite, and normals must have a length")
    return x, n / length[:, None]


def fit_window(settings: EdgeSettings, sigma: float) -> float:
    """Half length, voxels, of the profile that is fitted where the blur is sigma, voxels."""
    window = 2.5 * sigma + 1.5 if settings.window is None else settings.window
    return round(window / kernel.STEP) * kernel.STEP


def _piece(
    volume: Volume, index: Array, step: Array, sigma: float, window: float, settings: EdgeSettings
) -> tuple[Array, np.ndarray]:
    """Edges of lines that lie close together: the part of the volume about them is read and filtered."""
    longer = LONGER if settings.window is None and settings.plateau_radius > 0 else 0.0
    reach = settings.search_distance + 2 + window + max(window, longer + 2.5 * sigma + 1)
    reach = reach * np.abs(step).max(axis=0)
    low, high = _part(index, reach, volume.grid.shape)
    if (high - low < FEWEST_VOXELS).any():
        return np.full((len(index), kernel.N_COLUMNS), np.nan), np.full(len(index), kernel.BORDER, dtype=np.uint8)
    part = volume.values[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    coefficients = spline_coefficients(part)
    result: tuple[Array, np.ndarray] = kernel.search_lines(
        coefficients, index - low, step, sigma, window, settings.search_distance, settings.method == "esf", longer
    )
    return result


def _part(index: Array, reach: Array, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """First voxel, and the one after the last, of the part of the volume about edges at index (n, 3)."""
    low = np.clip(np.floor(index.min(axis=0) - reach) - REACH, 0, shape)
    high = np.clip(np.ceil(index.max(axis=0) + reach) + REACH + 1, 0, shape)
    return low.astype(int), high.astype(int)


def _estimated_sigma(volume: Volume, index: Array, step: Array, settings: EdgeSettings) -> float:
    """The blur, voxels: least squares common to a sample of edges, all their s_0, a, b free.

    The sample lies in the slab of layers that holds most points, so that only this part is read.
    """
    layers = LAYERS // 2
    slab = np.clip(index[:, 0] // layers, 0, None).astype(np.intp)
    rows = np.flatnonzero(slab == np.argmax(np.bincount(slab)))
    rows = rows[:: max(len(rows) // SIGMA_SAMPLE, 1)]
    reach = (settings.search_distance + 2 * fit_window(settings, SIGMA_RANGE[1]) + 2) * np.abs(step).max(axis=0)
    low, high = _part(index[rows], reach, volume.grid.shape)
    if (high - low < FEWEST_VOXELS).any():
        raise InputError(
            f"none of {len(rows)} points looked at lies within the volume or near it; check their place, the unit and "
            "the alignment"
        )
    coefficients = spline_coefficients(volume.values[low[0] : high[0], low[1] : high[1], low[2] : high[2]])

    def edges(sigma: float) -> tuple[Array, np.ndarray]:
        result, flags = kernel.search_lines(
            coefficients,
            index[rows] - low,
            step[rows],
            sigma,
            fit_window(settings, sigma),
            settings.search_distance,
            True,
            0.0,
        )
        good = flags == 0
        if not good.any():
            raise InputError(
                f"no edge was found at any of {len(rows)} points looked at ({counts_in_words(flags)}): grey levels do "
                "not fall along the normals, the surface is farther than the search distance, or walls are too thin"
            )
        return result, good

    return common_sigma(edges, rounds=SIGMA_ROUNDS, tolerance=SIGMA_TOLERANCE)


def common_sigma(edges: Callable[[float], tuple[Array, np.ndarray]], *, rounds: int, tolerance: float) -> float:
    """The blur, voxels, for which least squares common to all edges are least.

    edges: sigma -> the rows of results (n, N_COLUMNS) of fits with that blur, and (n,) which of them are edges; where
    none is, the iteration ends.  tolerance: voxels, of the last change.
    """
    sigma = START_SIGMA
    for _ in range(rounds):
        result, good = edges(sigma)
        if not good.any():
            break
        contrast = result[:, kernel.A] - result[:, kernel.B]
        good &= contrast > 0.5 * np.median(contrast[good])
        good &= result[:, kernel.RMS] <= 3 * np.median(result[good, kernel.RMS]) + 1e-12 * np.abs(contrast)
        change = float(result[good, kernel.D_SIGMA].sum() / result[good, kernel.D_SIGMA_2].sum())
        sigma = float(np.clip(sigma + np.clip(change, -0.5, 0.5), *SIGMA_RANGE))
        if abs(change) < tolerance:
            break
    return sigma


def _lengthen(result: Array, flags: np.ndarray) -> int:
    """Longer plateaus, which determine grey levels better, where nothing speaks against them: into the rows of results.

    The levels beyond the window join the least squares of each fit that has them.  None do where that would change
    levels over the whole surface (cupping): the median change, and twice what it is uncertain by, must stay below LEVEL
    of the contrast.  Returns how many did.
    """
    rows = np.flatnonzero((flags == 0) & np.isfinite(result[:, kernel.INSIDE]))
    if len(rows) < LEAST_LONGER:
        return 0
    n = LONGER / kernel.STEP
    found = result[rows]
    aa, ab, bb = found[:, kernel.AA] + n, found[:, kernel.AB], found[:, kernel.BB] + n
    det = aa * bb - ab**2
    more = n * (found[:, [kernel.INSIDE, kernel.OUTSIDE]] - found[:, [kernel.A, kernel.B]])
    change = np.column_stack([bb * more[:, 0] - ab * more[:, 1], aa * more[:, 1] - ab * more[:, 0]]) / det[:, None]
    median = np.median(change, axis=0)
    spread = MAD_TO_SIGMA * np.median(np.abs(change - median), axis=0)
    # Neighbours share voxels: every fourth counts.
    certain = np.abs(median) + 2 * 1.2533 * spread / np.sqrt(len(rows) / 4)
    if (certain > LEVEL * np.median(found[:, kernel.A] - found[:, kernel.B])).any():
        return 0
    by_a, by_b = found[:, kernel.S_BY_A], found[:, kernel.S_BY_B]
    result[rows, kernel.A] += change[:, 0]
    result[rows, kernel.B] += change[:, 1]
    result[rows, kernel.S] += by_a * change[:, 0] + by_b * change[:, 1]
    result[rows, kernel.S_VARIANCE] = (
        found[:, kernel.S_VARIANCE_HELD] + (by_a**2 * bb - 2 * by_a * by_b * ab + by_b**2 * aa) / det
    )
    return len(rows)


def _judged(
    result: Array,
    flags: np.ndarray,
    sigma: float,
    window: float,
    unit: float,
    settings: EdgeSettings,
    contrast: float | None,
) -> Edges:
    difference = result[:, kernel.A] - result[:, kernel.B]
    good = flags == 0
    if contrast is None and good.any():
        contrast = float(np.median(difference[good]))
    if contrast is not None and good.any():
        low = np.isfinite(difference) & (difference < settings.contrast_threshold * contrast)
        flags[low] |= np.uint8(EdgeFlag.LOW_CONTRAST)
        allowed = FLAT_SHARE * difference + FLAT_NOISE * float(np.median(result[good, kernel.RMS]))
        for column in (kernel.INNER_SLOPE, kernel.OUTER_SLOPE):
            flags[np.abs(result[:, column]) > allowed] |= np.uint8(EdgeFlag.NOT_FLAT)
    # Spline samples closer than a voxel repeat the same noise: their number is divided by the samples a voxel.
    u = result[:, kernel.RMS] * np.sqrt(result[:, kernel.S_VARIANCE] / kernel.STEP)
    bad = flags != 0
    return Edges(
        offset=np.where(bad, np.nan, result[:, kernel.S] * unit),
        inside=result[:, kernel.A],
        outside=result[:, kernel.B],
        residual=result[:, kernel.RMS],
        u=np.where(bad, np.nan, u * unit),
        flags=flags,
        sigma=sigma * unit,
        window=window * unit,
    )


def _shared(edges: Edges, result: Array, points: Array, normals: Array, unit: float, radius: float) -> Edges:
    """The edges with their plateaus shared among neighbours, see `plateaus`; flags and residuals stay their own."""
    rows = np.flatnonzero(edges.good)
    if not rows.size:
        return edges
    own = result[rows][:, [kernel.A, kernel.B]]
    levels, count = shared_plateaus(points[rows], normals[rows], own, radius * unit)
    offset, u = np.array(edges.offset), np.array(edges.u)
    inside, outside = np.array(edges.inside), np.array(edges.outside)
    offset[rows] += unit * np.sum(result[rows][:, [kernel.S_BY_A, kernel.S_BY_B]] * (levels - own), axis=1)
    inside[rows], outside[rows] = levels.T
    held, free = result[rows, kernel.S_VARIANCE_HELD], result[rows, kernel.S_VARIANCE]
    u[rows] = unit * result[rows, kernel.RMS] * np.sqrt((held + (free - held) / count) / kernel.STEP)
    return replace(edges, offset=offset, u=u, inside=inside, outside=outside)
