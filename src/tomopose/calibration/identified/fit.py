"""One model, fitted honestly: rows that do not belong set aside, scatter and size of the errors taken from the data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from tomopose.calibration.identified.contradiction import contradicted_beside_errors
from tomopose.calibration.identified.map_estimate import KinematicProblem, MapEstimate, State, linearise, solve_map
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.calibration.model.covariance import WIDENING_PROBABILITY
from tomopose.calibration.rigid.contradiction import Contradicted
from tomopose.calibration.rigid.outliers import LARGEST_SHARE, MEDIAN_CHI2_2, RECLASSIFICATIONS, limit
from tomopose.errors import NotConvergedError
from tomopose.manipulator.pose_map import PoseMap
from tomopose.manipulator.run_effects import WithRunEffects
from tomopose.units import Array

SCATTER_STEPS = 12
SCATTER_TOLERANCE = 0.02
LARGEST_SCATTER = 1e10
SOFTENINGS = (1.0, 1e2, 1e4, 1e6)
REWEIGHTINGS = 15
GROSS = 8.0
"""Times the median residual of the start: rows beyond it are no positioning errors of the same machine, and stay out of
the first fit; what belongs comes back."""
SIZE_STEPS = 8
SMALLEST_SIZE, LARGEST_SIZE = 1e-3, 30.0
DETERMINED, LEAST_KNOWN_SHARE = 0.5, 0.5
"""Errors of a group that the data must determine before its size is taken from them; the share of a map's turns that
must be, for a size of their own."""
SIZE_GAIN = 3.0
"""Natural log units of evidence that another size of the errors must gain over the stated one to be believed."""


@dataclass(frozen=True, kw_only=True)
class ModelFit:
    """A model's optimum and how it was reached.

    keep (n,) bool: rows used, of all rows.  distance2 (n,): squared studentised residuals of all rows.
    whole: the problem of all rows, with the scatter and the sizes that were found.
    size: largest factor on the stated standard deviations of the errors.
    contradicted: scanner values that were freed because the images contradict what was assumed of them.
    misfit: more rows fail than may be outliers, and none was set aside.
    """

    estimate: MapEstimate
    keep: Any
    distance2: Array
    whole: KinematicProblem
    size: float = 1.0
    misfit: bool = False
    contradicted: tuple[Contradicted, ...] = ()

    @property
    def scatter(self) -> float:
        return self.estimate.problem.scatter


def distances(estimate: MapEstimate, whole: KinematicProblem, keep: npt.NDArray[np.bool_]) -> Array:
    """(n,) squared residuals of all rows in their own predicted standard deviations; rows not kept are predictions."""
    at = linearise(replace(whole, weight=None), estimate.state)
    W = whiteners(at.C)
    WJ = W @ at.J
    spread = WJ @ estimate.covariance @ np.swapaxes(WJ, 1, 2)
    value, Q = np.linalg.eigh(np.eye(2) + np.where(keep[:, None, None], -spread, spread))
    z = (np.swapaxes(Q, 1, 2) @ (W @ at.r[:, :, None]))[..., 0]
    d2: Array = (z**2 / np.maximum(value, 0.01)).sum(axis=1)
    return d2


def solve_softened(problem: KinematicProblem, start: State) -> MapEstimate:
    """The optimum; where none is reached because the model misfits grossly, that with the scatter raised.

    Residuals of hundreds of standard deviations drag the errors along the curved valleys in which they replace one
    another; a scatter of the residuals' size lets the priors hold them.
    """
    for soften in SOFTENINGS[:-1]:
        try:
            return solve_map(replace(problem, scatter=problem.scatter * soften), start)
        except NotConvergedError:
            continue
    return solve_map(replace(problem, scatter=problem.scatter * SOFTENINGS[-1]), start)


def with_scatter(estimate: MapEstimate) -> MapEstimate:
    """The estimate with the plate's scatter raised until chi2 is what right covariances leave; never below the stated.

    PoseScatter is raised only where chi2 lies above the value exceeded once in a hundred runs.
    """
    f, best = estimate.problem.scatter, estimate
    if best.dof <= 0 or not best.problem.repeatability.variance.any():
        return best
    if f <= 1.0 and best.chi2 <= chdtri(best.dof, WIDENING_PROBABILITY):
        return best
    low, high = 1.0, np.inf
    for _ in range(SCATTER_STEPS):
        ratio = best.chi2 / best.dof
        if abs(ratio - 1) < SCATTER_TOLERANCE or (ratio < 1 and f <= 1.0):
            break
        low, high = (max(low, f), high) if ratio > 1 else (low, min(high, f))
        guess = f * ratio**1.5 if ratio > 1 else max(f * ratio**1.5, 1.0)
        f = guess if low < guess < high else (np.sqrt(low * high) if np.isfinite(high) else f * 4)
        if f > LARGEST_SCATTER or high / low < 1.0 + SCATTER_TOLERANCE:
            break
        try:
            best = solve_map(replace(best.problem, scatter=f), best.state)
        except NotConvergedError:
            low, f = f, best.problem.scatter
            if high / low < 1.0 + SCATTER_TOLERANCE:
                break
    return best


def with_size(estimate: MapEstimate) -> tuple[MapEstimate, float]:
    """(estimate, largest factor): with the priors' sizes from the data where that is clearly better than the stated.

    MacKay's rule for each group of errors that one cause makes: s^2 = sum (p/sigma)^2 / gamma, gamma the number of
    errors of the group that the data determine.  A map's sizes and those of a run's effects are nowhere stated, so they
    are always taken; a map's turns keep their proportion to the shifts of the same group where the data do not
    determine them.
    """
    model = estimate.problem.model
    if model is None or not (model.groups >= 0).any():
        return estimate, 1.0
    group, m = model.groups, len(model.names)
    mine = group >= 0
    members = np.bincount(group[mine])
    sizes, now = np.ones(len(members)), estimate
    for _ in range(SIZE_STEPS):
        sigma = now.problem.prior_sigma[-m:]
        known = 1 - np.diag(now.covariance)[-m:] / sigma**2
        gamma = np.bincount(group[mine], known[mine])
        found = np.sqrt(np.bincount(group[mine], (now.state.p / sigma)[mine] ** 2) / np.maximum(gamma, 1e-9))
        change = np.where(gamma > DETERMINED, found, 1.0)
        if isinstance(model, PoseMap):
            half = model.group_count
            change[:half] = np.where(gamma[:half] > LEAST_KNOWN_SHARE * members[:half], change[:half], change[half:])
        change = np.clip(sizes * change, SMALLEST_SIZE, LARGEST_SIZE) / sizes
        if np.abs(np.log(change)).max() < 0.1:
            break
        sizes = sizes * change
        now = solve_map(replace(now.problem, model=model.resized(sizes)), now.state)
    if isinstance(model, (PoseMap, WithRunEffects)):
        return now, 1.0
    taken = now.log_evidence > estimate.log_evidence + SIZE_GAIN
    return (now, float(sizes.max())) if taken else (estimate, 1.0)


def fit_model(
    problem: KinematicProblem,
    start: State,
    *,
    robust: bool = True,
    keep: npt.NDArray[np.bool_] | None = None,
    widen: bool = False,
) -> ModelFit:
    """The optimum of a model from a start, with scatter and size from the data.

    keep: (n,) rows to use; without it those that belong are found (robust) or all are used.
    widen: free scanner values whose priors the images contradict.
    """
    n = len(problem.poses)
    given = keep is not None
    keep = np.asarray(keep) if given else np.ones(n, dtype=bool)
    misfit = False
    if robust and not given:
        estimate, keep, misfit = _robust(problem, start)
    else:
        estimate = solve_softened(problem if keep.all() else problem.rows(keep), start)
    estimate, against = contradicted_beside_errors(estimate) if widen else (estimate, ())
    scattered = with_scatter(estimate)
    estimate, size = with_size(scattered)
    if estimate is not scattered:
        # scatter found beside errors of another size is another: what looked like scatter may have been larger errors
        estimate = with_scatter(estimate)
        if size > 1.0 and estimate.problem.scatter > 1.0:
            quiet = with_scatter(solve_softened(replace(estimate.problem, scatter=1.0), estimate.state))
            estimate = max(estimate, quiet, key=lambda e: e.log_evidence)
    last = estimate.problem
    whole = replace(problem, scatter=last.scatter, model=last.model, free=last.free)
    return ModelFit(
        estimate=estimate,
        keep=keep,
        distance2=distances(estimate, whole, keep),
        whole=whole,
        size=size,
        misfit=misfit,
        contradicted=against,
    )


def _scale(d2: Array) -> float:
    return float(np.median(d2) / MEDIAN_CHI2_2)


def _robust(problem: KinematicProblem, start: State) -> tuple[MapEstimate, Any, bool]:
    """(fit of the rows that belong, which, False), or (fit of all, all, True) where no few outliers explain the
    misfit."""
    n = len(problem.poses)
    everything = np.ones(n, dtype=bool)
    d = np.linalg.norm(linearise(problem, start).r, axis=1)
    keep = d <= GROSS * np.median(d)
    if keep.mean() < 1.0 - LARGEST_SHARE or not _every_ball(problem, keep):
        keep = everything
    estimate = solve_softened(problem if keep.all() else problem.rows(keep), start)
    softened = replace(problem, scatter=estimate.problem.scatter)
    d2 = distances(estimate, softened, keep)
    if d2.max() <= limit(n) * max(1.0, _scale(d2)):
        return (estimate if keep.all() else solve_map(softened, estimate.state)), everything, False
    state = estimate.state
    weight = _weights(d2)
    for _ in range(REWEIGHTINGS):
        estimate = solve_map(replace(softened, weight=weight), state)
        state = estimate.state
        W = whiteners(estimate.at.C * weight[:, None, None])
        d2 = ((W @ estimate.at.r[:, :, None])[..., 0] ** 2).sum(axis=1)
        new = _weights(d2)
        settled = np.abs(new - weight).max() < 1e-2
        weight = new
        if settled:
            break
    keep = d2 <= limit(n) * max(1.0, _scale(d2))
    for _ in range(RECLASSIFICATIONS):
        if keep.mean() < 1.0 - LARGEST_SHARE or not _every_ball(softened, keep):
            break
        estimate = solve_map(problem.rows(keep), state)
        d2 = distances(estimate, softened, keep)
        new_keep = d2 <= limit(n) * max(1.0, _scale(d2[keep]))
        if (new_keep == keep).all():
            return estimate, keep, False
        keep, state = new_keep, estimate.state
    return solve_softened(problem, start), everything, True


def _weights(d2: Array) -> Array:
    """Geman-McClure's, whose influence falls to zero; the floor keeps every covariance finite."""
    return np.maximum((1.0 + d2 / (9.0 * max(1.0, _scale(d2)))) ** -2, 1e-12)


def _every_ball(problem: KinematicProblem, keep: npt.NDArray[np.bool_]) -> bool:
    return len(np.unique(problem.data.ball[keep])) == len(problem.data.ball_ids)
