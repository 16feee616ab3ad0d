"""Did everything stand still?  Drift, change points, repeated poses, and poses predicted without having been fitted.

The tests are score tests on the whitened residuals r of a fit with Jacobian J: an extra effect with columns C explains
g^T (C^T C - C^T Q Q^T C)^-1 g of chi2, g = C^T r, Q an orthonormal basis of J; no refit is needed.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from scipy.special import chdtrc

from tomopose.calibration.fit import Fit, blocks, jacobian, minimise
from tomopose.calibration.parameters import FreeParameters
from tomopose.calibration.problem import Problem
from tomopose.calibration.uncertainty import inverse_information
from tomopose.geometry.rotations import rotation_angle_between
from tomopose.units import Array

BLOCKS = 5
REPEATED_MM, REPEATED_RAD = 0.02, 2e-4
SIGNIFICANT = 1e-4
"""Probability below which an effect is called significant (for a change point, over all its places together)."""


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Something that moved.

    p: probability by chance, if the residuals are white;  size_px: rms change of the centres by it;
    share: of chi2 that it explains;  words;  at: pose_id of a sudden change.
    """

    name: str
    p: float
    size_px: float
    share: float
    words: str
    at: str = ""

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name, "p": self.p, "size_px": self.size_px, "share": self.share, "words": self.words,
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
            "effects": [e.to_json() for e in self.effects], "repeats": list(self.repeats),
            "held_out_rms_px": self.held_out_rms, "held_out_chi2": self.held_out_chi2, "fit_rms_px": self.fit_rms,
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


def drift(problem: Problem, Jw: Array, rw: Array, columns: Array, scale: float, *, name: str, words: str,
          unit: tuple[float, str]) -> Effect:
    """A slow change, linear in time, of the coordinates behind `columns` (n, 2, c), whitened derivatives.

    words: with {} for the change over the whole run, given in unit (factor, name).
    """
    c = columns.shape[2]
    tau = elapsed(problem)
    tau = (tau - tau.mean()) / np.ptp(tau)
    C = (columns * tau[:, None, None]).reshape(-1, c)
    Q, _ = np.linalg.qr(Jw.reshape(-1, Jw.shape[2]))
    C_free = C - Q @ (Q.T @ C)
    move, *_ = np.linalg.lstsq(C_free, rw.ravel(), rcond=1e-8)
    gain = float((C_free @ move) @ rw.ravel()) / scale
    size = _size_px(problem, (C @ move).reshape(-1, 2))
    factor, symbol = unit
    return Effect(
        name=name, p=float(chdtrc(c, max(gain, 0.0))), size_px=size, share=_share(gain * scale, rw),
        words=f"{words.format(f'{float(np.linalg.norm(move)) * factor:.2g} {symbol}')} over the run, {size:.2g} px rms",
    )


def _share(explained: float, rw: Array) -> float:
    return explained / max(float((rw**2).sum()), 1e-300)


def _size_px(problem: Problem, whitened: Array) -> float:
    px = np.linalg.solve(problem.W, whitened[:, :, None])[..., 0]
    return float(np.sqrt((px**2).sum(axis=1).mean()))


def change_point(problem: Problem, Jw: Array, rw: Array, columns: Array, scale: float, *, name: str,
                 words: str) -> Effect | None:
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
    gain = (np.where(seen, z**2 / np.where(seen, value, 1.0), 0.0)).sum(axis=1) / scale
    k = int(places[gain.argmax()])
    step = np.linalg.lstsq(M[k], g[k], rcond=1e-8)[0]
    late = columns * (np.arange(n) >= k)[:, None, None]
    size = _size_px(problem, late @ step)
    return Effect(
        name=name, p=float(min(1.0, chdtrc(c, float(gain.max())) * len(places))), size_px=size,
        share=_share(float(gain.max()) * scale, rw),
        words=f"{words} at pose {problem.pose_id[k]}: {size:.2g} px rms", at=problem.pose_id[k],
    )


def repeats(problem: Problem, scale: float) -> tuple[dict[str, Any], ...]:
    """The first pose against later images of the same pose: the check of closure."""
    same = (
        (np.linalg.norm(problem.t_MH - problem.t_MH[0], axis=1) < REPEATED_MM)
        & (rotation_angle_between(problem.R_MH[0], problem.R_MH) < REPEATED_RAD)
        & (problem.alpha == problem.alpha[0]) & (problem.ball == problem.ball[0]) & (problem.run == problem.run[0])
    )
    result = []
    for k in np.flatnonzero(same)[1:]:
        dx = problem.x_D[k] - problem.x_D[0]
        V = (problem.covariance[k] + problem.covariance[0]) * scale
        result.append({
            "first": problem.pose_id[0], "again": problem.pose_id[k], "distance_px": float(np.linalg.norm(dx)),
            "sigmas": float(np.sqrt(dx @ np.linalg.solve(V, dx))),
        })
    return tuple(result)


def blocked_cross_validation(problem: Problem, free: FreeParameters, fit: Fit,
                             blocks_: int = BLOCKS) -> tuple[float, float]:
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


def integrity(problem: Problem, free: FreeParameters, fit: Fit) -> Integrity:
    """All checks on the rows that were used."""
    b = blocks(problem, free, fit)
    J = jacobian(problem, free, b)
    r = problem.x_D - b.x_D
    Jw, rw = problem.W @ J, (problem.W @ r[:, :, None])[..., 0]
    scale = max(1.0, float((rw**2).sum()) / max(2 * len(problem) - J.shape[2], 1))
    found = [
        drift(problem, Jw, rw, problem.W @ b.J_t_HT, scale, name="drift", words="the ball drifts by {}",
              unit=(1000.0, "um")),
        drift(problem, Jw, rw, problem.W, scale, name="image drift",
              words="the images drift by {} (focal spot or detector)", unit=(1.0, "px")),
        change_point(problem, Jw, rw, problem.W @ b.J_t, scale, name="ball", words="the ball changed its place"),
        change_point(problem, Jw, rw, problem.W @ b.J_mount, scale, name="mount",
                     words="the mount changed (bumped or referenced anew)"),
    ]
    rms, normalised = blocked_cross_validation(problem, free, fit)
    return Integrity(
        effects=tuple(e for e in found if e is not None),
        repeats=repeats(problem, scale),
        held_out_rms=rms,
        held_out_chi2=normalised,
        fit_rms=float(np.sqrt((r**2).sum(axis=1).mean())),
    )
