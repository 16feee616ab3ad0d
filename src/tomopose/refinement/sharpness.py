"""How sharp the volume's edges are under both geometries: what a correction has won where it matters."""

from __future__ import annotations

import numpy as np
import scipy.ndimage
import scipy.optimize
import scipy.special

from tomopose.errors import EngineMissingError, InputError
from tomopose.measurement.surface.surface import surface
from tomopose.units import Array
from tomopose.volume import Volume

REACH = 4.0
"""Voxels on both sides of an edge: wider than the blur of views that are off by two voxels."""
MOST_LINES = 5000
"""Lines across the surface, evenly from its vertices: their mean profile is right to a hundredth of its blur."""
NONE = float("nan")


def edge_blurs_mm(before: Volume, after: Volume) -> tuple[float, float]:
    """Standard deviation, mm, of the blurred step in the mean profile across the edges of both volumes.

    The lines are the same in both: normals of the surface of `after` (measurement/surface) where an edge was measured,
    so that an edge which is blurred, doubled or somewhere else in `before` counts there.  Voxels and smoothing are part
    of the blur of both.  NaN where `after` has no measurable edge or a profile no step, or where VTK is not installed.
    """
    try:
        edges = surface(after)
    except (EngineMissingError, InputError):
        return NONE, NONE
    rows = np.flatnonzero(edges.good)
    rows = rows[:: max(len(rows) // MOST_LINES, 1)]
    s = float(np.min(after.grid.spacing)) * np.arange(-REACH, REACH + 0.25, 0.5)
    x = edges.points[rows, None] + s[:, None] * edges.normals[rows, None]
    return _blur(before, x, s), _blur(after, x, s)


def _blur(volume: Volume, x: Array, s: Array) -> float:
    """sigma of b + (a - b) Phi(-(s - s_0) / sigma) in the mean over lines of points x (m, len(s), 3), mm in W."""
    index = volume.grid.indices(x)
    grey = scipy.ndimage.map_coordinates(volume.values, np.moveaxis(index, -1, 0), order=3, mode="nearest").mean(axis=0)
    contrast = float(grey[0] - grey[-1])
    if not contrast > 0:
        return NONE

    def step(s: Array, a: float, b: float, s_0: float, sigma: float) -> Array:
        return np.asarray(b + (a - b) * scipy.special.ndtr(-(s - s_0) / sigma))

    start = (grey[0], grey[-1], 0.0, (s[-1] - s[0]) / 8)
    limits = ([-np.inf, -np.inf, s[0], 1e-3 * s[-1]], [np.inf, np.inf, s[-1], 2 * s[-1]])
    found, _ = scipy.optimize.curve_fit(step, s, grey, p0=start, bounds=limits)
    return float(found[3])
