"""A standard of many spheres: found in a surface, identified by their constellation, measured one by one.

Every vertex of a ball of radius r votes for the centre x - r n; votes of a ball meet within the noise of the normals,
those of shafts and bases do not.  Which ball is which follows from distances alone: three found centres that match
three calibrated ones fix the motion, and the motion under which most centres match wins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from tomopose.errors import InputError, ShapeError
from tomopose.measurement.alignment import Alignment, from_points
from tomopose.measurement.features.feature import Feature
from tomopose.measurement.features.fits import fit_sphere
from tomopose.measurement.regions import without_edges
from tomopose.measurement.surface.surface import Surface
from tomopose.units import Array

VOTE_SHARE = 0.25
"""Share of a whole ball's vertices that must vote for a centre; a ball on a thick shaft still gives half."""
CORRELATION_VOXELS = 6.0
LEAST_MATCHED, LEAST_SHARE = 4, 0.5
SEED_PAIRS = 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """index: (n_calibrated,) index into the found centres, -1 where a ball was not found;  alignment: standard to W;
    rms: of the matched centres after the motion, mm."""

    index: np.ndarray
    alignment: Alignment
    rms: float


def find_spheres(surface: Surface, radius: float) -> Array:
    """Centres (m, 3), mm in W, of balls of about `radius`, mm, in a surface; brightest vote first.

    InputError where it is not found: a wrong radius or a wrong unit.
    """
    from scipy.ndimage import label, maximum_filter, uniform_filter

    voxel = float(surface.spacing.min())
    if not radius > 2 * voxel:
        raise InputError(f"radius {radius} mm is not above two voxels of {voxel:g} mm; is it in mm?")
    votes = surface.points - radius * surface.normals
    cell = max(0.12 * radius, voxel)
    low = votes.min(axis=0) - 3 * cell
    size = np.ceil((votes.max(axis=0) - low) / cell).astype(int) + 3
    if np.prod(size.astype(float)) > 4e8:
        raise InputError(f"radius {radius} mm asks for {size.tolist()} cells of {cell:g} mm; is it in mm?")
    index = ((votes - low) / cell).astype(np.intp)
    count = np.bincount(np.ravel_multi_index(tuple(index.T), tuple(size)), minlength=int(np.prod(size)))
    grid = 27.0 * uniform_filter(count.reshape(size).astype(np.float64), size=3, mode="constant")
    a, b, c = (surface.points[surface.faces[:, k]] for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    expected = 4 * np.pi * radius**2 * len(surface) / area
    width = 2 * int(np.ceil(0.7 * radius / cell)) + 1
    # Equal neighbours would count twice: each connected plateau of maxima is one candidate.
    places, found = label((grid == maximum_filter(grid, size=width)) & (grid > VOTE_SHARE * expected))
    centres = []
    for k in range(1, found + 1):
        at = low + (np.argwhere(places == k).mean(axis=0) + 0.5) * cell
        near = votes[np.linalg.norm(votes - at, axis=1) < 2 * cell]
        centres.append((len(near), np.median(near, axis=0)))
    if not centres:
        raise InputError(f"no ball of radius {radius} mm in a surface of {len(surface)} vertices; check the diameter")
    return np.array([centre for _, centre in sorted(centres, key=lambda item: -item[0])])


def identify_spheres(found: npt.ArrayLike, calibrated: npt.ArrayLike, *, tolerance: float) -> Identified:
    """Which found centre (m, 3) is which calibrated one (n, 3), by their constellation; mm, frames of their own.

    tolerance: by how much a distance may differ, mm.

    Raises InputError where fewer than four centres, or half of them, match, or where a different assignment matches as
    many centres as well (a symmetric constellation).
    """
    f, c = np.asarray(found, dtype=np.float64), np.asarray(calibrated, dtype=np.float64)
    for name, x in (("found", f), ("calibrated", c)):
        if x.ndim != 2 or x.shape[1] != 3:
            raise ShapeError(f"{name} centres are (n, 3); got {x.shape}")
    if min(len(f), len(c)) < LEAST_MATCHED:
        raise InputError(f"{len(f)} found and {len(c)} calibrated spheres; at least {LEAST_MATCHED} of each are needed")
    candidates: dict[tuple[int, ...], tuple[int, float, Alignment]] = {}
    D = np.linalg.norm(f[:, None] - f[None], axis=2)
    for triple in _seeds(c):
        for match in _triples(D, c[list(triple)], tolerance):
            index, alignment, rms = _grown(f, c, triple, match, tolerance)
            candidates[tuple(index.tolist())] = (int((index >= 0).sum()), rms, alignment)
    ranked = sorted(candidates.items(), key=lambda item: (-item[1][0], item[1][1]))
    if not ranked or ranked[0][1][0] < max(LEAST_MATCHED, LEAST_SHARE * min(len(f), len(c))):
        raise InputError(
            f"the constellation of {len(f)} found spheres does not match the {len(c)} calibrated ones to "
            f"{tolerance:g} mm; check the coordinates file, its unit and the voxel size"
        )
    best, (n, rms, alignment) = ranked[0]
    for _, (n_other, rms_other, _alignment) in ranked[1:]:
        if n_other == n and rms_other < max(3 * rms, 0.2 * tolerance):
            raise InputError(
                f"the constellation is ambiguous: two assignments match {n} spheres, to {rms:.4f} and "
                f"{rms_other:.4f} mm rms; the standard is symmetric, or the tolerance too wide"
            )
    return Identified(index=np.array(best), alignment=alignment, rms=rms)


def _seeds(c: Array) -> list[tuple[int, int, int]]:
    """A few triples of calibrated centres that span large triangles, over different spheres, so that some of them were
    found even if others were not."""
    seeds = []
    order = np.argsort(-np.linalg.norm(c - c.mean(axis=0), axis=1), kind="stable")
    some = order[: min(len(order), 9)]
    triples = sorted(
        combinations(some.tolist(), 3),
        key=lambda t: -float(np.linalg.norm(np.cross(c[t[1]] - c[t[0]], c[t[2]] - c[t[0]]))),
    )
    used = np.zeros(len(c), dtype=int)
    for t in triples:
        if max(used[list(t)]) < 2:
            seeds.append(t)
            used[list(t)] += 1
        if len(seeds) == SEED_PAIRS:
            break
    return seeds or [triples[0]]


def _triples(D: Array, corners: Array, tolerance: float) -> list[tuple[int, int, int]]:
    """All ordered triples of found spheres whose distances (D) are those of three calibrated corners."""
    d_01, d_02, d_12 = (float(np.linalg.norm(corners[i] - corners[j])) for i, j in ((0, 1), (0, 2), (1, 2)))
    matches = []
    for i, j in np.argwhere(np.abs(D - d_01) < tolerance):
        for k in np.flatnonzero((np.abs(D[i] - d_02) < tolerance) & (np.abs(D[j] - d_12) < tolerance)):
            matches.append((int(i), int(j), int(k)))
    return matches


def _grown(
    f: Array, c: Array, triple: tuple[int, int, int], match: tuple[int, int, int], tolerance: float
) -> tuple[np.ndarray, Alignment, float]:
    """The assignment that a matched triple leads to: transform, match what lands near, transform again."""
    from scipy.spatial import cKDTree

    alignment = from_points(c[list(triple)], f[list(match)])
    index = np.full(len(c), -1)
    for _ in range(3):
        apart, near = cKDTree(f).query(alignment.points(c))
        index = np.where(apart < 2 * tolerance, near, -1)
        kept, first = np.unique(index[index >= 0], return_index=True)
        owners = np.flatnonzero(index >= 0)[first]
        index = np.full(len(c), -1)
        index[owners] = kept
        if len(owners) < 3:
            return index, alignment, np.inf
        alignment = from_points(c[owners], f[index[owners]])
    rms = float(np.sqrt(np.mean(np.sum((alignment.points(c[owners]) - f[index[owners]]) ** 2, axis=1))))
    return index, alignment, rms


def measure_sphere(
    surface: Surface,
    centre: Array,
    radius: float,
    *,
    safety: float = 0.5,
    max_angle: float = np.radians(15.0),
    outliers: float | None = 3.0,
) -> Feature:
    """The ball about `centre` (3,), mm: all its good vertices that keep `safety`, mm, from steep places (sec. 6.2).

    InputError where less than ten vertices are left.
    """
    rough = centre
    for _ in range(2):
        d = surface.points - rough
        rho = np.linalg.norm(d, axis=1)
        near = np.flatnonzero((np.abs(rho - radius) < max(0.25 * radius, safety)) & surface.good)
        cosine = np.einsum("ij,ij->i", d[near], surface.normals[near]) / np.maximum(rho[near], 1e-300)
        angle = np.arccos(np.clip(cosine, -1, 1))
        kept = near[without_edges(surface.points[near], angle, max_angle, safety)]
        if len(kept) < 10:
            raise InputError(
                f"{len(kept)} surface points are left of the ball at {np.round(centre, 3).tolist()} mm; make the "
                "safety distance smaller or the angle larger"
            )
        fit = fit_sphere(
            surface.points[kept],
            area=surface.areas[kept],
            outliers=outliers,
            correlation_range=CORRELATION_VOXELS * float(surface.spacing.max()),
        )
        rough = fit.point
    return fit


def scale_factor(found: Array, calibrated: Array) -> float:
    """The factor on measured lengths that brings all centre distances to the calibrated ones, least squares.

    found, calibrated: (n, 3) matched centres, mm.
    """
    pairs = list(combinations(range(len(found)), 2))
    a, b = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    measured = np.linalg.norm(found[a] - found[b], axis=1)
    true = np.linalg.norm(calibrated[a] - calibrated[b], axis=1)
    return float(measured @ true / (measured @ measured))


def measure_spheres(
    surface: Surface,
    calibrated: npt.ArrayLike,
    diameter: float,
    *,
    tolerance: float = 0.3,
    safety: float = 0.5,
    max_angle: float = np.radians(15.0),
    outliers: float | None = 3.0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Mapping[int, Feature], Identified]:
    """All spheres of a standard: number in the calibrated list -> fitted sphere, and the identification."""
    c = np.asarray(calibrated, dtype=np.float64)
    found = find_spheres(surface, diameter / 2)
    which = identify_spheres(found, c, tolerance=tolerance)
    fits: dict[int, Feature] = {}
    for number, index in enumerate(which.index):
        if index >= 0:
            fits[number] = measure_sphere(
                surface, found[index], diameter / 2, safety=safety, max_angle=max_angle, outliers=outliers
            )
        if progress is not None:
            progress(number + 1, len(c))
    return fits, which
