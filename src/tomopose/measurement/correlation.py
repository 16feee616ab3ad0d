"""How many independent points a fit really has: neighbours on a CT surface share voxels and so share their errors.

With a correlation rho(h) of the residuals at distance h, the mean of n points has the variance

    s^2 / n * (1 + mean over points of the sum of rho over their neighbours) = s^2 / n_eff.

A fit of p parameters takes about p / n_eff away from the correlation of its residuals at every distance; that is put
back.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array

SAMPLES, BINS, ROUNDS = 4000, 12, 5


def effective_number(points: Array, residuals: Array, correlation_range: float, parameters: int = 0) -> float:
    """n_eff of points (n, 3), mm, with residuals (n,) of a fit, looking at pairs up to `correlation_range`, mm.

    rho is estimated in bins of distance and taken as zero from its first bin that is not positive on.  0 for the range
    gives n.  The result lies between 1 and n.
    """
    from scipy.spatial import cKDTree

    n = len(points)
    if not (np.isfinite(correlation_range) and correlation_range >= 0):
        raise InputError(f"correlation_range is {correlation_range} mm; 0 or a positive length is needed")
    variance = float(np.mean(residuals**2))
    if correlation_range == 0 or variance == 0:
        return float(n)
    chosen = np.arange(0, n, max(n // SAMPLES, 1))
    tree = cKDTree(points)
    pairs: Any = tree.query_ball_point(points[chosen], correlation_range)
    first = np.repeat(chosen, [len(p) for p in pairs])
    second = np.concatenate([np.asarray(p, dtype=np.intp) for p in pairs])
    first, second = first[first != second], second[first != second]
    if first.size == 0:
        return float(n)
    h = np.linalg.norm(points[first] - points[second], axis=1)
    bin_of = np.minimum((h / correlation_range * BINS).astype(np.intp), BINS - 1)
    count = np.bincount(bin_of, minlength=BINS)
    product = np.bincount(bin_of, weights=residuals[first] * residuals[second], minlength=BINS)
    rho = np.divide(product, count * variance, out=np.zeros(BINS), where=count > 0)
    stops = np.flatnonzero((rho <= 0) & (count > 0))
    end = stops[0] if stops.size else BINS
    n_effective = float(n)
    for _ in range(ROUNDS):
        lost = parameters / n_effective
        inflation = 1.0 + float(np.sum((rho[:end] + lost) / (1.0 + lost) * count[:end])) / len(chosen)
        n_effective = float(np.clip(n / inflation, 1.0, n))
    return n_effective
