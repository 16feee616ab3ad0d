"""How far out the background is to be believed: the fit held against itself on smaller rings.

A background of level, slope and curvature is an approximation that gets worse with distance, while every shell of
pixels makes the centre surer.  Of two rings, one in the other, the larger gives the centre with covariance C, the
smaller with C', and if the model holds on both, their difference D has the covariance C' - C (J. A. Hausman,
Econometrica 46 (1978) 1251).  Where D is larger, the smaller ring is taken.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tomopose.detection.rim_fit.cholesky import solve
from tomopose.detection.rim_fit.model import SHELL_EDGES, SHELLS
from tomopose.detection.rim_fit.rim import Rim
from tomopose.units import Array

IMPLAUSIBLE = 4.0
"""Chi-square of D by its two degrees of freedom from which a ring is too large: by chance in 2 % of images."""
REMAINING = 0.5
"""Share of D D' that is added to the covariance of the smaller ring, for what its own background leaves out."""


def nearer(rim: Rim, active: npt.NDArray[np.intp], *, careful: bool, noise: float) -> Array:
    """Leaves the rim fitted on the largest ring that agrees with those inside it; (2, 2) to add to the covariance.

    noise: variance of a sum of pixels over that of as many independent ones, for correlated noise.
    """
    sizes = [n for n in range(1, SHELLS + 1) if n == 1 or rim.outside > SHELL_EDGES[n - 2]]
    if len(sizes) == 1:
        return np.zeros((2, 2))
    blocks = rim.blocks(0, 1)
    steps, covariances = [], []
    unit = np.eye(active.size, 3)
    for n in sizes:
        if n > 1:
            blocks = blocks + rim.blocks(n - 1, n)
        N, unit[:, 2] = rim.with_priors(*rim.sum_of(blocks), active)
        X = solve(N, unit)
        steps.append(X[:2, 2])
        covariances.append((X[:2, :2] + X[:2, :2].T) / 2)
    chosen = len(sizes) - 1
    while chosen > 0:
        D = np.array(steps[:chosen]) - steps[chosen]
        C = np.array(covariances[:chosen]) - covariances[chosen]
        if max(_chi2(*pair) for pair in zip(D, C, strict=True)) < IMPLAUSIBLE * noise:
            break
        chosen -= 1
    if chosen == len(sizes) - 1:
        rim.keep(blocks)
        return np.zeros((2, 2))
    rim.use_shells(sizes[chosen])
    rim.polish(active, careful=careful)
    move = steps[chosen] - steps[chosen + 1]
    return np.asarray(REMAINING * np.outer(move, move))


def _chi2(D: Array, C: Array) -> float:
    """Of D (2,) with covariance C, by its degrees of freedom; 0 where C is not positive."""
    (x, y), ((xx, xy), (_, yy)) = D.tolist(), C.tolist()
    determinant = xx * yy - xy * xy
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / determinant / 2 if xx > 0 and determinant > 0 else 0.0
