"""Did everything stand still?  Drift, change points, repeated poses, and poses predicted without having been fitted.

The tests are score tests on the whitened residuals r of a fit with Jacobian J: an extra effect with columns C explains
g^T (C^T C - C^T Q Q^T C)^-1 g of chi2, g = C^T r, Q an orthonormal basis of J; no refit is needed.  Its significance is
an F test against what it leaves.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from scipy.special import fdtrc

from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.rigid.fit import Fit, blocks, jacobian, minimise, residuals
from tomopose.geometry.rotations import rotation_angle_between
from tomopose.units import Array

BLOCKS = 5
DRIFT_ORDER = 3
REPEATED_MM, REPEATED_RAD = 0.02, 2e-4
SIGNIFICANT = 1e-4
"""Probability below which an effect is called significant (for a change point, over all its places together)."""


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Something that moved.

    p: probability by chance, if the residuals are white;  size_px: rms change of the centres by it;
    share: of chi2 (for a drift, of what a constant offset leaves of it) that it explains;  words;
    at: pose_id of a sudden change.
    """

    name: str
    p: float
    size_px: float
    share: float
    words: str
    at: str = ""

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "p": self.p,
            "size_px": self.size_px,
            "share": self.share,
            "words": self.words,
            "at": self.at,
        }


@dataclass(frozen=True, kw_only=True)
class Integrity:
    """effects: drift and change points (significant or not);  repeats: pairs of poses taken twice, with the distance of
    their centres (px and standard deviations);  held_out_rms, fit_rms: px, blocked cross-validation beside the fit;
    held_out_chi2: mean squared prediction error in its own predicted standard deviations (1 where all is well)."""

    effects: tuple[Effect, ...]
    repeats: tuple[dict[str, Any], ...]
    held_out_rms: float
    held_out_chi2: float
    fit_rms: float

    @property
    def significant(self) -> tuple[Effect, ...]:
        return tuple(e for e in self.effects if e.p < SIGNIFICANT)

    def to_json(self) -> dict[str, Any]:
        return {
            "effects": [e.to_json() for e in self.effects],
            "repeats": list(self.repeats),
            "held_out_rms_px": self.held_out_rms,
            "held_out_chi2": self.held_out_chi2,
            "fit_rms_px": self.fit_rms,
        }


def elapsed(problem: Problem) -> Array:
    """(n,) time since the first image, s; the place in the sequence where no times are known."""
    if problem.time_utc is not None:
        try:
            t = np.array([datetime.fromisoformat(s).timestamp() for s in problem.time_utc])
        except ValueError:
            t = np.zeros(0)
        if t.size and np.ptp(t) > 0:
            return t - t.min()
    return np.arange(len(problem), dtype=np.float64)


def _without(C: Array, A: Array) -> Array:
    """What of the columns C (k, c) the columns A (k, a) cannot follow."""
    A = A / np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    return np.asarray(C - A @ np.linalg.lstsq(A, C, rcond=1e-10)[0], dtype=np.float64)


def drift(
    problem: Problem, Jw: Array, rw: Array, columns: Array, *, name: str, words: str, unit: tuple[float, str]
) -> Effect:
    """A slow change of the coordinates behind `columns` (n, 2, c), whitened derivatives: cubic in time, about a
    constant that is free.

    words: with {} for the largest distance between two moments of the run, given in unit (factor, name).
    """
    c = columns.shape[2]
    tau = elapsed(problem)
    course = np.polynomial.legendre.legvander(2.0 * tau / np.ptp(tau) - 1.0, DRIFT_ORDER)[:, 1:]
    C = (columns[:, :, None, :] * course[:, None, :, None]).reshape(-1, DRIFT_ORDER * c)
    known = np.concatenate([Jw.reshape(-1, Jw.shape[2]), columns.reshape(-1, c)], axis=1)
    rest = _without(rw.reshape(-1, 1), known)
    move = np.linalg.lstsq(_without(C, known), rest, rcond=1e-8)[0].ravel()
    after = _without(rest, np.concatenate([known, C], axis=1))
    before = float((rest**2).sum())
    left = float((after**2).sum())
    gain = before - left
    path = course @ move.reshape(DRIFT_ORDER, c)
    reach = float(np.linalg.norm(path[:, None] - path[None], axis=2).max())
    size = _size_px(problem, (C @ move).reshape(-1, 2))
    factor, symbol = unit
    return Effect(
        name=name,
        p=_p(gain, C.shape[1], left, rw.size - known.shape[1] - C.shape[1]),
        size_px=size,
        share=gain / max(before, 1e-300),
        words=f"{words.format(f'{reach * factor:.2g} {symbol}')} over the run, {size:.2g} px rms",
    )


def _p(gain: float, c: int, left: float, dof: int) -> float:
    """Probability by chance that c columns explain as much: an F test, so that what has moved hides neither in the
    offset that goes with it nor in a pose noise that was estimated from it."""
    if dof < 1:
        return 1.0
    return float(fdtrc(c, dof, max(gain, 0.0) / c / max(left / dof, 1e-300)))


def _share(explained: float, rw: Array) -> float:
    return explained / max(float((rw**2).sum()), 1e-300)


def _size_px(problem: Problem, whitened: Array) -> float:
    px = np.linalg.solve(problem.W, whitened[:, :, None])[..., 0]
    return float(np.sqrt((px**2).sum(axis=1).mean()))


def change_point(problem: Problem, Jw: Array, rw: Array, columns: Array, *, name: str, words: str) -> Effect | None:
    """The place where a sudden change of the coordinates behind `columns` (n, 2, c) explains most of chi2.

    Every place with at least c poses on both sides is tried; p counts all of them (Bonferroni).
    """
    n, c = len(problem), columns.shape[2]
    if n < 4 * c:
        return None
    Q = np.linalg.qr(Jw.reshape(-1, Jw.shape[2]))[0].reshape(n, 2, -1)

    def after(x: Array) -> Array:
        return np.cumsum(x[::-1], axis=0)[::-1]

    A = after(np.einsum("kia,kib->kab", columns, columns))
    B = after(np.einsum("kiq,kia->kqa", Q, columns))
    g = after(np.einsum("kia,ki->ka", columns, rw))
    M = A - np.swapaxes(B, 1, 2) @ B
    places = np.arange(c, n - c)
    d = np.sqrt(np.maximum(np.einsum("kaa->ka", A), 1e-300))
    Ms = M / d[:, :, None] / d[:, None, :]
    value, V = np.linalg.eigh(Ms[places])
    z = np.einsum("kab,ka->kb", V, g[places] / d[places])
    seen = value > 1e-6
    gain = (np.where(seen, z**2 / np.where(seen, value, 1.0), 0.0)).sum(axis=1)
    k = int(places[gain.argmax()])
    step = np.linalg.lstsq(M[k], g[k], rcond=1e-8)[0]
    late = columns * (np.arange(n) >= k)[:, None, None]
    size = _size_px(problem, late @ step)
    best = float(gain.max())
    p = _p(best, c, float((rw**2).sum()) - best, rw.size - Jw.shape[2] - c)
    return Effect(
        name=name,
        p=min(1.0, p * len(places)),
        size_px=size,
        share=_share(best, rw),
        words=f"{words} at pose {problem.pose_id[k]}: {size:.2g} px rms",
        at=problem.pose_id[k],
    )


def repeats(problem: Problem, scale: float) -> tuple[dict[str, Any], ...]:
    """The first pose against later images of the same pose: the check of closure."""
    same = (
        (np.linalg.norm(problem.t_MH - problem.t_MH[0], axis=1) < REPEATED_MM)
        & (rotation_angle_between(problem.R_MH[0], problem.R_MH) < REPEATED_RAD)
        & (problem.alpha == problem.alpha[0])
        & (problem.ball == problem.ball[0])
        & (problem.run == problem.run[0])
    )
    result = []
    for k in np.flatnonzero(same)[1:]:
        dx = problem.x_D[k] - problem.x_D[0]
        V = (problem.covariance[k] + problem.covariance[0]) * scale
        result.append(
            {
                "first": problem.pose_id[0],
                "again": problem.pose_id[k],
                "distance_px": float(np.linalg.norm(dx)),
                "sigmas": float(np.sqrt(dx @ np.linalg.solve(V, dx))),
            }
        )
    return tuple(result)


def blocked_cross_validation(
    problem: Problem, free: FreeParameters, fit: Fit, blocks_: int = BLOCKS
) -> tuple[float, float]:
    """(rms px, mean squared error in predicted standard deviations) of poses predicted by a fit without their block.

    The blocks are runs of neighbours in the sequence: what drifts or was set together is left out together.  nan where
    leaving a block out leaves too little.
    """
    n, m = len(problem), fit.N.shape[0]
    edges = np.linspace(0, n, blocks_ + 1).astype(int)
    squares, normalised = [], []
    for a, b in itertools.pairwise(edges):
        out = np.zeros(n, dtype=bool)
        out[a:b] = True
        if 2 * (~out).sum() <= m or len(np.unique(problem.ball[~out])) < len(problem.ball_ids):
            return float("nan"), float("nan")
        part = minimise(problem, free, fit, weight=(~out).astype(float), iterations=15)
        held = problem.select(out)
        at = blocks(held, free, part)
        J = jacobian(held, free, at)
        r = held.x_D - at.x_D
        V = held.covariance + J @ inverse_information(part.N) @ np.swapaxes(J, 1, 2)
        squares.append((r**2).sum(axis=1))
        normalised.append(np.einsum("ki,ki->k", r, np.linalg.solve(V, r[:, :, None])[..., 0]) / 2)
    return float(np.sqrt(np.concatenate(squares).mean())), float(np.concatenate(normalised).mean())


def movements(problem: Problem, free: FreeParameters, fit: Fit) -> tuple[Effect, ...]:
    """Drifts and change points, significant or not."""
    b = blocks(problem, free, fit)
    J, r = jacobian(problem, free, b), problem.x_D - b.x_D
    Jw, rw = problem.W @ J, (problem.W @ r[:, :, None])[..., 0]
    found = [
        drift(problem, Jw, rw, problem.W @ b.J_t_HT, name="drift", words="the ball drifts by {}", unit=(1000.0, "um")),
        drift(
            problem,
            Jw,
            rw,
            problem.W,
            name="image drift",
            words="the images drift by {} (focal spot or detector)",
            unit=(1.0, "px"),
        ),
        change_point(problem, Jw, rw, problem.W @ b.J_t, name="ball", words="the ball changed its place"),
        change_point(
            problem, Jw, rw, problem.W @ b.J_mount, name="mount", words="the mount changed (bumped or referenced anew)"
        ),
    ]
    return tuple(e for e in found if e is not None)


def chi2_with_movements(problem: Problem, free: FreeParameters, fit: Fit, moved: Iterable[Effect]) -> float:
    """chi2 of a fit that may also follow such movements: images off by a cubic of time, the ball or the mount
    elsewhere from the pose named on.  To first order; the priors' part stays."""
    b = blocks(problem, free, fit)
    Jw = (problem.W @ jacobian(problem, free, b)).reshape(2 * len(problem), -1)
    rw = (problem.W @ (problem.x_D - b.x_D)[:, :, None])[..., 0].ravel()
    tau = elapsed(problem) / max(float(elapsed(problem).max()), 1e-300)
    columns = [Jw]
    for e in moved:
        if e.at:
            late = np.arange(len(problem)) >= problem.pose_id.index(e.at)
            J_step = (b.J_t if e.name == "ball" else b.J_mount) * late[:, None, None]
            columns.append((problem.W @ J_step).reshape(len(rw), -1))
        else:
            columns += [(problem.W * (tau**k)[:, None, None]).reshape(len(rw), -1) for k in range(DRIFT_ORDER + 1)]
    rest = _without(rw[:, None], np.concatenate(columns, axis=1))
    return float((rest**2).sum() + (free.information * fit.delta**2).sum())


def _scale(rw: Array, m: int) -> float:
    return max(1.0, float((rw**2).sum()) / max(rw.size - m, 1))


def integrity(problem: Problem, free: FreeParameters, fit: Fit) -> Integrity:
    """All checks on the rows that were used."""
    r = residuals(problem, free, fit)
    rms, normalised = blocked_cross_validation(problem, free, fit)
    return Integrity(
        effects=movements(problem, free, fit),
        repeats=repeats(problem, _scale((problem.W @ r[:, :, None])[..., 0], fit.N.shape[0])),
        held_out_rms=rms,
        held_out_chi2=normalised,
        fit_rms=float(np.sqrt((r**2).sum(axis=1).mean())),
    )
