r"""The plate's scatter beside identified errors: a posterior with the maker's repeatability as prior, never a test.

`fit.with_scatter` raises the scatter where chi2 demands it.  Where chi2 does not, the residuals still leave room for
more than the maker states, or for less.  With f the factor on the stated variance, V_k = C_k + f S_k the covariance of
a centre, and the fit linear about its optimum, the restricted likelihood of f (Patterson and Thompson, Biometrika 58
(1971) 545) and the prior of `rigid.pose_noise` on sqrt(f) give the mean of f that is stated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.identified.map_estimate import MapEstimate, linear_fit, solve_map
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.calibration.rigid.pose_noise import scatter_prior
from tomopose.errors import NotConvergedError
from tomopose.units import Array

GRID = np.concatenate([[0.0], np.geomspace(0.1, 6.0, 13)])
"""Values of sqrt(f) that the posterior is summed over: from a machine ten times better than its data sheet to one whose
scatter chi2 would have shown."""


def with_posterior_scatter(fit: ModelFit) -> ModelFit:
    """The fit with the mean of the posterior as its scatter, where chi2 did not raise it."""
    estimate = fit.estimate
    problem = estimate.problem
    if problem.scatter != 1.0 or not problem.repeatability.variance.any() or estimate.dof < 1:
        return fit
    f = posterior_factor(estimate)
    try:
        found = solve_map(replace(problem, scatter=f), estimate.state)
    except NotConvergedError:
        return fit
    return replace(fit, estimate=found, whole=replace(fit.whole, scatter=f))


def posterior_factor(estimate: MapEstimate) -> float:
    """Mean of the factor on the variance of the stated repeatability, given a fit with the factor 1."""
    linear = linear_fit(estimate)
    quiet = linear_fit(replace(estimate, problem=replace(estimate.problem, scatter=0.0)))
    S = linear.C - quiet.C
    L = np.array([_minus_2_log(quiet.C + q**2 * S, linear.J[:], linear.r, linear.prior_rows, linear.prior_residuals)
                  for q in GRID])  # fmt: skip
    weight = np.gradient(GRID) * scatter_prior(GRID) * np.exp(-0.5 * (L - L.min()))
    return float((weight * GRID**2).sum() / weight.sum())


def _minus_2_log(V: Array, J: Array, r: Array, rows: Array, rest: Array) -> float:
    """-2 log of the restricted likelihood, up to a constant; rows (k, m), rest (k,): the priors in their sigmas."""
    W = whiteners(V)
    A = np.concatenate([(W @ J).reshape(-1, J.shape[2]), rows])
    z = np.concatenate([(W @ r[:, :, None]).ravel(), rest])
    N, g = A.T @ A, A.T @ z
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    N, g = N * scale[:, None] * scale, g * scale
    log_V = -2.0 * float(np.log(W[:, 0, 0] * W[:, 1, 1]).sum())
    return log_V + float(np.linalg.slogdet(N)[1] - 2.0 * np.log(scale).sum() + z @ z - g @ np.linalg.solve(N, g))
