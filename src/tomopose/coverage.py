"""One rule of coverage for the whole package: from standard uncertainties to intervals.

A standard uncertainty u with nu degrees of freedom has the expanded uncertainty U = t_p(nu) u with Student's factor for
the probability p = 0.95 (JCGM 100:2008, G.3 and table G.2); with nu unknown or large that is 1.96 u.  Shares of a sum
are combined as root of the sum of squares, and their degrees of freedom by Welch and Satterthwaite (G.4).

Files state `expanded_uncertainty_k2`: two standard uncertainties, where the degrees of freedom are so many that
Student's factor is 2 within its own uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

PROBABILITY = 0.95
"""Probability with which an interval holds the truth."""
K2 = 2.0
"""Coverage factor of quantities that are stated with k = 2 by name."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation: 1 / Phi^-1(3/4) (P. J. Huber, Robust
Statistics (1981), sec. 5.1)."""
NORMAL_MEDIAN = 0.455
"""Median of the square of a standard normal variable: Phi^-1(3/4)^2."""


def coverage_factor(dof: float = math.inf, probability: float = PROBABILITY) -> float:
    """Student's factor for a two-sided interval.  dof: degrees of freedom, > 0; inf gives the normal distribution's."""
    from scipy.special import ndtri, stdtrit

    if not dof > 0:
        return math.nan
    p = 0.5 + probability / 2
    return float(ndtri(p)) if math.isinf(dof) else float(stdtrit(dof, p))


def expanded(u: float, dof: float = math.inf) -> float:
    """Half width of the 95 % interval of a standard uncertainty u; nan where u is not finite or has no freedom."""
    return coverage_factor(dof) * u if math.isfinite(u) else math.nan


def expanded_k2(u: float) -> float:
    """Two standard uncertainties, as the keys that end in `_k2` and the columns headed k = 2 state."""
    return K2 * u


def combined(shares: Iterable[tuple[float, float]]) -> tuple[float, float]:
    """(u, dof) of a sum of independent shares (u_i, dof_i), by Welch and Satterthwaite (JCGM 100:2008, G.4)."""
    known = [(u, dof) for u, dof in shares if u != 0.0]
    if not known:
        return 0.0, math.inf
    if len(known) == 1:
        return known[0]
    u = math.hypot(*(u_i for u_i, _ in known))
    weight = sum(u_i**4 / dof_i for u_i, dof_i in known)
    return u, u**4 / weight if weight > 0 else math.inf
