"""A fit at its optimum, linearised: what every check of a calibration looks at, whatever model was fitted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.tall import ByBall, Some, Table, WhiteRows
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class LinearFit:
    """n observed centres, m estimated coordinates: w_HT (3), t_HT (3), the balls (3 each), then whatever else is free.

    problem:      the rows that were used.
    r:            (n, 2) px, observed minus calculated.
    J:            (n, 2, m), derivatives of the calculated centres, px per unit; of very many centres of several balls
                  what of them is not zero.
    C:            (n, 2, 2) px^2, what the fit took as the covariance of a row, scatter of the poses included.
    W:            (n, 2, 2), whiteners of C.
    prior_rows:   (k, m) and prior_residuals (k,): priors and scale bars, in standard deviations.
    information:  (m, m), J^T C^-1 J with the priors.
    """

    problem: Problem
    r: Array
    J: Array | ByBall
    C: Array
    W: Array
    prior_rows: Array
    prior_residuals: Array
    information: Array

    @cached_property
    def r_white(self) -> Array:
        """(n, 2) residuals in standard deviations."""
        return (self.W @ self.r[:, :, None])[..., 0]

    def J_white(self, rows: Some = slice(None)) -> Array:
        """(k, 2, m) derivatives in standard deviations of some of the n centres."""
        if isinstance(self.J, ByBall):
            return np.asarray(self.W[rows] @ self.J[rows])
        every = self.rows[: 2 * len(self.J)]
        return np.asarray(every.reshape(self.J.shape)[rows])

    @property
    def J_mount(self) -> Array:
        """(n, 2, 6) by (w_HT, t_HT)."""
        if isinstance(self.J, ByBall):
            return np.concatenate([self.J.w_HT, self.J.t_HT], axis=2)
        return self.J[:, :, :6]

    @property
    def J_t_HT(self) -> Array:
        """(n, 2, 3) by t_HT."""
        return self.J.t_HT if isinstance(self.J, ByBall) else self.J[:, :, 3:6]

    @property
    def J_ball(self) -> Array:
        """(n, 2, 3) by the centre of the row's own ball."""
        if isinstance(self.J, ByBall):
            return self.J.own
        n, balls = len(self.J), len(self.problem.ball_ids)
        result: Array = self.J[:, :, 6 : 6 + 3 * balls].reshape(n, 2, balls, 3).sum(axis=2)
        return result

    @cached_property
    def rows(self) -> Table:
        """(2 n + k, m): centres and priors in standard deviations."""
        if isinstance(self.J, ByBall):
            return WhiteRows(W=self.W, J=self.J, priors=self.prior_rows, more=np.zeros((2 * len(self.J), 0)))
        n, m = len(self.J), self.J.shape[2]
        rows = np.empty((2 * n + len(self.prior_rows), m))
        np.matmul(self.W, self.J, out=rows[: 2 * n].reshape(n, 2, m))
        rows[2 * n :] = self.prior_rows
        return rows

    @cached_property
    def residuals(self) -> Array:
        """(2 n + k,): of the same rows."""
        return np.concatenate([self.r_white.ravel(), self.prior_residuals])

    def with_priors(self, columns: Array) -> Array:
        """(2 n + k, c): whitened columns (n, 2, c) of the centres, which no prior holds."""
        flat = columns.reshape(-1, columns.shape[2])
        return np.concatenate([flat, np.zeros((len(self.prior_rows), flat.shape[1]))])
