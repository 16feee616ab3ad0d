"""How many independent points a fit really has: neighbours on a CT surface share voxels and so share their errors.

With the covariance C of the errors and derivatives J that change little from point to point, the parameters of a fit
have the covariance s^2 L (J' J)^-1, where L is the number of points that act as one, L = n / n_eff:

    s^2 L = 1/n sum over i, j of C_ij.

The sum is taken over the residuals r = (1 - H) e, H = J (J' J)^-1 J', of pairs closer than a window.  The fit takes
L H out of C, so that with K, the sum of H over the same pairs,

    E sum r_i r_j = s^2 L (n - K),        E sum r_i^2 = s^2 (n - L p).

Interpolation between voxels makes neighbours further off differ (rho < 0), which belongs to the sum too: the window is
never shorter than a share of the range, and grows until it holds several times the points that act as one.

Points with weights w of mean 1, as for the areas that they represent, count by them: s^2 L = 1/n sum w_i w_j C_ij, with
w_i w_j in the sums of r_i r_j, w_i in that of r_i^2, and H of the weighted fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tomopose.errors import InputError
from tomopose.units import Array

SAMPLES, BINS = 8000, 24
SHORTEST = 0.4
"""Share of the range below which the window does not fall: 2.5 voxels where the range is 6."""
HOLDS = 4.0
"""The window holds this many times the points that act as one."""
LEFT = 0.3
"""Share of the points' freedom, (n - K) / n, that a window must leave to be used."""


@dataclass(frozen=True, kw_only=True)
class Independence:
    """variance: s^2 L, that of one point times the points that act as one, in the residuals' unit squared;
    n_effective: n / L; dof: degrees of freedom of the variance."""

    variance: float
    n_effective: float
    dof: float


def independence(
    points: Array, residuals: Array, derivatives: Array, correlation_range: float, weight: Array | None = None
) -> Independence:
    """Independence of the errors of points (n, 3), mm, with residuals (k, n) of a fit with derivatives (k, n, p).

    k: residuals a point has (two for a line in space).  correlation_range: mm, up to which neighbours may act as one;
    0 takes all points as independent.  weight: (n,) of mean 1, 1 unless given; residuals and derivatives are already
    times its root.
    """
    if not (np.isfinite(correlation_range) and correlation_range >= 0):
        raise InputError(f"correlation_range is {correlation_range} mm; 0 or a positive length is needed")
    k, n = residuals.shape
    p = derivatives.shape[2]
    total = float(np.sum(residuals**2))
    if k * n <= p:
        return Independence(variance=np.inf, n_effective=float(n), dof=0.0)
    w = np.ones(n) if weight is None else weight
    least = float(np.mean(w**2))
    alone = Independence(variance=least * total / (k * n - p), n_effective=n / least, dof=float(k * n - p))
    if correlation_range == 0 or total == 0:
        return alone
    count, product, taken = _sums(points, residuals, derivatives, correlation_range, np.sqrt(w))
    # Cumulative over the bins of distance: neighbours a point has, sum of r_i r_j, sum of H.
    usable = np.flatnonzero(n * k - taken > LEFT * n * k)
    if not usable.size:
        return alone
    with np.errstate(divide="ignore", invalid="ignore"):
        acting = product * k * n / (total * (k * n - taken) + product * p)
    wide = np.arange(len(count)) + 1 >= SHORTEST * len(count)
    enough = usable[wide[usable] & (count[usable] >= HOLDS * acting[usable])]
    window = int(enough[0]) if enough.size else int(usable[-1])
    # A point never represents less than itself.
    L = float(np.clip(acting[window], least, n)) if np.isfinite(acting[window]) else least
    freedom = k * n - L * p
    if freedom <= 0:
        return Independence(variance=np.inf, n_effective=n / L, dof=0.0)
    # Each window full of points gives L once.
    dof = max(min(k * n / float(count[window]), k * n - p), 1.0)
    return Independence(variance=L * total / freedom, n_effective=n / L, dof=dof)


def _sums(points: Array, residuals: Array, derivatives: Array, reach: float, root: Array) -> tuple[Array, Array, Array]:
    """Cumulative over BINS of distance up to reach: points within it (mean), sums of r_i r_j and of H_ij over pairs,
    each times the root (n,) of both weights.

    Large sets are summed over every few points' neighbours, and scaled.
    """
    from scipy.spatial import cKDTree

    k, n, p = derivatives.shape
    Q = np.linalg.qr(derivatives.reshape(k * n, p))[0].reshape(k, n, p)
    chosen = np.arange(0, n, -(-n // SAMPLES))
    pairs: Any = cKDTree(points[chosen]).sparse_distance_matrix(cKDTree(points), reach, output_type="ndarray")
    first, second = chosen[pairs["i"]], pairs["j"]
    other = first != second
    first, second, h = first[other], second[other], pairs["v"][other]
    bin_of = np.minimum((h / reach * BINS).astype(np.intp), BINS - 1)
    scale = n / len(chosen)
    count = 1.0 + np.cumsum(np.bincount(bin_of, minlength=BINS)) / len(chosen)
    residuals, Q = residuals * root, Q * root[:, None]
    product = np.full(BINS, float(np.sum(residuals**2)))
    taken = np.full(BINS, float(np.sum(Q**2)))
    for r, q in zip(residuals, Q, strict=True):
        product += scale * np.cumsum(np.bincount(bin_of, weights=r[first] * r[second], minlength=BINS))
        shared = np.einsum("ij,ij->i", q[first], q[second])
        taken += scale * np.cumsum(np.bincount(bin_of, weights=shared, minlength=BINS))
    return count, product, taken
