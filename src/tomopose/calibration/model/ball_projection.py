r"""Eq. (6) and its derivatives: the projected ball centre of each pose, and what moves it.

With y = R^T x_S, R = R_x(theta) R_y(phi) R_z(eta) the panel's rotation and x_S the ball in S,

    u = u_0 - d_SD (R_33 y_1 / y_3 - R_31) / p_u,        v = v_0 + d_SD (R_33 y_2 / y_3 - R_32) / p_v,

which is eq. (2) where the panel has neither roll nor tilt.  The chain below is
x_H = R_MH t + s t_MH,  x_T = R_HT x_H + t_HT,  x_W = T_TW(alpha) x_T,  x_S = T_WS x_W.
All derivatives are analytic; the tangent of R_HT is the rotation vector w with R = exp(w) R_HT.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.kernel_cache import njit
from tomopose.units import Array

Compiled = TypeVar("Compiled", bound=Callable[..., object])
Three: TypeAlias = tuple[float, float, float]

SCANNER_COLUMNS = (
    "d_SD",
    "d_SR",
    "p_u",
    "p_v",
    "u_0",
    "v_0",
    "eta",
    "theta",
    "phi",
    "axis_y",
    "axis_tilt_x",
    "axis_tilt_y",
    "translation_scale",
)
"""What the projection depends on besides T_HT, T_MH, t and alpha, in the order of `ProjectionBlocks.J_scanner`.

`translation_scale` (nominal 1) multiplies the translations t_MH that the manipulator reports.
"""

_NUMBERS = attrgetter(*SCANNER_COLUMNS[:-1])


def scanner_vector(scanner: Scanner, translation_scale: float = 1.0) -> Array:
    """The numbers of SCANNER_COLUMNS, shape (13,)."""
    return np.array([*_NUMBERS(scanner), translation_scale])


_UNCALLED: dict[str, Any] = {
    "cache": True,
    "no_cpython_wrapper": True,
}


def inner(function: Compiled) -> Compiled:
    """Compile what only compiled code calls: without the wrappers by which Python and C would call it."""
    compiled: Compiled = njit(**_UNCALLED)(function)
    return compiled


@inner
def view_of(v: Array, r: int) -> None:
    """Row r of v (runs, 29): what all poses of a run have in common, from its scanner vector, the first 13 numbers.

    Then the panel's rotation R_x(theta) R_y(phi) R_z(eta) by rows, cos and sin of theta, the table's real axis
    R_x(tilt_x) R_y(tilt_y) e_z, and cos and sin of tilt_x.
    """
    ce, se = math.cos(v[r, 6]), math.sin(v[r, 6])
    ct, st = math.cos(v[r, 7]), math.sin(v[r, 7])
    cp, sp = math.cos(v[r, 8]), math.sin(v[r, 8])
    cx, sx, cy = math.cos(v[r, 10]), math.sin(v[r, 10]), math.cos(v[r, 11])
    v[r, 13], v[r, 14], v[r, 15] = cp * ce, -cp * se, sp
    v[r, 16], v[r, 17], v[r, 18] = ct * se + st * sp * ce, ct * ce - st * sp * se, -st * cp
    v[r, 19], v[r, 20], v[r, 21] = st * se - ct * sp * ce, st * ce + ct * sp * se, ct * cp
    v[r, 22], v[r, 23] = ct, st
    v[r, 24], v[r, 25], v[r, 26] = math.sin(v[r, 11]), -sx * cy, cx * cy
    v[r, 27], v[r, 28] = cx, sx


VIEW = 29
"""Numbers of `view_of`."""


POSE = 14
"""Numbers of a pose: R_MH by rows, t_MH, cos and sin of the table's angle."""

CENTRE, MOVES, EVERYTHING = range(3)
"""What `project_pose` writes: x, x_H and y_T; the derivatives by ball and mount too; by the scanner too."""

X, X_H, Y_T, G_T, G_H, J_W, J_S, PROJECTED = 0, 2, 5, 8, 14, 20, 26, 52
"""Where `project_pose` writes x (2) px; x_H (3), y_T = R_HT x_H (3) mm; dx/dx_T, dx/dx_H and the derivatives by a turn
of the mount, y_T x dx/dx_T (2, 3); derivatives (2, 13) by SCANNER_COLUMNS, and how many numbers these are."""


BALLS = 12
"""Where the balls begin in a point: R_HT by rows, t_HT, then the balls (3 each)."""


@inner
def project_pose(v: Array, at: Array, poses: Array, index: tuple[int, int, int], wanted: int, out: Array) -> bool:
    """One pose, written into `out` (52,); False where the ball is not in front of the source.

    v (runs, 29): as of `view_of`;  at: see BALLS;  poses (n, 14);  index: run, pose and ball;  wanted: see CENTRE.
    Whole arrays and an index, since every view of an array costs two counts of references.
    """
    r, k, ball = index
    t0, t1, t2, scale = at[BALLS + 3 * ball], at[BALLS + 3 * ball + 1], at[BALLS + 3 * ball + 2], v[r, 12]
    for i in range(3):
        R_t = poses[k, 3 * i] * t0 + poses[k, 3 * i + 1] * t1 + poses[k, 3 * i + 2] * t2
        out[X_H + i] = R_t + scale * poses[k, 9 + i]
    h0, h1, h2 = out[X_H], out[X_H + 1], out[X_H + 2]
    for i in range(3):
        out[Y_T + i] = at[3 * i] * h0 + at[3 * i + 1] * h1 + at[3 * i + 2] * h2
    # the table turns by Rodrigues' formula about its axis
    c, d, a0, a1, a2 = poses[k, 12], poses[k, 13], v[r, 24], v[r, 25], v[r, 26]
    k0, k1, k2 = (1.0 - c) * a0, (1.0 - c) * a1, (1.0 - c) * a2
    M0 = (c + k0 * a0, k0 * a1 - d * a2, k0 * a2 + d * a1)
    M1 = (k1 * a0 + d * a2, c + k1 * a1, k1 * a2 - d * a0)
    M2 = (k2 * a0 - d * a1, k2 * a1 + d * a0, c + k2 * a2)
    z0, z1, z2 = out[Y_T] + at[9], out[Y_T + 1] + at[10] - v[r, 9], out[Y_T + 2] + at[11]
    m0 = M0[0] * z0 + M0[1] * z1 + M0[2] * z2
    m1 = M1[0] * z0 + M1[1] * z1 + M1[2] * z2
    m2 = M2[0] * z0 + M2[1] * z1 + M2[2] * z2
    s0, s1, s2 = -(m1 + v[r, 9]), m2, v[r, 1] - m0
    R0, R1, R2 = (v[r, 13], v[r, 14], v[r, 15]), (v[r, 16], v[r, 17], v[r, 18]), (v[r, 19], v[r, 20], v[r, 21])
    y2 = R0[2] * s0 + R1[2] * s1 + R2[2] * s2
    if not y2 > 0.0:
        return False
    f_u, f_v = -v[r, 0] / v[r, 2], v[r, 0] / v[r, 3]
    a, b = (R0[0] * s0 + R1[0] * s1 + R2[0] * s2) / y2, (R0[1] * s0 + R1[1] * s1 + R2[1] * s2) / y2
    du, dv = f_u * (R2[2] * a - R2[0]), f_v * (R2[2] * b - R2[1])
    out[X], out[X + 1] = v[r, 4] + du, v[r, 5] + dv
    if wanted == CENTRE:
        return True
    # dx/dx_S, and dx/dx_W = dx/dx_S R_WS
    gu, gv = f_u * R2[2] / y2, f_v * R2[2] / y2
    su = (gu * (R0[0] - a * R0[2]), gu * (R1[0] - a * R1[2]), gu * (R2[0] - a * R2[2]))
    sv = (gv * (R0[1] - b * R0[2]), gv * (R1[1] - b * R1[2]), gv * (R2[1] - b * R2[2]))
    for e in range(2):
        w = su if e == 0 else sv
        g0 = w[1] * M2[0] - w[2] * M0[0] - w[0] * M1[0]
        g1 = w[1] * M2[1] - w[2] * M0[1] - w[0] * M1[1]
        g2 = w[1] * M2[2] - w[2] * M0[2] - w[0] * M1[2]
        G = G_T + 3 * e
        out[G], out[G + 1], out[G + 2] = g0, g1, g2
        W, y0, y1 = J_W + 3 * e, out[Y_T], out[Y_T + 1]
        out[W], out[W + 1], out[W + 2] = y1 * g2 - out[Y_T + 2] * g1, out[Y_T + 2] * g0 - y0 * g2, y0 * g1 - y1 * g0
        for i in range(3):
            out[G_H + 3 * e + i] = g0 * at[i] + g1 * at[3 + i] + g2 * at[6 + i]
        if wanted == EVERYTHING:
            f, q, off = (f_u, a, du) if e == 0 else (f_v, b, dv)
            J = J_S + 13 * e
            out[J], out[J + 1] = off / v[r, 0], w[2]
            out[J + 2 + e], out[J + 3 - e] = -off / v[r, 2 + e], 0.0
            out[J + 4 + e], out[J + 5 - e] = 1.0, 0.0
            _by_panel_angles(v, r, (s0, s1, s2), w, f, q, e, out)
            _by_table_axis(v, r, (z0, z1, z2), (m0, m1, m2), (-w[2], -w[0], w[1]), (g0, g1, g2), J, out)
            H = G_H + 3 * e
            out[J + 12] = out[H] * poses[k, 9] + out[H + 1] * poses[k, 10] + out[H + 2] * poses[k, 11]
    return True


@inner
def _by_panel_angles(v: Array, r: int, x_S: Three, w: Three, f: float, q: float, e: int, out: Array) -> None:
    """Columns eta, theta, phi, of row e: dR = [n]_x R with n = R e_z, e_x, R_x(theta) e_y; dy = R^T (x_S x n).

    w: dx/dx_S;  f, q: (f_u, y_1 / y_3), or (f_v, y_2 / y_3).
    """
    s0, s1, s2 = x_S
    for k in range(3):
        n0 = v[r, 15] if k == 0 else 1.0 if k == 1 else 0.0
        n1 = v[r, 18] if k == 0 else 0.0 if k == 1 else v[r, 22]
        n2 = v[r, 21] if k == 0 else 0.0 if k == 1 else v[r, 23]
        c0, c1, c2 = s1 * n2 - s2 * n1, s2 * n0 - s0 * n2, s0 * n1 - s1 * n0
        # row 3 of [n]_x R
        r_e, r_2 = n0 * v[r, 16 + e] - n1 * v[r, 13 + e], n0 * v[r, 18] - n1 * v[r, 15]
        out[J_S + 13 * e + 6 + k] = w[0] * c0 + w[1] * c1 + w[2] * c2 + f * (r_2 * q - r_e)


@inner
def _by_table_axis(v: Array, r: int, z: Three, m: Three, w: Three, g: Three, J: int, out: Array) -> None:
    """Columns axis_y, axis_tilt_x, axis_tilt_y of the row that begins at J: x_W = M z + o with o = (0, axis_y, 0),
    z = x_T - o, m = M z.

    w, g: dx/dx_W, dx/dx_T.  dM = [c]_x M - M [c]_x with c = e_x, then R_x(tilt_x) e_y.
    """
    out[J + 9] = w[1] - g[1]
    for k in range(2):
        c0, c1, c2 = (1.0, 0.0, 0.0) if k == 0 else (0.0, v[r, 27], v[r, 28])
        p = w[0] * (c1 * m[2] - c2 * m[1]) + w[1] * (c2 * m[0] - c0 * m[2]) + w[2] * (c0 * m[1] - c1 * m[0])
        q = g[0] * (c1 * z[2] - c2 * z[1]) + g[1] * (c2 * z[0] - c0 * z[2]) + g[2] * (c0 * z[1] - c1 * z[0])
        out[J + 10 + k] = p - q


@njit(cache=True)
def _project_all(s: Array, run: Any, at: Array, poses: Array, wanted: int, found: Array, x: Array) -> None:
    """x (n, 2): the centres, left as they are where a ball is behind the source;  found (n, 52): see X, of which one
    row is enough where only the CENTRE is wanted.

    s (runs, 13), run (n,), poses (n, 14);  at: see BALLS, one ball a pose.
    """
    views = np.empty((s.shape[0], VIEW))
    for r in range(s.shape[0]):
        for i in range(s.shape[1]):
            views[r, i] = s[r, i]
        view_of(views, r)
    for k in range(poses.shape[0]):
        out = found[k if wanted else 0]
        if project_pose(views, at, poses, (run[k], k, k), wanted, out):
            x[k, 0], x[k, 1] = out[X], out[X + 1]


def poses_of(R_MH: Array, t_MH: Array, alpha: Array) -> Array:
    """(n, 14): R_MH (n, 3, 3), t_MH (n, 3) and table angles alpha (n,), as `project_pose` takes them."""
    poses = np.empty((len(R_MH), POSE))
    poses[:, :9], poses[:, 9:12] = R_MH.reshape(-1, 9), t_MH
    np.cos(alpha, out=poses[:, 12])
    np.sin(alpha, out=poses[:, 13])
    return poses


def projected_centres(s: Array, run: Any, R_HT: Array, t_HT: Array, poses: Array, t: Array) -> Array:
    """(n, 2) px: eq. (6) without derivatives; NaN where a ball is behind the source.

    s (runs, 13): `scanner_vector` of each run;  run: (n,) integers;  R_HT (3, 3), t_HT (3,);  poses (n, 14): as of
    `poses_of`;  t: (n, 3) ball centres in M, mm.
    """
    x = np.full((len(poses), 2), np.nan)
    _project_all(s, run, np.concatenate([R_HT.ravel(), t_HT, t.ravel()]), poses, CENTRE, np.empty((1, PROJECTED)), x)
    return x


@dataclass(frozen=True, kw_only=True)
class ProjectionBlocks:
    """Projected centres of n poses and their derivatives, px per mm or px per rad.

    x_D:          (n, 2) px; NaN where the ball is behind the source.
    J_w_HT:       (n, 2, 3) by the rotation vector that multiplies R_HT from the left.
    J_t_HT:       (n, 2, 3) by t_HT.
    J_t:          (n, 2, 3) by the centre of the pose's own ball, in M.
    J_scanner:    (n, 2, 13) by SCANNER_COLUMNS.
    x_H:          (n, 3) ball in H, mm;  t: (n, 3) ball in M;  R_MH: (n, 3, 3).
    G_H:          (n, 2, 3) by x_H.
    """

    x_D: Array
    J_w_HT: Array
    J_t_HT: Array
    J_t: Array
    J_scanner: Array
    x_H: Array
    t: Array
    R_MH: Array
    G_H: Array

    def rows(self, some: slice) -> ProjectionBlocks:
        """Of some of the poses."""
        return ProjectionBlocks(**{name: value[some] for name, value in vars(self).items()})

    @property
    def J_pose_left(self) -> Array:
        """(n, 2, 6) by (rho, w) of T_MH <- Exp(rho, w) T_MH: x_H moves by rho + w x x_H.  mm, rad, along H."""
        return np.concatenate([self.G_H, -self.G_H @ skew(self.x_H)], axis=2)

    @property
    def J_pose_right(self) -> Array:
        """(n, 2, 6) by (rho, w) of T_MH <- T_MH Exp(rho, w): x_M moves by rho + w x t.  mm, rad, along M."""
        G_M = self.G_H @ self.R_MH
        return np.concatenate([G_M, -G_M @ skew(self.t)], axis=2)

    @property
    def J_mount(self) -> Array:
        """(n, 2, 6) by (w_HT, t_HT)."""
        return np.concatenate([self.J_w_HT, self.J_t_HT], axis=2)


def projection_blocks(
    scanner: Scanner | Sequence[Scanner],
    *,
    T_HT: RigidTransform,
    T_MH: RigidTransform,
    t: ArrayLike,
    alpha: ArrayLike = 0.0,
    translation_scale: float = 1.0,
    run: Any = None,
) -> ProjectionBlocks:
    """Eq. (6) with all its derivatives.

    scanner: one, or one per run;  run: (n,) index of each pose's scanner (default 0).
    T_HT: manipulator base -> table.  T_MH: n poses.  t: (3,) or (n, 3) ball centre in M, mm.
    alpha: (n,) or a number, table angle, rad.  translation_scale multiplies T_MH.t.
    """
    scanners = [scanner] if isinstance(scanner, Scanner) else list(scanner)
    s = np.array([scanner_vector(one, translation_scale) for one in scanners])
    n = len(T_MH)
    # Copies: contiguous and writable, whatever was given, so that the kernel is compiled for one kind of array.
    R_MH, t_k = (np.array(x, dtype=np.float64, order="C") for x in (T_MH.R, np.broadcast_to(t, (n, 3))))
    poses = poses_of(R_MH, T_MH.t, np.broadcast_to(np.asarray(alpha, dtype=np.float64), (n,)))
    index = np.zeros(n, dtype=np.int64) if run is None else np.array(run, dtype=np.int64)
    x, b = np.full((n, 2), np.nan), np.zeros((n, PROJECTED))
    _project_all(s, index, np.concatenate([T_HT.R.ravel(), T_HT.t, t_k.ravel()]), poses, EVERYTHING, b, x)
    by_T, by_H, by_w = (b[:, first : first + 6].reshape(n, 2, 3) for first in (G_T, G_H, J_W))
    return ProjectionBlocks(
        x_D=x, J_w_HT=by_w, J_t_HT=by_T, J_t=by_H @ R_MH,
        J_scanner=b[:, J_S:].reshape(n, 2, 13), x_H=b[:, X_H : X_H + 3].copy(), t=t_k, R_MH=R_MH, G_H=by_H,
    )  # fmt: skip


def whiteners(covariance: Array) -> Array:
    """W (n, 2, 2) with W C W^T = 1: what turns residuals in px into residuals in standard deviations."""
    return np.linalg.inv(np.linalg.cholesky(covariance))
