"""Several balls or ball positions in one solve: known distances, and ids that were mixed up.

Every `ball_id` has its own unknown centre t in M; a ball remounted on another extension is another id.  Known distances
between balls enter as observations (`KinematicProblem.bars`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomopose.calibration.identified.fit import ModelFit
from tomopose.calibration.identified.map_estimate import KinematicProblem, linearise
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.calibration.rigid.outliers import limit
from tomopose.errors import InputError
from tomopose.units import Array

SWAP_GAIN = 0.05
"""Another ball explains a centre when its squared residual is below this share of that of the ball it is said to be."""


def residuals_by_ball(fit: ModelFit, problem: KinematicProblem) -> Array:
    """(n, balls): squared residuals, in standard deviations, of every row if it were each ball."""
    columns = []
    n = len(problem.poses)
    whole = replace(problem, model=fit.estimate.problem.model, scatter=fit.scatter, weight=None)
    for ball in range(len(problem.data.ball_ids)):
        data = replace(problem.data, ball=np.full(n, ball, dtype=np.int64))
        at = linearise(replace(whole, data=data), fit.estimate.state)
        columns.append(((whiteners(at.C) @ at.r[:, :, None])[..., 0] ** 2).sum(axis=1))
    return np.stack(columns, axis=1)


def swapped_rows(fit: ModelFit, problem: KinematicProblem) -> list[tuple[str, int, int]]:
    """(pose id, its ball id, the ball id that explains it) of rows that another ball explains far better."""
    ids = problem.data.ball_ids
    if len(ids) < 2:
        return []
    d2 = residuals_by_ball(fit, problem)
    n = len(d2)
    own = d2[np.arange(n), problem.data.ball]
    best = np.argmin(d2, axis=1)
    scale = max(1.0, float(np.median(own[fit.keep])) / (2 * np.log(2)))
    wrong = (best != problem.data.ball) & (own > limit(n) * scale) & (d2[np.arange(n), best] < SWAP_GAIN * own)
    return [(problem.data.pose_id[k], ids[int(problem.data.ball[k])], ids[int(best[k])]) for k in np.flatnonzero(wrong)]


def require_balls_not_swapped(fit: ModelFit, problem: KinematicProblem) -> None:
    """InputError, naming the poses, where observed centres belong to another ball than the table says."""
    rows = swapped_rows(fit, problem)
    if rows:
        told = "; ".join(f"pose {p!r} is said to show ball {a} and shows ball {b}" for p, a, b in rows[:5])
        raise InputError(
            f"{len(rows)} of {len(problem.poses)} centres belong to another ball than the pose table's ball_id says: "
            f"{told}{' ...' if len(rows) > 5 else ''}; correct ball_id and calibrate again"
        )
