r"""Projection where the source moves against the panel, and its derivatives: twin robots.

With d the place of the real focal spot and x that of the ball, both in the S of a nominal focal spot (mm),

    u = u_0 - (d_x + l (x - d_x)) / p_u,   v = v_0 + (d_y + l (y - d_y)) / p_v,   l = (d_SD - d_z) / (z - d_z),

eq. (2) for a panel that stays and a source that does not: view by view d_SD - d_z, u_0 - d_x / p_u and v_0 + d_y / p_v
take the place of d_SD, u_0 and v_0.  Both points run through the same chain M -> H -> T -> W -> S.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS
from tomopose.errors import InputError
from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.twin import TwinRobots
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class TwinBlocks:
    """x_D (n, 2) px, NaN where the ball is behind the source; J_mount (n, 2, 6), J_t (n, 2, 3) by the ball, J_p
    (n, 2, m) by the errors, J_plate (n, 2, 6) by turns about and shifts of the detector's flange, J_scanner
    (n, 2, columns) by the pixel pitches, 0 elsewhere; C_source (n, 2, 2) px^2 of the source robot's scatter; source
    (n, 3): d."""

    x_D: Array
    J_mount: Array
    J_t: Array
    J_p: Array
    J_plate: Array
    J_scanner: Array
    C_source: Array
    source: Array


@dataclass(frozen=True, kw_only=True)
class _Carried:
    """A point carried from M to S: x_S (n, 3), and its derivatives (n, 3, .) by mount, by (w, t) of the inverse pose,
    by turns about and shifts of the flange, and by the point."""

    x: Array
    J_mount: Array
    J_pose: Array
    J_plate: Array
    J_point: Array


def _carried(scanner: Scanner, T_HT: RigidTransform, R: Array, t: Array, point: Array) -> _Carried:
    T_TS = scanner.T_WS @ scanner.T_TW(0.0)
    x_H = (R @ point[:, :, None])[..., 0] + t
    y = x_H @ T_HT.R.T
    A = np.broadcast_to(T_TS.R, (len(R), 3, 3))
    A_H = A @ T_HT.R
    return _Carried(
        x=T_TS.apply(y + T_HT.t),
        J_mount=np.concatenate([-A @ skew(y), A], axis=2),
        J_pose=np.concatenate([-A_H @ skew(x_H - t), A_H], axis=2),
        J_plate=np.concatenate([-A_H @ skew(x_H), A_H], axis=2),
        J_point=A_H @ R,
    )


def twin_blocks(
    scanner: Scanner, twin: TwinRobots, *, T_HT: RigidTransform, poses: PoseSequence, p: Array, t: Array
) -> TwinBlocks:
    """The centres of balls t (n, 3) in M, and all derivatives.  poses: inverse poses of the detector's flange.

    Raises InputError for a panel with roll or tilt, which the mount expresses here.
    """
    if any((scanner.eta, scanner.theta, scanner.phi)):
        raise InputError("a panel on a robot's flange has its roll and tilt in the mount; eta, theta, phi must be 0")
    real = twin.real_poses(poses, p)
    place = twin.source_places(poses, p)
    ball = _carried(scanner, T_HT, real.R, real.t, t)
    spot = _carried(scanner, T_HT, real.R, real.t, place.x)
    (x, y, z), (a, b, c) = ball.x.T, spot.x.T
    depth = z - c
    behind = ~((depth > 0) & (scanner.d_SD - c > 0))
    depth = np.where(behind, np.nan, depth)
    l = (scanner.d_SD - c) / depth
    f_u, f_v = -1 / scanner.p_u, 1 / scanner.p_v
    zero = np.zeros_like(l)
    dl_c = (scanner.d_SD - z) / depth**2
    g_ball = np.stack(
        [
            np.stack([f_u * l, zero, -f_u * (x - a) * l / depth], axis=1),
            np.stack([zero, f_v * l, -f_v * (y - b) * l / depth], axis=1),
        ],
        axis=1,
    )
    g_spot = np.stack(
        [
            np.stack([f_u * (1 - l), zero, f_u * (x - a) * dl_c], axis=1),
            np.stack([zero, f_v * (1 - l), f_v * (y - b) * dl_c], axis=1),
        ],
        axis=1,
    )
    J_pose = g_ball @ ball.J_pose + g_spot @ spot.J_pose
    by_spot = g_spot @ spot.J_point
    x_D = np.stack([scanner.u_0 + f_u * (a + l * (x - a)), scanner.v_0 + f_v * (b + l * (y - b))], axis=1)
    J_scanner = np.zeros((len(x_D), 2, len(SCANNER_COLUMNS)))
    J_scanner[:, 0, SCANNER_COLUMNS.index("p_u")] = (scanner.u_0 - x_D[:, 0]) / scanner.p_u
    J_scanner[:, 1, SCANNER_COLUMNS.index("p_v")] = (scanner.v_0 - x_D[:, 1]) / scanner.p_v
    return TwinBlocks(
        x_D=x_D,
        J_mount=g_ball @ ball.J_mount + g_spot @ spot.J_mount,
        J_t=g_ball @ ball.J_point,
        J_p=J_pose @ real.J + by_spot @ place.J,
        J_plate=g_ball @ ball.J_plate + g_spot @ spot.J_plate,
        J_scanner=J_scanner,
        C_source=by_spot @ place.covariance @ np.swapaxes(by_spot, 1, 2),
        source=spot.x,
    )


def twin_view_matrices(
    scanner: Scanner, twin: TwinRobots, *, T_HT: RigidTransform, poses: PoseSequence, p: Array
) -> Array:
    """(n, 3, 4): points of M to pixels, w the depth in mm."""
    real = twin.real_poses(poses, p)
    spot = _carried(scanner, T_HT, real.R, real.t, twin.source_places(poses, p).x).x
    n = len(poses)
    K = np.zeros((n, 3, 3))
    distance = scanner.d_SD - spot[:, 2]
    K[:, 0, 0], K[:, 0, 2] = -distance / scanner.p_u, scanner.u_0 - spot[:, 0] / scanner.p_u
    K[:, 1, 1], K[:, 1, 2] = distance / scanner.p_v, scanner.v_0 + spot[:, 1] / scanner.p_v
    K[:, 2, 2] = 1.0
    T_HS = scanner.T_WS @ scanner.T_TW(0.0) @ T_HT
    R = T_HS.R @ real.R
    t = real.t @ T_HS.R.T + T_HS.t - spot
    result: Array = K @ np.concatenate([R, t[:, :, None]], axis=2)
    return result


def balls_from_rays(P: Array, x_D: Array, ball: Array, count: int) -> Array:
    """(count, 3): where the rays of each ball's observed centres x_D (n, 2) meet best, given matrices P (n, 3, 4)."""
    A = P[:, :2] - x_D[:, :, None] * P[:, 2:]
    places = []
    for k in range(count):
        rows = A[ball == k].reshape(-1, 4)
        places.append(np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)[0])
    return np.array(places)
