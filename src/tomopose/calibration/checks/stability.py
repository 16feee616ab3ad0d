"""Did everything keep its place?  Drift, change points, repeated poses, and poses predicted without having been fitted.

The tests are score tests on the whitened residuals r of a fit with Jacobian J: an extra effect with columns C explains
g^T (C^T C - C^T Q Q^T C)^-1 g of chi2, g = C^T r, Q an orthonormal basis of J; no refit is needed.  Its significance is
an F test against what it leaves.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import comb

import numpy as np
import numpy.typing as npt
from scipy.special import fdtrc

from tomopose.calibration.checks.cross_validation import held_out
from tomopose.calibration.checks.score_tests.score import Beside, best_step, in_pixels, step_at
from tomopose.calibration.model.linear_fit import LinearFit
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.calibration.model.problem import Problem, elapsed
from tomopose.calibration.rigid.fit import Fit, linear_fit
from tomopose.geometry.extent import largest_distance
from tomopose.geometry.rotations import rotation_angle_between
from tomopose.units import Array
from tomopose.values import value

DRIFT_ORDER = 3
REPEATED_MM, REPEATED_RAD = 0.02, 2e-4
SIGNIFICANT = 1e-4
"""Probability below which an effect is called significant (for a change point, over all its places together)."""


@value
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


@value
class RepeatedPose:
    """A pose taken again: the distance of its two centres in px and in standard deviations."""

    first: str
    again: str
    distance_px: float
    sigmas: float


@value
class OutlierBlock:
    """A run of neighbouring poses, `first` to `last`, whose centres were all set aside; p: probability by chance."""

    first: str
    last: str
    count: int
    p: float


@value
class Stability:
    """effects: drift and change points (significant or not);  repeats: poses taken twice, set aside or not;
    block: the longest run of poses set aside;  held_out_rms, fit_rms: px, blocked cross-validation beside the fit;
    held_out_chi2: mean squared prediction error in its own predicted standard deviations (1 where all is well)."""

    effects: tuple[Effect, ...]
    repeats: tuple[RepeatedPose, ...]
    held_out_rms: float
    held_out_chi2: float
    fit_rms: float
    block: OutlierBlock | None = None

    @property
    def significant(self) -> tuple[Effect, ...]:
        return tuple(e for e in self.effects if e.p < SIGNIFICANT)


def drift(fit: LinearFit, beside: Beside, columns: Array, *, name: str, words: str, unit: tuple[float, str]) -> Effect:
    """A slow change of the coordinates behind `columns` (n, 2, c), whitened derivatives: cubic in time, about a
    constant that is free.

    beside: the rows of the fit;  words: with {} for the largest distance between two moments of the run, given in unit
    (factor, name).
    """
    c = columns.shape[2]
    tau = elapsed(fit.problem)
    course = np.polynomial.legendre.legvander(2.0 * tau / np.ptp(tau) - 1.0, DRIFT_ORDER)[:, 1:]
    moved = (columns[:, :, None, :] * course[:, None, :, None]).reshape(len(columns), 2, DRIFT_ORDER * c)
    constant = _new_directions(beside.without(columns.reshape(-1, c)), columns)
    rest = beside.rest - constant @ (constant.T @ beside.rest)
    C = beside.without(moved.reshape(-1, DRIFT_ORDER * c))
    U, s, Vt = np.linalg.svd(C - constant @ (constant.T @ C), full_matrices=False)
    seen = s > 1e-8 * s[0]
    along = U[:, seen].T @ rest
    move = Vt[seen].T @ (along / s[seen])
    before, gain = float(rest @ rest), float(along @ along)
    reach = largest_distance(course @ move.reshape(DRIFT_ORDER, c))
    size = _size_px(fit, moved @ move)
    factor, symbol = unit
    known = fit.rows.shape[1] + c
    return Effect(
        name=name,
        p=_p(gain, len(move), before - gain, len(rest) - known - len(move)),
        size_px=size,
        share=gain / max(before, 1e-300),
        words=f"{words.format(f'{reach * factor:.2g} {symbol}')} over the run, {size:.2g} px rms",
    )


def _new_directions(left: Array, columns: Array) -> Array:
    """(k, q): an orthonormal basis of what is left (k, c) of columns (n, 2, c) beside a fit that may hold them."""
    U, s, _ = np.linalg.svd(left / np.maximum(np.linalg.norm(columns, axis=(0, 1)), 1e-300), full_matrices=False)
    return np.asarray(U[:, s > 1e-9])


def _p(gain: float, c: int, left: float, dof: int) -> float:
    """Probability by chance that c columns explain as much: an F test, so that what has moved hides neither in the
    offset that goes with it nor in a pose noise that was estimated from it."""
    if dof < 1:
        return 1.0
    return float(fdtrc(c, dof, max(gain, 0.0) / c / max(left / dof, 1e-300)))


def _size_px(fit: LinearFit, moved: Array) -> float:
    return float(np.sqrt((in_pixels(fit.W, moved) ** 2).sum(axis=1).mean()))


def change_point(fit: LinearFit, beside: Beside, columns: Array, *, name: str, words: str) -> Effect | None:
    """The place where a sudden change of the coordinates behind `columns` (n, 2, c) explains most of chi2.

    Every place with at least c poses on both sides is tried; p counts all of them (Bonferroni).
    """
    n, c = len(fit.problem), columns.shape[2]
    if n < 4 * c:
        return None
    places = np.arange(c, n - c)
    k, best, _ = best_step(columns, beside, places)
    step = step_at(columns, beside, k)
    late = columns * (np.arange(n) >= k)[:, None, None]
    size, before = _size_px(fit, late @ step), beside.chi2
    p = _p(best, c, before - best, len(beside.rest) - fit.J.shape[2] - c)
    return Effect(
        name=name,
        p=min(1.0, p * len(places)),
        size_px=size,
        share=best / max(before, 1e-300),
        words=f"{words} at pose {fit.problem.pose_id[k]} by ({', '.join(f'{x:.3f}' for x in step[-3:])}) mm: "
        f"{size:.2g} px rms",
        at=fit.problem.pose_id[k],
    )


def repeats(problem: Problem, scale: float) -> tuple[RepeatedPose, ...]:
    """The first pose against later images of the same pose: the check of closure."""
    there = np.flatnonzero(
        (np.linalg.norm(problem.t_MH - problem.t_MH[0], axis=1) < REPEATED_MM)
        & (problem.alpha == problem.alpha[0])
        & (problem.ball == problem.ball[0])
        & (problem.run == problem.run[0])
    )
    same = there[rotation_angle_between(problem.R_MH[0], problem.R_MH[there]) < REPEATED_RAD]
    result = []
    for k in same[1:]:
        dx = problem.x_D[k] - problem.x_D[0]
        V = (problem.covariance[k] + problem.covariance[0]) * scale
        result.append(
            RepeatedPose(
                first=problem.pose_id[0],
                again=problem.pose_id[k],
                distance_px=float(np.linalg.norm(dx)),
                sigmas=float(np.sqrt(dx @ np.linalg.solve(V, dx))),
            )
        )
    return tuple(result)


def outlier_block(pose_id: tuple[str, ...], keep: npt.NDArray[np.bool_]) -> OutlierBlock | None:
    """The longest run of at least two neighbours set aside among n rows, keep (n,) bool; None where there is no such
    value.

    p bounds the probability that k outliers, thrown among n rows by chance, hold a run of that length L anywhere:
    (n - L + 1) C(n - L, k - L) / C(n, k).
    """
    out = ~np.asarray(keep, dtype=bool)
    n, k = len(out), int(out.sum())
    edges = np.flatnonzero(np.diff(np.concatenate([[0], out.astype(int), [0]])))
    runs = edges.reshape(-1, 2)
    if not len(runs):
        return None
    first, stop = (int(x) for x in runs[np.argmax(runs[:, 1] - runs[:, 0])])
    length = stop - first
    if length < 2:
        return None
    p = min(1.0, (n - length + 1) * comb(n - length, k - length) / comb(n, k))
    return OutlierBlock(first=pose_id[first], last=pose_id[stop - 1], count=length, p=p)


def movements_of(fit: LinearFit, R_HT: Array) -> tuple[Effect, ...]:
    """Drifts and change points, significant or not.  R_HT (3, 3): rotation of the mount."""
    W, beside = fit.W, Beside.of(fit.rows, fit.residuals)
    found = [
        drift(fit, beside, W @ fit.J_t_HT, name="drift", words="the ball drifts by {}", unit=(1000.0, "um")),
        drift(
            fit,
            beside,
            W,
            name="image drift",
            words="the images drift by {} (focal spot or detector)",
            unit=(1.0, "px"),
        ),
        *(change_point(fit, beside, W @ J, name=name, words=words) for name, words, J in _steps(fit, R_HT)),
    ]
    return tuple(e for e in found if e is not None)


def _steps(fit: LinearFit, R_HT: Array) -> tuple[tuple[str, str, Array], ...]:
    """(name, words, columns (n, 2, c)) of what may change from one pose to the next.

    A new pivot that is off by c shifts H against the base and M against the plate: t_HT += R_HT c, t -= c.
    """
    return (
        ("ball", "the ball changed its place", fit.J_ball),
        ("pivot", "the pivot of the controller changed", fit.J_t_HT @ R_HT - fit.J_ball),
        ("mount", "the mount changed (bumped or referenced anew)", fit.J_mount),
    )


def movements(problem: Problem, free: FreeParameters, fit: Fit) -> tuple[Effect, ...]:
    """Drifts and change points of a rigid fit."""
    return movements_of(linear_fit(problem, free, fit), fit.R_HT)


def chi2_with_movements(problem: Problem, free: FreeParameters, fit: Fit, moved: Iterable[Effect]) -> float:
    """chi2 of a fit that may also follow such movements: images off by a cubic of time, the ball, the pivot or the
    mount elsewhere from the pose named on.  To first order; the priors' part stays."""
    at = linear_fit(problem, free, fit)
    n = len(problem)
    tau = elapsed(problem) / max(float(elapsed(problem).max()), 1e-300)
    steps = {name: J for name, _, J in _steps(at, fit.R_HT)}
    columns = [at.J_white().reshape(2 * n, -1)]
    for e in moved:
        if e.at:
            late = np.arange(n) >= problem.pose_id.index(e.at)
            columns.append((at.W @ (steps[e.name] * late[:, None, None])).reshape(2 * n, -1))
        else:
            columns += [(at.W * (tau**k)[:, None, None]).reshape(2 * n, -1) for k in range(DRIFT_ORDER + 1)]
    rest = Beside.of(np.concatenate(columns, axis=1), at.r_white.ravel())
    return float(rest.chi2 + (free.information * fit.delta**2).sum())


def stability(fit: LinearFit, R_HT: Array, everything: Problem, keep: npt.NDArray[np.bool_]) -> Stability:
    """All checks of a fit, whatever its model.  everything, keep (n,) bool: all rows, and those that the fit used."""
    left_out = held_out(fit)
    d2 = (fit.r_white**2).sum()
    return Stability(
        effects=movements_of(fit, R_HT),
        repeats=repeats(everything, max(1.0, float(d2) / max(fit.r.size - fit.J.shape[2], 1))),
        held_out_rms=left_out.rms,
        held_out_chi2=left_out.chi2,
        fit_rms=float(np.sqrt((fit.r**2).sum(axis=1).mean())),
        block=outlier_block(everything.pose_id, keep),
    )
