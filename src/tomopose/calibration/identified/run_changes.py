"""Did something change during the run?  A pivot that was set anew, a ball that slipped, a manipulator that was pushed.

For every possible moment the residuals after it are given extra freedom, linearised at the optimum: three numbers for a
new pivot (its change c shifts H against the base and M against the plate, t_HT += R_HT c, t -= c), three for the ball,
six for the mount.  The drop of chi2 at the best moment says whether, and which of them explains it most cheaply.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.errors import InputError
from tomopose.units import Array

FEWEST_AFTER = 5
FALSE_ALARM_DROP = 40.0
"""chi2 that a change must explain: 3 to 6 numbers at the best of some hundred moments gain less than 30 by chance in
10^4 runs; the rest is for residuals that are not quite normal."""
SMALLEST_PIVOT_MM = 0.02
"""Pivots are set by hand or by program, in numbers; less is drift."""
LEAST_SHARE = 0.5
"""Share of the excess chi2 (above dof) that a change must explain where other errors are about."""


@dataclass(frozen=True, kw_only=True)
class RunChange:
    """what: "pivot", "ball" or "mount"; first: index of the first pose after it; value: its numbers (mm, rad);
    drop: of chi2, by `value`."""

    what: str
    first: int
    value: Array
    drop: float


def find_change(fit: ModelFit) -> RunChange | None:
    """The change that explains most, or None where nothing explains enough."""
    e = fit.estimate
    n, nb = len(e.problem.poses), len(e.problem.data.ball_ids)
    if n < 4 * FEWEST_AFTER:
        return None
    W = whiteners(e.at.C)
    r = (W @ e.at.r[:, :, None])[..., 0]
    J = W @ e.at.J
    R = e.state.T_HT.R
    J_ball = J[:, :, 6 : 6 + 3 * nb].reshape(n, 2, nb, 3).sum(axis=2)
    extra = {"pivot": J[:, :, 3:6] @ R - J_ball, "ball": J_ball, "mount": J[:, :, :6]}
    excess = e.chi2 - e.dof
    found = [_best_moment(what, X, r, J, e.covariance) for what, X in extra.items()]
    # the fewest numbers win unless more explain clearly more
    best = max(found, key=lambda c: c.drop - 10.0 * len(c.value))
    return best if best.drop > FALSE_ALARM_DROP and best.drop > LEAST_SHARE * excess else None


def _best_moment(what: str, X: Array, r: Array, J: Array, covariance: Array) -> RunChange:
    """The moment at which extra columns X (n, 2, c), switched on from there, lower chi2 most."""
    n, c = len(X), X.shape[2]
    JX = np.cumsum(np.einsum("nim,nic->nmc", J, X)[::-1], axis=0)[::-1]
    XX = np.cumsum(np.einsum("nia,nic->nac", X, X)[::-1], axis=0)[::-1]
    Xr = np.cumsum(np.einsum("nic,ni->nc", X, r)[::-1], axis=0)[::-1]
    moments = np.arange(FEWEST_AFTER, n - FEWEST_AFTER)
    # at the optimum J^T r + prior = 0, so that X^T r needs no correction; the information of X is what J leaves of it
    A = XX[moments] - np.einsum("nma,mk,nkc->nac", JX[moments], covariance, JX[moments])
    level = np.einsum("naa->na", XX[moments]).max(axis=1)[:, None, None] * 1e-9 * np.eye(c)
    value = np.linalg.solve(A + level, Xr[moments][:, :, None])[..., 0]
    drop = np.einsum("nc,nc->n", value, Xr[moments])
    k = int(np.argmax(drop))
    return RunChange(what=what, first=int(moments[k]), value=value[k], drop=float(drop[k]))


def change_in_words(fit: ModelFit, change: RunChange) -> str:
    """A sentence for the verdict."""
    pose = fit.estimate.problem.data.pose_id[change.first]
    size = ", ".join(f"{x:.3f}" for x in change.value[-3:])
    words = {
        "pivot": f"the pivot changed by ({size}) mm",
        "ball": f"the ball moved by ({size}) mm in its holder",
        "mount": f"the manipulator moved by ({size}) mm on the table, or drifted",
    }
    return (
        f"something changed during the run: from pose {pose!r} on {words[change.what]} (chi2 falls by "
        f"{change.drop:.0f} if that is allowed for)"
    )


def require_same_pivot(fit: ModelFit, change: RunChange | None) -> None:
    """InputError, naming the pose, where the residuals show that another pivot was set during the run.

    Smaller changes, and those of ball or mount (which a slow drift resembles), are for the verdict.
    """
    if change is None or change.what != "pivot" or np.linalg.norm(change.value) < SMALLEST_PIVOT_MM:
        return
    raise InputError(
        f"{change_in_words(fit, change)}; its poses belong to two different frames H: calibrate the parts before and "
        "after it separately"
    )
