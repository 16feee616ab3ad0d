"""A stated or default standard deviation that the images contradict beside the manipulator's own errors.

The same rule as `rigid.contradiction`, but judged with the errors of the manipulator in the model: those of a machine
that is trusted pull scanner values that are right.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.calibration.identified.map_estimate import MapEstimate, solve_map
from tomopose.calibration.rigid.contradiction import (
    DETERMINED,
    GAIN,
    MOST,
    Contradicted,
    pulled,
    widened,
)
from tomopose.errors import NotConvergedError


def contradicted_beside_errors(estimate: MapEstimate) -> tuple[MapEstimate, tuple[Contradicted, ...]]:
    """The estimate with wider priors where the images contradict them, the likeliest one after the other."""
    found: list[Contradicted] = []
    for _ in range(MOST):
        free = estimate.problem.free
        tried: list[MapEstimate] = []
        indices: list[int] = []
        for j in pulled(free, estimate.state.delta):
            try:
                other = solve_map(replace(estimate.problem, free=widened(free, j)), estimate.state)
            except NotConvergedError:
                continue
            at = 6 + estimate.state.balls.size + j
            if np.sqrt(other.covariance[at, at]) < DETERMINED * other.problem.free.sigma[j]:
                tried.append(other)
                indices.append(j)
        if not tried:
            break
        best = int(np.argmin([other.chi2 for other in tried]))
        other, j = tried[best], indices[best]
        # residuals of a cause that no model here holds are no evidence against a scanner value
        if estimate.chi2 - other.chi2 < GAIN * max(1.0, other.chi2 / max(other.dof, 1)):
            break
        found.append(Contradicted(name=free.names[j], stated=float(free.sigma[j]), off=float(other.state.delta[j])))
        estimate = other
    return estimate, tuple(found)
