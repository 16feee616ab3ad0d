r"""Poses predicted without having been fitted: blocked cross-validation in closed form, for every model.

Without block b the optimum moves to theta - S_b A_b^T r_b, S_b = (Sigma^-1 - A_b^T A_b)^-1, with A_b and r_b the
whitened rows of the block: exact where the prediction is linear over that move, which is small beside the poses'
travel.  The held-out rows are then missed by (1 + A_b S_b A_b^T) r_b, whose covariance is the bracket itself.
The blocks are runs of neighbours in the sequence: what drifts or was set together is left out together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tomopose.calibration.checks.score_tests.score import in_pixels
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.units import Array

BLOCKS = 7
"""A seventh of a run is long beside what two neighbours share, and leaves six sevenths to predict from."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """rms: px, distance of the held-out centres from their predictions.  chi2: mean square of the misses in predicted
    standard deviations, 1 where the model holds all there is.  log_predictive: of the held-out centres.
    All are NaN where leaving a block out leaves too little."""

    rms: float
    chi2: float
    log_predictive: float


def blocks_of(n: int, ball: NDArray[np.int64], blocks: int = BLOCKS) -> list[NDArray[np.int64]]:
    """Index arrays of at most `blocks` runs of neighbouring poses, such that every ball keeps rows outside each."""
    parts = np.array_split(np.arange(n), min(blocks, n))
    whole = len(np.unique(ball))
    return [part for part in parts if len(np.unique(np.delete(ball, part))) == whole]


def _flat(A: Array) -> Array:
    """(2 k, m): rows (k, 2, m), one after the other."""
    return A.reshape(-1, A.shape[2])


def _gram(A: Array) -> Array:
    """(m, m): the inner products of the columns of A (k, m)."""
    return np.asarray(A.T @ A)


def held_out(fit: LinearFit) -> HeldOut:
    """Cross-validate a fit on the rows that it used."""
    n, m = len(fit.problem), fit.J.shape[2]
    parts = blocks_of(n, fit.problem.ball)
    fewest = 2 * (n - max((len(part) for part in parts), default=n)) + len(fit.prior_rows)
    if fewest <= m:
        return HeldOut(rms=float("nan"), chi2=float("nan"), log_predictive=float("nan"))
    r, W = fit.r_white, fit.W
    log_predictive, chi2 = float(np.sum(np.log(np.einsum("nii->ni", W)))), 0.0
    scale = 1.0 / np.sqrt(np.maximum(np.diag(fit.information), 1e-300))
    information = fit.information * scale[:, None] * scale
    gram = np.array([_gram(_flat(fit.J_white(part))) for part in parts]) * scale[:, None] * scale
    # V = I + A_b S_b A_b' has as many rows as the block; what is needed of it has as many as there are parameters.
    value, axes = np.linalg.eigh(information - gram)
    seen = value > 1e-14 * np.abs(value).max(axis=1, keepdims=True)
    root = axes * np.where(seen, 1.0 / np.sqrt(np.where(seen, value, 1.0)), 0.0)[:, None, :]
    log_det = np.linalg.slogdet(np.eye(m) + np.swapaxes(root, 1, 2) @ gram @ root)[1]
    missed = []
    for part, S in zip(parts, scale[:, None] * root, strict=True):
        A_b, r_b = _flat(fit.J_white(part)), r[part].ravel()
        missed.append(r_b + A_b @ (S @ (S.T @ (A_b.T @ r_b))))
        chi2 += float(r_b @ missed[-1])
    log_predictive -= 0.5 * (chi2 + float(log_det.sum()))
    rows = np.concatenate(parts)
    squares, count = float((in_pixels(W[rows], np.concatenate(missed).reshape(-1, 2)) ** 2).sum()), len(rows)
    return HeldOut(
        rms=float(np.sqrt(squares / max(count, 1))), chi2=chi2 / max(2 * count, 1), log_predictive=log_predictive
    )
