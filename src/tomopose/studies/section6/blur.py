"""The blur of a volume, found once and used for all that is measured in it."""

from __future__ import annotations

from tomopose.measurement.probing import probe
from tomopose.units import Array
from tomopose.volume import Volume

MOST_POINTS = 3000


def blur_of(volume: Volume, points: Array, normals: Array, search_mm: float) -> float:
    """Standard deviation, mm, of the blur of the edges at points (n, 3) with normals (n, 3), mm in W."""
    step = max(len(points) // MOST_POINTS, 1)
    return float(probe(volume, points[::step], normals[::step], search_mm=search_mm).edges.sigma)
