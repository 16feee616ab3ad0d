r"""How far a hexapod's file is to be believed: an average over the answers, weighted by their evidence.

The joints in hexapod.json may be the controller's own numbers, or those of a drawing that is off by per cents; only the
radiographs can say which, and in part.  Believed at once are three sizes of the file's error, SHARES of the stated
ones.  With theta_i, C_i the estimate under size i and w_i its share of the evidence,

    theta = sum_i w_i theta_i,   C = sum_i w_i (C_i + (theta_i - theta)(theta_i - theta)^T),

the mean and the covariance of the mixture of the three posteriors (Bayesian model averaging; Hoeting et al., Statist.
Sci. 14 (1999) 382).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.identified.map_estimate import MapEstimate, State, linearise, solve_map
from tomopose.errors import NotConvergedError
from tomopose.geometry.rotations import log_rotation
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.real_poses import ErrorModel
from tomopose.manipulator.run_effects import WithRunEffects
from tomopose.units import Array

SHARES = (0.04, 0.4, 1.0)
"""Of the stated scale_sigma and geometry_sigma: as good as right (0.2 % of the default 5 %), nearly right, as it is."""


def believed(model: ErrorModel | None, share: float) -> ErrorModel | None:
    """The same machine with its file's geometry doubted by that share of what it states; None where there is no such
    value."""
    if isinstance(model, (WithRunEffects, InverseManipulator)):
        inner = believed(model.machine, share)
        return None if inner is None else replace(model, machine=inner)
    if isinstance(model, Hexapod) and (model.scale_sigma or model.geometry_sigma):
        return replace(model, scale_sigma=share * model.scale_sigma, geometry_sigma=share * model.geometry_sigma)
    return None


def _step(origin: State, state: State) -> Array:
    """(m,): what moves `origin` to `state`, as in `State.moved`."""
    return np.concatenate(
        [
            log_rotation(state.T_HT.R @ origin.T_HT.R.T),
            state.T_HT.t - origin.T_HT.t,
            (state.balls - origin.balls).ravel(),
            state.delta - origin.delta,
            state.p - origin.p,
        ]
    )


def averaged(fit: ModelFit) -> ModelFit:
    """The fit with the estimate and covariance of the mixture; chi2, evidence and size stay those of the stated file.

    A fit without a doubted file is given back as it is.
    """
    stated = fit.estimate
    found: list[MapEstimate] = [stated]
    for share in SHARES[:-1]:
        model = believed(stated.problem.model, share)
        if model is None:
            return fit
        try:
            found.append(solve_map(replace(stated.problem, model=model), stated.state))
        except NotConvergedError:  # the file contradicts the data
            continue
    evidence = np.array([e.log_evidence for e in found])
    w = np.exp(evidence - evidence.max())
    w /= w.sum()
    steps = np.array([_step(stated.state, e.state) for e in found])
    mean: Array = w @ steps
    off = steps - mean
    covariance = np.einsum("i,ijk->jk", w, np.array([e.covariance for e in found])) + (w * off.T) @ off
    state = stated.state.moved(mean)
    return replace(
        fit, estimate=replace(stated, state=state, at=linearise(stated.problem, state), covariance=covariance)
    )
