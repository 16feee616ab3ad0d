"""Surface determination: a start surface of one grey level, then each vertex moved along its normal to the local edge.

Start surface by ISO-50 of the histogram (flying edges); normals from the gradient of the volume smoothed by one voxel;
edges by `edge_search`.  A vertex without a measurable edge stays on the start surface and carries its flag.

A blur of standard deviation sigma moves a curved surface towards its centre of curvature by sigma^2 (k_1 + k_2) / 2
(Bouma et al., IEEE Trans. Pattern Anal. Mach. Intell. 27 (2005) 1501): a ball loses sigma^2 / R in radius, a cylinder
half of that, a plane nothing.  The correction for it is off unless asked for, and the surface says whether it was made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from tomopose.errors import InputError
from tomopose.measurement.surface.contour import contour, main_components
from tomopose.measurement.surface.edges import EdgeFlag, Edges, EdgeSettings, counts_in_words, search_edges
from tomopose.measurement.surface.grey_levels import GreyLevels, grey_levels
from tomopose.measurement.surface.splines import (
    GAUSS_REACH,
    index_gradient_to_W,
    smoothed_curvatures,
    smoothed_gradients,
)
from tomopose.units import Array, float_array
from tomopose.values import require_types, value
from tomopose.volume import Volume

SurfaceMethod = Literal["esf", "local-50", "iso-50"]
NORMAL_SIGMA, CURVATURE_SIGMA = 1.0, 1.5
"""Smoothing for normals and for curvatures, voxels."""
LAYERS = 128
LEAST_AREA = 1e-3


@value
class Surface:
    """A measured surface in frame W.

    points:     (n, 3) mm;  faces: (m, 3) triangles, counter-clockwise seen from outside.
    normals:    (n, 3) unit, from material to background.
    offset:     (n,) mm, how far each vertex was moved from the start surface.
    contrast:   (n,) grey levels across the edge;  residual: (n,) rms of the profile's fit over that contrast.
    u:          (n,) mm, standard uncertainty from the profile alone;  flags: (n,) EdgeFlag, 0 where an edge was found.
    sigma:      blur, mm (nan for iso-50);  levels: grey levels of the start surface.
    corrected:  whether the curvature bias of the blur was removed;  settings: how it was made.
    """

    points: Array
    faces: np.ndarray
    normals: Array
    offset: Array
    contrast: Array
    residual: Array
    u: Array
    flags: np.ndarray
    sigma: float
    levels: GreyLevels
    spacing: Array
    corrected: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("points", "normals", "offset", "contrast", "residual", "u", "spacing"):
            object.__setattr__(self, name, float_array(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.points)

    @property
    def good(self) -> np.ndarray:
        """(n,) True where the edge was measured."""
        return np.asarray(self.flags == 0)

    @cached_property
    def areas(self) -> Array:
        """(n,) mm^2: a third of the triangles about each vertex; weights for fits.  Never below a thousandth of the
        mean, so that vertices of triangles without area count for nothing but can be fitted."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
        area = np.bincount(self.faces.ravel(), np.repeat(third, 3), minlength=len(self))
        result: Array = np.maximum(area, LEAST_AREA * area.mean())
        return result


@require_types
def surface(
    volume: Volume,
    *,
    levels: GreyLevels | None = None,
    method: SurfaceMethod = "esf",
    edges: EdgeSettings | None = None,
    curvature_correction: bool = False,
    smallest_share: float = 0.01,
    layers: int = LAYERS,
    progress: Callable[[int, int], None] | None = None,
) -> Surface:
    """The surface between the material of `levels` and what is darker.

    levels:         grey levels; from the histogram unless given.
    method:         esf (blurred step fitted), local-50 (50 % between local plateaus), iso-50 (the start surface).
    edges:          search distance, window, contrast threshold, blur; `EdgeSettings()` unless given.
    smallest_share: pieces with less than this share of the largest one's area are dropped (noise).
    layers:         thickness of the slabs that are worked on at a time: memory, not result.

    Raises InputError for an empty surface or inverted contrast, EngineMissingError without VTK.
    """
    if method not in ("esf", "local-50", "iso-50"):
        raise InputError(f"method is {method!r}; 'esf', 'local-50' or 'iso-50' is needed")
    given = levels if levels is not None else grey_levels(volume)[-1]
    index, faces = contour(volume.values, given.threshold, slab_layers=layers)
    points, faces, dropped = main_components(volume.grid.points(index), faces, smallest_share)
    normals = _normals(volume, points, layers)
    faces = _outward(points, faces, normals)
    notes = (f"{dropped} pieces below {100 * smallest_share:g} % of the largest area dropped",) if dropped else ()
    n = len(points)
    start = Surface(
        points=points,
        faces=faces,
        normals=normals,
        offset=np.zeros(n),
        contrast=np.full(n, given.contrast),
        residual=np.full(n, np.nan),
        u=np.full(n, np.nan),
        flags=np.zeros(n, dtype=np.uint8),
        sigma=np.nan,
        levels=given,
        spacing=volume.grid.spacing,
        notes=notes,
        settings={"method": method},
    )
    if method == "iso-50":
        if curvature_correction:
            raise InputError("the curvature correction needs the blur, which iso-50 does not know; use esf or local-50")
        return start
    settings = replace(edges or EdgeSettings(), method=method)
    found = search_edges(volume, points, normals, settings, contrast=given.contrast, layers=layers, progress=progress)
    return _moved(volume, start, found, settings, curvature_correction, layers)


def surfaces(volume: Volume, *, materials: int, **options: Any) -> tuple[Surface, ...]:
    """One surface for each of several materials, darkest first, each against what is darker; options as `surface`."""
    return tuple(surface(volume, levels=levels, **options) for levels in grey_levels(volume, materials))


def _moved(volume: Volume, start: Surface, found: Edges, settings: EdgeSettings, correct: bool, layers: int) -> Surface:
    offset = np.where(found.good, found.offset, 0.0)
    points = start.points + offset[:, None] * start.normals
    if not found.good.any():
        raise InputError(f"no vertex of {len(start)} has a measurable edge: {_in_words(found)}")
    if correct:
        # 2 H sigma^2 / 2 towards the outside of the curve; H is positive where the material is convex.
        shift = found.sigma**2 * _curvatures(volume, points, layers)
        shift = np.where(found.good, shift, 0.0)
        points = points + shift[:, None] * start.normals
    contrast = found.inside - found.outside
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = found.residual / contrast
    return replace(
        start,
        points=points,
        offset=offset,
        contrast=contrast,
        residual=residual,
        u=found.u,
        flags=found.flags,
        sigma=found.sigma,
        corrected=correct,
        notes=(*start.notes, _in_words(found)),
        settings={
            "method": settings.method,
            "search_distance_voxel": settings.search_distance,
            "window_mm": found.window,
            "contrast_threshold": settings.contrast_threshold,
            "sigma_mm": found.sigma,
            "sigma_estimated": settings.sigma is None,
            "curvature_correction": correct,
        },
    )


def _in_words(found: Edges) -> str:
    counts = counts_in_words(found.flags)
    longer = f"; {found.longer} with longer plateaus" if found.longer else ""
    return f"{int(found.good.sum())} of {len(found.flags)} edges measured{longer}" + (f"; {counts}" if counts else "")


def _by_slab(volume: Volume, points: Array, reach: int, layers: int, function: Callable[..., Array]) -> Array:
    """function(values, index) over slabs of the volume, gathered in the points' order."""
    index = volume.grid.indices(points)
    out: Array | None = None
    n_z = volume.grid.shape[0]
    for z_0 in range(0, n_z, layers):
        rows = np.flatnonzero((index[:, 0] >= z_0) & (index[:, 0] < z_0 + layers))
        if not rows.size:
            continue
        low = max(z_0 - reach - 1, 0)
        part = np.ascontiguousarray(volume.values[low : z_0 + layers + reach + 1], dtype=np.float32)
        value = function(part, index[rows] - [low, 0, 0])
        if out is None:
            out = np.full((len(points), *value.shape[1:]), np.nan)
        out[rows] = value
    if out is None:
        raise InputError("no point lies within the volume")
    return out


def _normals(volume: Volume, points: Array, layers: int) -> Array:
    """Unit normals (n, 3) from bright to dark."""
    reach = int(np.ceil(GAUSS_REACH * NORMAL_SIGMA))
    gradient = _by_slab(volume, points, reach, layers, lambda v, i: smoothed_gradients(v, i, NORMAL_SIGMA))
    normal = -index_gradient_to_W(gradient, volume.grid.spacing)
    length = np.linalg.norm(normal, axis=1)
    normal[length == 0] = (0.0, 0.0, 1.0)
    return normal / np.where(length == 0, 1.0, length)[:, None]


def _curvatures(volume: Volume, points: Array, layers: int) -> Array:
    """Mean curvatures (n,), 1/mm, positive where the material is convex."""
    reach = int(np.ceil(GAUSS_REACH * CURVATURE_SIGMA))
    spacing = np.ascontiguousarray(volume.grid.spacing[::-1])
    return _by_slab(volume, points, reach, layers, lambda v, i: smoothed_curvatures(v, i, spacing, CURVATURE_SIGMA))


def _outward(points: Array, faces: np.ndarray, normals: Array) -> np.ndarray:
    """Triangles turned so that most agree with the normals: the engine turns all of them one way."""
    some = faces[:: max(len(faces) // 10000, 1)]
    a, b, c = (points[some[:, k]] for k in range(3))
    agree = np.einsum("ij,ij->i", np.cross(b - a, c - a), normals[some].sum(axis=1))
    return faces if np.sum(np.sign(agree)) >= 0 else faces[:, ::-1]


__all__ = ["EdgeFlag", "EdgeSettings", "GreyLevels", "Surface", "surface", "surfaces"]
