"""The pose of an object of several balls in one view (paper ref. [8]), from identified centres.

Source: weighted perspective-n-point by Gauss-Newton from the best of several coarse starts (Hartley & Zisserman,
Multiple View Geometry, ch. 7), eq. (6) with one T_MT a view.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tomopose.calibration.arrangements.multi_sphere.standard import FEWEST_BALLS, require_not_in_line
from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, projection_blocks, whiteners
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.object_pose import point_jacobian
from tomopose.geometry.projection import project
from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform, moved
from tomopose.least_squares import Solution, least_squares
from tomopose.units import Array
from tomopose.values import require_types, value

STEPS, START_STEPS = 60, 12
TOLERANCE = 1e-10
"""rms of the whitened move of a step that ends the iteration."""
LARGEST_CONDITION = 1e10


@value
class BallPose:
    """Pose of a ball object in one view: T_MW; covariance (6, 6) of (w, t), rad and mm, exp(w) from the left, along W;
    residuals (m, 2) px; chi2."""

    T_MW: RigidTransform
    covariance: Array
    residuals: Array
    chi2: float


@require_types
def pose_from_balls(
    scanner: Scanner,
    x_D: ArrayLike,
    balls: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    start: RigidTransform | None = None,
) -> BallPose:
    """The object's pose M -> W from observed centres x_D (m, 2), px, of balls (m, 3), mm in M.

    covariance: (m, 2, 2) px^2, or None: 1 px.  start: a pose nearby (M -> W); without it coarse starts are tried.

    Raises
    ------
    InputError           fewer than four balls.
    NotObservableError   balls in a line, or in another arrangement that leaves the pose open.
    NotConvergedError    no pose projects the balls where they were seen.
    """
    x, x_M = np.asarray(x_D, dtype=np.float64), np.asarray(balls, dtype=np.float64)
    m = len(x_M)
    if x.shape != (m, 2) or x_M.shape != (m, 3):
        raise InputError(f"observed centres (m, 2) and balls (m, 3) must pair; got {x.shape} and {x_M.shape}")
    if m < FEWEST_BALLS:
        raise InputError(f"{m} balls do not determine a pose; at least {FEWEST_BALLS} are needed")
    require_not_in_line(x_M)
    W = whiteners(np.tile(np.eye(2), (m, 1, 1)) if covariance is None else np.asarray(covariance, dtype=np.float64))
    starts = [start] if start is not None else _coarse_starts(scanner, x, x_M)
    coarse = [_nearest_pose(scanner, x, x_M, W, s, START_STEPS if len(starts) > 1 else STEPS) for s in starts]
    found = _nearest_pose(scanner, x, x_M, W, min(coarse, key=lambda s: s.cost).state, STEPS)
    if not found.status.at_rest:
        raise NotConvergedError("no pose of the ball object projects its balls where they were seen; check the ids")
    N = found.J.T @ found.J
    if np.linalg.cond(N / np.sqrt(np.outer(np.diag(N), np.diag(N)))) > LARGEST_CONDITION:
        raise NotObservableError("the balls leave a direction of the pose open", direction="pose of the ball object")
    C = np.asarray(np.linalg.inv(N), dtype=np.float64)
    r, _ = _residuals(scanner.P_S @ scanner.T_WS.matrix, found.state, x, x_M)
    return BallPose(T_MW=found.state, covariance=C, residuals=r, chi2=found.cost)


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


def view_rows(
    scanner: Scanner, T: RigidTransform, points: Array, names: Sequence[str] = ()
) -> tuple[Array, Array, Array, Array]:
    """x (k, 2) px of points (k, 3) of M, and its derivatives: (k, 2, 6) by (w, t) of the pose, (k, 2, 3) by the points,
    (k, 2, q) by the scanner's values of those names."""
    k = len(points)
    same = RigidTransform(
        R=np.broadcast_to(T.R, (k, 3, 3)), t=np.broadcast_to(T.t, (k, 3)), source=Frame.M, target=Frame.H
    )
    b = projection_blocks(scanner, T_HT=RigidTransform.identity(Frame.H, Frame.T), T_MH=same, t=points)
    J = np.concatenate([-b.G_H @ skew(b.x_H - T.t), b.G_H], axis=2)
    return b.x_D, J, b.J_t, b.J_scanner[:, :, [SCANNER_COLUMNS.index(n) for n in names]]


def moved_by(T: RigidTransform, step: Array) -> RigidTransform:
    """The pose after a motion (w, t) (6,), rad and mm, along the axes of its target frame."""
    R, t = moved(T.R, T.t, step)
    return RigidTransform(R=R, t=t, source=T.source, target=T.target)


def _nearest_pose(
    scanner: Scanner, x_D: Array, balls: Array, W: Array, start: RigidTransform, steps: int
) -> Solution[RigidTransform]:
    """The pose that projects the balls nearest to x_D (m, 2), px, whitened by W (m, 2, 2)."""
    P = scanner.P_S @ scanner.T_WS.matrix

    def rows(T: RigidTransform) -> tuple[Array, Array]:
        r, J = _residuals(P, T, x_D, balls)
        return np.asarray(W @ r[:, :, None]).ravel(), np.asarray(W @ J).reshape(-1, 6)

    return least_squares(rows, moved_by, start, steps=steps, tolerance=TOLERANCE)


def _residuals(P: Array, T: RigidTransform, x_D: Array, balls: Array) -> tuple[Array, Array]:
    """Residuals (m, 2) px under P (3, 4) of points of W, and the derivatives (m, 2, 6) of the places by (w, t) of the
    pose; residuals are nan for balls behind the source."""
    turned = balls @ T.R.T
    x, G = project(P, turned + T.t), point_jacobian(P[None], turned + T.t)[0]
    # dx = G (w x R b + t): row i of -G [R b]_x is G_i cross R b with its sign turned
    J = np.concatenate([np.cross(turned[:, None], G), G], axis=2)
    return x_D - x, J


def refined_pose(scanner: Scanner, x_D: Array, balls: Array, start: RigidTransform) -> RigidTransform | None:
    """The pose near `start` that is exact for three balls; None without one."""
    W = np.tile(np.eye(2), (len(balls), 1, 1))
    found = _nearest_pose(scanner, x_D, balls, W, start, START_STEPS)
    return found.state if found.cost < 1.0 else None


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
