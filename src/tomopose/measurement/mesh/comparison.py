"""Nominal-actual comparison (fig. 12): how far the measured surface lies from a reference, at the reference's vertices.

The edge search runs along the reference's normals straight in the volume, so that no mesh of the measured surface and
no interpolation comes between.  Vertices on sharp edges have no normal of their own and are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from tomopose.errors import InputError, UnitError
from tomopose.geometry.rotations import rotation_angle_between
from tomopose.measurement.alignment import Alignment, best_fit
from tomopose.measurement.mesh.colours import vik
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.measurement.probing import probe
from tomopose.measurement.surface.edges import EdgeSettings, flag_counts
from tomopose.measurement.surface.grey_levels import GreyLevels, grey_levels
from tomopose.units import MICROMETRES_PER_MM, Array, float_array
from tomopose.volume import Volume

BEST_FIT_POINTS, BEST_FIT_ROUNDS, BEST_FIT_STOP = 20_000, 10, 1e-5
Progress = Callable[[int, int], None]
PERCENTILES = (0.5, 2.5, 5.0, 25.0, 50.0, 75.0, 95.0, 97.5, 99.5)
SCALE_RANGE = (0.02, 20.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Signed distances of the measured surface from a reference.

    mesh: the reference in part coordinates;  points (n, 3): its vertices in W, mm;  deviation (n,): mm, positive where
    the measured surface lies outside; nan where it was not measured;  flags (n,): EdgeFlag;  on_edge (n,): left out;
    alignment: part to W, with its rule;  moved_mm, turned_rad: what a best fit changed, 0 otherwise.
    """

    mesh: Mesh
    points: Array
    deviation: Array
    flags: np.ndarray
    on_edge: np.ndarray
    alignment: Alignment
    moved_mm: float = 0.0
    turned_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("points", "deviation"):
            object.__setattr__(self, name, float_array(getattr(self, name)))

    @property
    def measured(self) -> Array:
        """The deviations that were measured, mm."""
        return self.deviation[np.isfinite(self.deviation)]

    def percentiles(self) -> Mapping[str, float]:
        """Percentile -> deviation, mm."""
        values = np.percentile(self.measured, PERCENTILES)
        return {f"{p:g} %": float(v) for p, v in zip(PERCENTILES, values, strict=True)}

    def share_within(self, tolerance: float) -> float:
        """Share of the measured vertices within +-tolerance, mm."""
        return float(np.mean(np.abs(self.measured) <= tolerance))

    def histogram(self, range_mm: float, bins: int = 101) -> tuple[Array, Array]:
        """Counts (bins,) and bin centres (bins,), mm, over +-range; what lies beyond counts in the outermost bins."""
        count, edges = np.histogram(np.clip(self.measured, -range_mm, range_mm), bins=bins, range=(-range_mm, range_mm))
        return count.astype(np.float64), 0.5 * (edges[1:] + edges[:-1])

    def colours(self, range_mm: float) -> np.ndarray:
        """(n, 3) uint8: the `vik` map clipped at +-range, grey where nothing was measured."""
        if not range_mm > 0:
            raise InputError(f"the range of the colour map is {range_mm} mm; a positive length is needed")
        rgb = vik(np.clip(0.5 + 0.5 * np.nan_to_num(self.deviation) / range_mm, 0, 1))
        rgb[~np.isfinite(self.deviation)] = 150
        return rgb

    def to_json(self) -> dict[str, Any]:
        d = self.measured
        return {
            "vertices": len(self.deviation),
            "measured": len(d),
            "on_edge": int(self.on_edge.sum()),
            "flags": flag_counts(self.flags[~self.on_edge]),
            "mean_mm": float(d.mean()),
            "rms_mm": float(np.sqrt(np.mean(d**2))),
            "min_mm": float(d.min()),
            "max_mm": float(d.max()),
            "percentiles_mm": dict(self.percentiles()),
            "alignment": self.alignment.to_json(),
            "best_fit_moved_mm": self.moved_mm,
            "best_fit_turned_rad": self.turned_rad,
        }


def compare(
    volume: Volume,
    reference: Mesh,
    *,
    alignment: Alignment | None = None,
    fit: Literal["none", "best-fit"] = "none",
    search_mm: float | None = None,
    settings: EdgeSettings | None = None,
    levels: GreyLevels | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Compare a volume with a reference mesh (part coordinates, mm).

    alignment: part to W: none (the volume lies calibrated), or from `alignment.from_datums`;  fit: best-fit moves it
    further, to least squares of the deviations, and reports by how much: a best fit hides part of systematic error.
    search_mm: how far the measured surface may lie from the reference.

    Raises InputError for a reference that is not watertight, UnitError for one of another scale (metres).
    """
    reference.require_closed()
    _require_same_scale(reference, volume)
    start = alignment or Alignment.none()
    found_levels = levels or grey_levels(volume)[-1]
    chosen = np.flatnonzero(~reference.on_edge)
    if not chosen.size:
        raise InputError("all vertices of the reference lie on sharp edges; give a mesh of smaller triangles")

    def deviations(rows: np.ndarray, a: Alignment, shown: Progress | None) -> tuple[Array, np.ndarray]:
        found = probe(
            volume,
            a.points(reference.points[rows]),
            a.directions(reference.normals[rows]),
            settings=settings,
            search_mm=search_mm,
            contrast=found_levels.contrast,
            progress=shown,
        )
        return found.edges.offset, found.edges.flags

    final = start
    if fit == "best-fit":
        some = chosen[:: max(len(chosen) // BEST_FIT_POINTS, 1)]
        for _ in range(BEST_FIT_ROUNDS):
            d, _flags = deviations(some, final, None)
            good = np.isfinite(d)
            previous = final
            final = best_fit(final, reference.points[some[good]], reference.normals[some[good]], d[good])
            moved = final.points(reference.points[some]) - previous.points(reference.points[some])
            if float(np.abs(moved).max()) < BEST_FIT_STOP:
                break
    elif fit != "none":
        raise InputError(f"fit is {fit!r}; 'none' or 'best-fit' is needed")
    d, flags = deviations(chosen, final, progress)
    deviation = np.full(len(reference.points), np.nan)
    all_flags = np.zeros(len(reference.points), dtype=np.uint8)
    deviation[chosen], all_flags[chosen] = d, flags
    centre = reference.points.mean(axis=0)
    return Comparison(
        mesh=reference,
        points=final.points(reference.points),
        deviation=deviation,
        flags=all_flags,
        on_edge=reference.on_edge,
        alignment=final,
        moved_mm=float(np.linalg.norm(final.points(centre) - start.points(centre))),
        turned_rad=float(rotation_angle_between(final.R, start.R)),
    )


def _require_same_scale(reference: Mesh, volume: Volume) -> None:
    extent = float(np.linalg.norm(volume.grid.spacing * np.array(volume.grid.n_xyz)))
    ratio = reference.size / extent
    if not SCALE_RANGE[0] < ratio < SCALE_RANGE[1]:
        hint = "metres" if 2e-5 < ratio < 2e-2 else "another unit"
        raise UnitError(
            f"the reference is {reference.size:.4g} mm across, the volume {extent:.4g} mm: the reference seems to be "
            f"in {hint}; convert it to mm"
        )


def table(comparison: Comparison) -> str:
    """CSV: x_mm, y_mm, z_mm, deviation_um, flag; one row a vertex of the reference, in W."""
    rows = ["x_mm,y_mm,z_mm,deviation_um,flag"]
    for p, d, f in zip(comparison.points, comparison.deviation * MICROMETRES_PER_MM, comparison.flags, strict=True):
        rows.append(f"{p[0]:.6f},{p[1]:.6f},{p[2]:.6f},{'' if np.isnan(d) else f'{d:.4f}'},{f}")
    return "\n".join(rows) + "\n"
