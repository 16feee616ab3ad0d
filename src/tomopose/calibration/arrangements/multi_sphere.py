"""The multi-sphere method (paper ref. [8]): every view's pose from several balls of a known object, view by view.

Nothing is asked of the manipulator, so its errors do not matter, but the scan must be repeated with the ball object.
With this and `calibrate` on the same scan, both methods can be compared.  Where the object's coordinates are not
calibrated, `self_calibrated_balls` finds them from the same views; one known distance then gives the scale.

Source: weighted perspective-n-point by Gauss-Newton from the best of several coarse starts (Hartley & Zisserman,
Multiple View Geometry, ch. 7), eq. (6) with one T_MT a view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np

from tomopose.calibration.model.ball_projection import projection_blocks, whiteners
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array

FEWEST_BALLS = 4
"""Three balls leave up to four poses."""
STEPS, START_STEPS = 60, 12
TOLERANCE = 1e-10
LARGEST_CONDITION = 1e10
GAUGE = 6


@dataclass(frozen=True, kw_only=True)
class BallPose:
    """Pose of a ball object in one view: T_MW; covariance (6, 6) of (w, t), rad and mm, exp(w) from the left, along W;
    residuals (m, 2) px; chi2."""

    T_MW: RigidTransform
    covariance: Array
    residuals: Array
    chi2: float


def pose_from_balls(
    scanner: Scanner, x_D: Any, balls: Any, *, covariance: Any = None, start: RigidTransform | None = None
) -> BallPose:
    """The object's pose M -> W from observed centres x_D (m, 2), px, of balls (m, 3), mm in M.

    covariance: (m, 2, 2) px^2, or None: 1 px.  start: a pose nearby (M -> W); without it coarse starts are tried.

    Raises
    ------
    InputError           fewer than four balls.
    NotObservableError   balls in a line, or in another arrangement that leaves the pose open.
    NotConvergedError    no pose projects the balls where they were seen.
    """
    x_D, balls = np.asarray(x_D, dtype=np.float64), np.asarray(balls, dtype=np.float64)
    m = len(balls)
    if x_D.shape != (m, 2) or balls.shape != (m, 3):
        raise InputError(f"observed centres (m, 2) and balls (m, 3) must pair; got {x_D.shape} and {balls.shape}")
    if m < FEWEST_BALLS:
        raise InputError(f"{m} balls do not determine a pose; at least {FEWEST_BALLS} are needed")
    spread = np.linalg.svd(balls - balls.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        raise NotObservableError(
            "the balls are in a line: a turn about it moves none of them",
            direction="turn about the balls' line",
            singular_values=spread.tolist(),
        )
    C = np.tile(np.eye(2), (m, 1, 1)) if covariance is None else np.asarray(covariance, dtype=np.float64)
    W = whiteners(C)
    starts = [start] if start is not None else _coarse_starts(scanner, x_D, balls)
    coarse = [_gauss_newton(scanner, x_D, balls, W, s, START_STEPS if len(starts) > 1 else STEPS) for s in starts]
    best = min(coarse, key=lambda found: found[1])
    T, chi2, J, r, still = _gauss_newton(scanner, x_D, balls, W, best[0], STEPS)
    if not np.isfinite(chi2) or not still:
        raise NotConvergedError("no pose of the ball object projects its balls where they were seen; check the ids")
    N = J.T @ J
    if np.linalg.cond(N / np.sqrt(np.outer(np.diag(N), np.diag(N)))) > LARGEST_CONDITION:
        raise NotObservableError("the balls leave a direction of the pose open", direction="pose of the ball object")
    return BallPose(T_MW=T, covariance=np.asarray(np.linalg.inv(N), dtype=np.float64), residuals=r, chi2=chi2)


def _coarse_starts(scanner: Scanner, x_D: Array, balls: Array) -> list[RigidTransform]:
    """The 24 cube rotations, at the depth that the balls' spread suggests, along the ray of the mean centre."""
    middle = balls.mean(axis=0)
    pixel = np.array([scanner.p_u, scanner.p_v])
    size_D = float(np.sqrt(np.mean(np.sum(((x_D - x_D.mean(axis=0)) * pixel) ** 2, axis=1))))
    size_M = float(np.sqrt(np.mean(np.sum((balls - middle) ** 2, axis=1)) * 2 / 3))
    depth = scanner.d_SD * min(size_M / max(size_D, 1e-9), 1.0)
    ray = np.linalg.solve(scanner.K, [*x_D.mean(axis=0), 1.0])
    x_S = ray / ray[2] * depth
    x_W = scanner.T_WS.inv.apply(x_S)
    turns = []
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), axes] = signs
            if np.linalg.det(R) > 0:
                turns.append(R)
    return [RigidTransform(R=R, t=x_W - R @ middle, source=Frame.M, target=Frame.W) for R in turns]


def _rows(scanner: Scanner, T: RigidTransform, balls: Array) -> tuple[Array, Array, Array]:
    """Projected balls (m, 2), J (m, 2, 6) by (w, t) of the pose, G_M (m, 2, 3) by the balls."""
    m = len(balls)
    same = RigidTransform(
        R=np.broadcast_to(T.R, (m, 3, 3)), t=np.broadcast_to(T.t, (m, 3)), source=Frame.M, target=Frame.H
    )
    b = projection_blocks(scanner, T_HT=RigidTransform.identity(Frame.H, Frame.T), T_MH=same, t=balls)
    return b.x_D, np.concatenate([-b.G_H @ skew(b.x_H - T.t), b.G_H], axis=2), b.J_t


def _moved(T: RigidTransform, step: Array) -> RigidTransform:
    return RigidTransform(R=exp_rotation(step[:3]) @ T.R, t=T.t + step[3:], source=T.source, target=T.target)


def _gauss_newton(
    scanner: Scanner, x_D: Array, balls: Array, W: Array, T: RigidTransform, steps: int
) -> tuple[RigidTransform, float, Array, Array, bool]:
    """Levenberg-Marquardt: (T, chi2, weighted J, residuals px, whether it came to rest)."""
    x, J, _ = _rows(scanner, T, balls)
    r = x_D - x
    z = (W @ r[:, :, None]).ravel()
    chi2 = float(z @ z) if np.isfinite(z).all() else np.inf
    A = (W @ J).reshape(-1, 6)
    damping, still = 1e-4, False
    for _ in range(steps):
        if not np.isfinite(chi2):
            break
        N = A.T @ A
        N[np.diag_indices(6)] *= 1 + damping
        step = np.asarray(np.linalg.solve(N, A.T @ z), dtype=np.float64)
        trial = _moved(T, step)
        x, J, _ = _rows(scanner, trial, balls)
        z_new = (W @ (x_D - x)[:, :, None]).ravel()
        chi2_new = float(z_new @ z_new) if np.isfinite(z_new).all() else np.inf
        if chi2_new <= chi2 * (1 + 1e-12) + 1e-18:
            still = bool(np.abs(A @ step).max() < TOLERANCE * max(1.0, np.sqrt(chi2)) or chi2 - chi2_new < 1e-9)
            T, z, chi2, r, A, damping = trial, z_new, chi2_new, x_D - x, (W @ J).reshape(-1, 6), damping / 10
            if still:
                break
        else:
            damping *= 10
            if damping > 1e10:
                still = True
                break
    return T, chi2, A, r, still


def poses_of_views(
    scanner: Scanner, views: Sequence[Any], balls: Any, *, covariance: Sequence[Any] | None = None
) -> list[BallPose]:
    """The object's pose in every view; views: centres (m, 2), NaN where a ball is not seen."""
    balls = np.asarray(balls, dtype=np.float64)
    found: list[BallPose] = []
    for k, view in enumerate(views):
        x = np.asarray(view, dtype=np.float64)
        seen = np.isfinite(x).all(axis=1)
        C = None if covariance is None else np.asarray(covariance[k])[seen]
        start = found[-1].T_MW if found else None
        try:
            pose = pose_from_balls(scanner, x[seen], balls[seen], covariance=C, start=start)
            if pose.chi2 > 10.0 * (2 * seen.sum()) and start is not None:
                pose = min(pose, pose_from_balls(scanner, x[seen], balls[seen], covariance=C), key=lambda q: q.chi2)
        except NotConvergedError:
            pose = pose_from_balls(scanner, x[seen], balls[seen], covariance=C)
        found.append(pose)
    return found


def self_calibrated_balls(
    scanner: Scanner,
    views: Sequence[Any],
    balls: Any,
    *,
    covariance: Sequence[Any] | None = None,
    distances: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    ball_sigma: float = 1.0,
) -> tuple[Array, list[BallPose]]:
    """Ball coordinates (m, 3) and the views' poses together, from coarse coordinates.

    distances: (row, row) -> (distance, standard uncertainty), mm; ball_sigma: mm, how far the coarse coordinates may be
    off.  Without a distance the object's size is known only as well as ball_sigma: radiographs of one scanner position
    cannot distinguish a large object far away from a small one near.
    """
    balls = np.array(balls, dtype=np.float64)
    nominal = balls.copy()
    bars = dict(distances or {})
    poses = poses_of_views(scanner, views, balls, covariance=covariance)
    T = [p.T_MW for p in poses]
    m = len(balls)
    for _ in range(STEPS):
        S = np.eye(3 * m) / ball_sigma**2
        g = (nominal - balls).ravel() / ball_sigma**2
        for (a, b), (length, u) in bars.items():
            d = balls[a] - balls[b]
            row = np.zeros(3 * m)
            row[3 * a : 3 * a + 3], row[3 * b : 3 * b + 3] = d, -d
            row /= np.linalg.norm(d) * u
            S += np.outer(row, row)
            g += row * (length - np.linalg.norm(d)) / u
        eliminated = []
        for k, view in enumerate(views):
            x = np.asarray(view, dtype=np.float64)
            seen = np.flatnonzero(np.isfinite(x).all(axis=1))
            C = np.tile(np.eye(2), (len(seen), 1, 1)) if covariance is None else np.asarray(covariance[k])[seen]
            W = whiteners(C)
            calc, J, G = _rows(scanner, T[k], balls[seen])
            A = (W @ J).reshape(-1, 6)
            by_ball = np.zeros((len(seen), 2, m, 3))
            by_ball[np.arange(len(seen)), :, seen] = W @ G
            B = by_ball.reshape(-1, 3 * m)
            z = (W @ (x[seen] - calc)[:, :, None]).ravel()
            N, NB, Nz = A.T @ A, A.T @ B, A.T @ z
            S += B.T @ B - NB.T @ np.linalg.solve(N, NB)
            g += B.T @ z - NB.T @ np.linalg.solve(N, Nz)
            eliminated.append((N, NB, Nz))
        step = np.linalg.solve(S, g)
        balls = balls + step.reshape(m, 3)
        T = [
            _moved(T_k, np.asarray(np.linalg.solve(N, Nz - NB @ step), dtype=np.float64))
            for T_k, (N, NB, Nz) in zip(T, eliminated, strict=True)
        ]
        if np.abs(step).max() < 1e-9:
            return balls, poses_of_views(scanner, views, balls, covariance=covariance)
    raise NotConvergedError(f"the ball object's coordinates still move by {np.abs(step).max():.3g} mm at the last step")
