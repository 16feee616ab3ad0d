r"""The standard's poses along a whole path together with what all views share.

Unknown are the pose of every view, the standard's coordinates about their calibrated values, and the scanner's values
about the stated ones, each with its standard uncertainty as prior:

    min  sum_jk |W_jk (x_jk - x(s, T_j, b_k))|^2  +  |(b - b_cal) / sigma_b|^2  +  |(s - s_given) / sigma_s|^2

by Gauss-Newton; the poses are eliminated view by view (Schur complement), so that the work grows linearly with them.
With exact coordinates and an exact scanner this is the view-by-view solution of ref. [8].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.arrangements.multi_sphere.view_pose import moved_by, poses_of_views, view_rows
from tomopose.calibration.model.assumed import Assumed
from tomopose.calibration.model.ball_projection import whiteners
from tomopose.errors import NotConvergedError
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array
from tomopose.values import value

STEPS = 40
STILL = 1e-4
"""Largest step, in standard uncertainties, at which the solution has come to rest."""
EXACT_MM = 1e-6
"""A coordinate that is stated as exact is held to a nanometre."""
WITHOUT_EFFECT = ("d_SR", "eta", "axis_y", "axis_tilt_x", "axis_tilt_y")
"""Scanner values that a free pose in every view takes up whole: they move no image."""


@value
class BallView:
    """One view: ball (k,) indices into the standard, x_D (k, 2) px, covariance (k, 2, 2) px^2."""

    ball: np.ndarray
    x_D: Array
    covariance: Array


@value
class SharedValues:
    """What all views share: names of the scanner's values that are estimated, and the covariance (3m + q, 3m + q) of
    the standard's coordinates (mm) and of these."""

    scanner_names: tuple[str, ...]
    covariance: Array


@value
class PathSolution:
    """scanner, centres (m, 3) mm in M: as estimated.  T_MW: n poses.  covariance: (n, 6, 6) of (w, t), rad and mm, of
    each view alone.  gain: (n, 6, 3m + q): how a pose follows what the views share.  residuals: px, per view (k, 2).
    """

    scanner: Scanner
    centres: Array
    T_MW: tuple[RigidTransform, ...]
    covariance: Array
    gain: Array
    shared: SharedValues
    residuals: tuple[Array, ...]
    chi2: float
    dof: int


def freed_of(assumed: Sequence[Assumed]) -> tuple[Assumed, ...]:
    """The assumed values that are estimated along a path: those that move an image and are not exact."""
    return tuple(a for a in assumed if a.sigma > 0 and a.name not in WITHOUT_EFFECT)


def solve_path(
    scanner: Scanner,
    views: Sequence[BallView],
    calibrated: Array,
    starts: Sequence[RigidTransform],
    *,
    sigma: Array,
    freed: Sequence[Assumed] = (),
    bars: Mapping[tuple[int, int], tuple[float, float]] | None = None,
) -> PathSolution:
    """The whole path.

    calibrated: (m, 3) mm, with the standard uncertainty `sigma` (m,) mm of each coordinate.  starts: a pose near each
    view's.  freed: the scanner's values that are estimated, with their priors.  bars: (ball, ball) -> (distance,
    standard uncertainty), mm.

    Raises NotConvergedError where no optimum is reached.
    """
    names = tuple(a.name for a in freed)
    given = np.array([getattr(scanner, n) for n in names])
    m, q = len(calibrated), len(names)
    prior = np.concatenate([np.repeat(np.maximum(sigma, EXACT_MM), 3), [a.sigma for a in freed]])
    T, centres, largest = list(starts), calibrated.copy(), np.inf
    for _ in range(STEPS):
        off = np.concatenate([(centres - calibrated).ravel(), np.array([getattr(scanner, n) for n in names]) - given])
        S, g = np.diag(1 / prior**2), -off / prior**2
        chi2 = float(np.sum((off / prior) ** 2))
        for (a, b), (length, u) in (bars or {}).items():
            row, miss = _bar_row(centres, a, b, length, len(prior))
            S += np.outer(row, row) / u**2
            g += row * miss / u**2
            chi2 += (miss / u) ** 2
        parts, residuals = [], []
        for view, T_j in zip(views, T, strict=True):
            part = _view_part(scanner, view, T_j, centres, names, 3 * m + q)
            S += part.S
            g += part.g
            chi2 += part.chi2
            parts.append(part)
            residuals.append(part.residuals)
        C = np.asarray(np.linalg.inv(S), dtype=np.float64)
        if largest < STILL:
            return PathSolution(
                scanner=scanner,
                centres=centres,
                T_MW=tuple(T),
                covariance=np.array([np.linalg.inv(p.N) for p in parts]),
                gain=np.array([-np.linalg.solve(p.N, p.NB) for p in parts]),
                shared=SharedValues(scanner_names=names, covariance=C),
                residuals=tuple(residuals),
                chi2=chi2,
                dof=2 * sum(len(v.ball) for v in views) - 6 * len(views) + len(bars or {}),
            )
        step = C @ g
        centres = centres + step[: 3 * m].reshape(m, 3)
        for name, change in zip(names, step[3 * m :], strict=True):
            scanner = replace(scanner, **{name: getattr(scanner, name) + float(change)})
        largest = float(np.abs(step / np.sqrt(np.diag(C))).max()) if len(step) else 0.0
        for j, p in enumerate(parts):
            turn = np.linalg.solve(p.N, p.Nz - p.NB @ step)
            T[j] = moved_by(T[j], turn)
            largest = max(largest, float(np.abs(turn * np.sqrt(np.diag(p.N))).max()))
    raise NotConvergedError(
        f"the path still moves by {largest:.3g} standard uncertainties after {STEPS} steps; check the ids of the balls"
    )


@dataclass(frozen=True, kw_only=True)
class _ViewPart:
    """One view in the normal equations: N (6, 6), NB (6, s), Nz (6,); S and g: what it adds for the shared values."""

    N: Array
    NB: Array
    Nz: Array
    S: Array
    g: Array
    chi2: float
    residuals: Array


def _view_part(
    scanner: Scanner, view: BallView, T: RigidTransform, centres: Array, names: Sequence[str], size: int
) -> _ViewPart:
    W = whiteners(view.covariance)
    x, J, J_b, J_s = view_rows(scanner, T, centres[view.ball], names)
    r = view.x_D - x
    z = (W @ r[:, :, None]).ravel()
    A = (W @ J).reshape(-1, 6)
    B = np.zeros((len(view.ball), 2, size))
    for i, ball in enumerate(view.ball):
        B[i, :, 3 * ball : 3 * ball + 3] = W[i] @ J_b[i]
    B[:, :, size - len(names) :] = W @ J_s
    flat = B.reshape(-1, size)
    N, NB, Nz = A.T @ A, A.T @ flat, A.T @ z
    away = np.linalg.solve(N, np.column_stack([NB, Nz]))
    return _ViewPart(
        N=N, NB=NB, Nz=Nz, S=flat.T @ flat - NB.T @ away[:, :-1], g=flat.T @ z - NB.T @ away[:, -1],
        chi2=float(z @ z), residuals=r,
    )  # fmt: skip


def _bar_row(centres: Array, a: int, b: int, length: float, size: int) -> tuple[Array, float]:
    """(derivative (size,) of the distance of two balls by all shared values, what is missing to its length, mm)."""
    d = centres[a] - centres[b]
    found = float(np.linalg.norm(d))
    row = np.zeros(size)
    row[3 * a : 3 * a + 3], row[3 * b : 3 * b + 3] = d / found, -d / found
    return row, length - found


def self_calibrated_balls(
    scanner: Scanner,
    views: Sequence[Array],
    balls: Array,
    *,
    covariance: Sequence[Array] | None = None,
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    ball_sigma: float = 1.0,
) -> PathSolution:
    """The coordinates of an object that is not calibrated, from coarse ones (m, 3), and its pose in every view.

    views: centres (m, 2) px, NaN where a ball is not seen.  covariance: (m, 2, 2) px^2 of each view, or None: 1 px.
    distances: (row, row) -> (distance, standard uncertainty), mm; ball_sigma: mm, how far the coarse coordinates may be
    off.  Without a distance the object's size is known only as well as ball_sigma: radiographs of one scanner position
    do not distinguish a large object far away from a small one near.
    """
    balls = np.array(balls, dtype=np.float64)
    starts = [p.T_MW for p in poses_of_views(scanner, views, balls, covariance=covariance)]
    rows = []
    for k, view in enumerate(views):
        x = np.asarray(view, dtype=np.float64)
        seen = np.flatnonzero(np.isfinite(x).all(axis=1))
        C = np.tile(np.eye(2), (len(seen), 1, 1)) if covariance is None else np.asarray(covariance[k])[seen]
        rows.append(BallView(ball=seen, x_D=x[seen], covariance=C))
    return solve_path(scanner, rows, balls, starts, sigma=np.full(len(balls), ball_sigma), bars=distances)
