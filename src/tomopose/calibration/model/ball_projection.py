r"""Eq. (6) and its derivatives: the projected ball centre of each pose, and what moves it.

With y = R^T x_S, R = R_x(theta) R_y(phi) R_z(eta) the panel's rotation and x_S the ball in S,

    u = u_0 - d_SD (R_33 y_1 / y_3 - R_31) / p_u,        v = v_0 + d_SD (R_33 y_2 / y_3 - R_32) / p_v,

which is eq. (2) where the panel has neither roll nor tilt.  The chain below is
x_H = R_MH t + s t_MH,  x_T = R_HT x_H + t_HT,  x_W = T_TW(alpha) x_T,  x_S = T_WS x_W.
All derivatives are analytic; the tangent of R_HT is the rotation vector w with R = exp(w) R_HT.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from tomopose.geometry.rotations import skew
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array

Two: TypeAlias = tuple[float, float]
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

YES: Any
NO: Any
YES, NO = np.bool_(True), np.bool_(False)
"""numba compiles a function once more for a plain True or False that it is called with, not for these."""


def scanner_vector(scanner: Scanner, translation_scale: float = 1.0) -> Array:
    """The numbers of SCANNER_COLUMNS, shape (13,)."""
    return np.array([*(getattr(scanner, name) for name in SCANNER_COLUMNS[:-1]), translation_scale])


@njit(cache=True, inline="always")
def _panel(s: Array, R: Array) -> None:
    """R = R_x(theta) R_y(phi) R_z(eta), written into R."""
    ce, se = math.cos(s[6]), math.sin(s[6])
    ct, st = math.cos(s[7]), math.sin(s[7])
    cp, sp = math.cos(s[8]), math.sin(s[8])
    R[0, 0], R[0, 1], R[0, 2] = cp * ce, -cp * se, sp
    R[1, 0], R[1, 1], R[1, 2] = ct * se + st * sp * ce, ct * ce - st * sp * se, -st * cp
    R[2, 0], R[2, 1], R[2, 2] = st * se - ct * sp * ce, st * ce + ct * sp * se, ct * cp


@njit(cache=True, inline="always")
def _table(s: Array, alpha: float, M: Array) -> None:
    """The rotation of the table about its real axis, written into M."""
    c, d = math.cos(alpha), math.sin(alpha)
    if s[10] == 0.0 and s[11] == 0.0:
        M[0, 0], M[0, 1], M[0, 2] = c, -d, 0.0
        M[1, 0], M[1, 1], M[1, 2] = d, c, 0.0
        M[2, 0], M[2, 1], M[2, 2] = 0.0, 0.0, 1.0
        return
    # Rodrigues about a = R_x(tilt_x) R_y(tilt_y) e_z
    a0 = math.sin(s[11])
    a1, a2 = -math.sin(s[10]) * math.cos(s[11]), math.cos(s[10]) * math.cos(s[11])
    k = 1.0 - c
    M[0, 0], M[0, 1], M[0, 2] = c + k * a0 * a0, k * a0 * a1 - d * a2, k * a0 * a2 + d * a1
    M[1, 0], M[1, 1], M[1, 2] = k * a1 * a0 + d * a2, c + k * a1 * a1, k * a1 * a2 - d * a0
    M[2, 0], M[2, 1], M[2, 2] = k * a2 * a0 - d * a1, k * a2 * a1 + d * a0, c + k * a2 * a2


class Projected(NamedTuple):
    """Where one pose's projection and its derivatives are written.

    x (2,) px;  x_H (3,), y_T = R_HT x_H (3,) mm;  G_H = dx/dx_H, G_T = dx/dx_T (2, 3);  J_s (2, 13) by SCANNER_COLUMNS;
    R, M (3, 3): work space for the rotations of panel and table.
    """

    x: Array
    x_H: Array
    y_T: Array
    G_H: Array
    G_T: Array
    J_s: Array
    R: Array
    M: Array


@njit(cache=True, error_model="numpy")
def project_pose(
    s: Array,
    R_HT: Array,
    t_HT: Array,
    R_k: Array,
    t_k: Array,
    t: Array,
    alpha: float,
    derivatives: bool,
    out: Projected,
) -> bool:
    """One pose, written into `out`; without `derivatives` only x, x_H and y_T.

    False where the ball is not in front of the source.
    """
    x, x_H, y_T, G_H, G_T, J_s, R, M = out
    scale = s[12]
    _panel(s, R)
    _table(s, alpha, M)
    for i in range(3):
        x_H[i] = R_k[i, 0] * t[0] + R_k[i, 1] * t[1] + R_k[i, 2] * t[2] + scale * t_k[i]
    for i in range(3):
        y_T[i] = R_HT[i, 0] * x_H[0] + R_HT[i, 1] * x_H[1] + R_HT[i, 2] * x_H[2]
    z0, z1, z2 = y_T[0] + t_HT[0], y_T[1] + t_HT[1] - s[9], y_T[2] + t_HT[2]
    m0 = M[0, 0] * z0 + M[0, 1] * z1 + M[0, 2] * z2
    m1 = M[1, 0] * z0 + M[1, 1] * z1 + M[1, 2] * z2
    m2 = M[2, 0] * z0 + M[2, 1] * z1 + M[2, 2] * z2
    X, Y, Z = -(m1 + s[9]), m2, s[1] - m0
    y0 = R[0, 0] * X + R[1, 0] * Y + R[2, 0] * Z
    y1 = R[0, 1] * X + R[1, 1] * Y + R[2, 1] * Z
    y2 = R[0, 2] * X + R[1, 2] * Y + R[2, 2] * Z
    if not y2 > 0.0:
        return False
    f_u, f_v, r = -s[0] / s[2], s[0] / s[3], R[2, 2]
    a, b = y0 / y2, y1 / y2
    du, dv = f_u * (r * a - R[2, 0]), f_v * (r * b - R[2, 1])
    x[0], x[1] = s[4] + du, s[5] + dv
    if not derivatives:
        return True
    # dx/dx_S
    gu, gv = f_u * r / y2, f_v * r / y2
    su0, su1, su2 = gu * (R[0, 0] - a * R[0, 2]), gu * (R[1, 0] - a * R[1, 2]), gu * (R[2, 0] - a * R[2, 2])
    sv0, sv1, sv2 = gv * (R[0, 1] - b * R[0, 2]), gv * (R[1, 1] - b * R[1, 2]), gv * (R[2, 1] - b * R[2, 2])
    # dx/dx_W = dx/dx_S R_WS
    wu, wv = (-su2, -su0, su1), (-sv2, -sv0, sv1)
    for i in range(3):
        G_T[0, i] = wu[0] * M[0, i] + wu[1] * M[1, i] + wu[2] * M[2, i]
        G_T[1, i] = wv[0] * M[0, i] + wv[1] * M[1, i] + wv[2] * M[2, i]
    for i in range(3):
        G_H[0, i] = G_T[0, 0] * R_HT[0, i] + G_T[0, 1] * R_HT[1, i] + G_T[0, 2] * R_HT[2, i]
        G_H[1, i] = G_T[1, 0] * R_HT[0, i] + G_T[1, 1] * R_HT[1, i] + G_T[1, 2] * R_HT[2, i]
    J_s[0, 0], J_s[1, 0] = du / s[0], dv / s[0]
    J_s[0, 1], J_s[1, 1] = su2, sv2
    J_s[0, 2], J_s[1, 2] = -du / s[2], 0.0
    J_s[0, 3], J_s[1, 3] = 0.0, -dv / s[3]
    J_s[0, 4], J_s[1, 4] = 1.0, 0.0
    J_s[0, 5], J_s[1, 5] = 0.0, 1.0
    _by_panel_angles(s[7], R, (X, Y, Z), (su0, su1, su2), (sv0, sv1, sv2), (f_u, a), (f_v, b), J_s)
    _by_table_axis(s[10], (z0, z1, z2), (m0, m1, m2), wu, wv, G_T, J_s)
    J_s[0, 12] = G_H[0, 0] * t_k[0] + G_H[0, 1] * t_k[1] + G_H[0, 2] * t_k[2]
    J_s[1, 12] = G_H[1, 0] * t_k[0] + G_H[1, 1] * t_k[1] + G_H[1, 2] * t_k[2]
    return True


@njit(cache=True, inline="always")
def _by_panel_angles(
    theta: float, R: Array, x_S: Three, su: Three, sv: Three, u: Two, v: Two, J_s: Array
) -> None:  # fmt: skip
    """Columns eta, theta, phi of J_s: dR = [n]_x R with n = R e_z, e_x, R_x(theta) e_y; dy = R^T (x_S x n).

    su, sv: dx/dx_S;  u, v: (f_u, y_1 / y_3), (f_v, y_2 / y_3).
    """
    X, Y, Z = x_S
    for k in range(3):
        if k == 0:
            n0, n1, n2 = R[0, 2], R[1, 2], R[2, 2]
        elif k == 1:
            n0, n1, n2 = 1.0, 0.0, 0.0
        else:
            n0, n1, n2 = 0.0, math.cos(theta), math.sin(theta)
        c0, c1, c2 = Y * n2 - Z * n1, Z * n0 - X * n2, X * n1 - Y * n0
        # row 3 of [n]_x R
        r0, r1, r2 = n0 * R[1, 0] - n1 * R[0, 0], n0 * R[1, 1] - n1 * R[0, 1], n0 * R[1, 2] - n1 * R[0, 2]
        J_s[0, 6 + k] = su[0] * c0 + su[1] * c1 + su[2] * c2 + u[0] * (r2 * u[1] - r0)
        J_s[1, 6 + k] = sv[0] * c0 + sv[1] * c1 + sv[2] * c2 + v[0] * (r2 * v[1] - r1)


@njit(cache=True, inline="always")
def _by_table_axis(tilt_x: float, z: Three, m: Three, wu: Three, wv: Three, G_T: Array, J_s: Array) -> None:
    """Columns axis_y, axis_tilt_x, axis_tilt_y of J_s: x_W = M z + o with o = (0, axis_y, 0), z = x_T - o, m = M z.

    wu, wv: dx/dx_W.  dM = [c]_x M - M [c]_x with c = e_x, then R_x(tilt_x) e_y.
    """
    J_s[0, 9] = wu[1] - G_T[0, 1]
    J_s[1, 9] = wv[1] - G_T[1, 1]
    for k in range(2):
        c0 = 1.0 if k == 0 else 0.0
        c1 = 0.0 if k == 0 else math.cos(tilt_x)
        c2 = 0.0 if k == 0 else math.sin(tilt_x)
        p0, p1, p2 = c1 * m[2] - c2 * m[1], c2 * m[0] - c0 * m[2], c0 * m[1] - c1 * m[0]
        q0, q1, q2 = c1 * z[2] - c2 * z[1], c2 * z[0] - c0 * z[2], c0 * z[1] - c1 * z[0]
        J_s[0, 10 + k] = wu[0] * p0 + wu[1] * p1 + wu[2] * p2 - G_T[0, 0] * q0 - G_T[0, 1] * q1 - G_T[0, 2] * q2
        J_s[1, 10 + k] = wv[0] * p0 + wv[1] * p1 + wv[2] * p2 - G_T[1, 0] * q0 - G_T[1, 1] * q1 - G_T[1, 2] * q2


@njit(cache=True, error_model="numpy")
def _project_all(
    s: Array,
    run: Any,
    R_HT: Array,
    t_HT: Array,
    R_k: Array,
    t_k: Array,
    t: Array,
    alpha: Array,
    derivatives: bool,
    found: Projected,
    J_w: Array,
) -> None:
    """found: x (n, 2), x_H, y_T (n, 3), G_H, G_T (n, 2, 3), J_s (n, 2, 13) of every pose, R, M (3, 3); J_w (n, 2, 3) =
    y_T x G_T, by a turn of the mount.

    Without `derivatives` one row of each array but x is enough.
    """
    x, x_H, y_T, G_H, G_T, J_s, R, M = found
    for k in range(R_k.shape[0]):
        i = k if derivatives else 0
        out = Projected(x[k], x_H[i], y_T[i], G_H[i], G_T[i], J_s[i], R, M)
        project_pose(s[run[k]], R_HT, t_HT, R_k[k], t_k[k], t[k], alpha[k], derivatives, out)
        for m in range(6 if derivatives else 0):
            e, j, a, b = m // 3, m % 3, (m + 1) % 3, (m + 2) % 3
            J_w[k, e, j] = y_T[i, a] * G_T[i, e, b] - y_T[i, b] * G_T[i, e, a]


def _space(n: int) -> Projected:
    """Arrays that `_project_all` writes n poses into: those that compiled code makes are slow to take over."""
    return Projected(
        x=np.full((n, 2), np.nan), x_H=np.empty((n, 3)), y_T=np.empty((n, 3)), G_H=np.zeros((n, 2, 3)),
        G_T=np.zeros((n, 2, 3)), J_s=np.zeros((n, 2, 13)), R=np.empty((3, 3)), M=np.empty((3, 3)),
    )  # fmt: skip


def projected_centres(
    s: Array, run: Any, R_HT: Array, t_HT: Array, R_MH: Array, t_MH: Array, t: Array, alpha: Array
) -> Array:
    """(n, 2) px: eq. (6) without derivatives; NaN where a ball is behind the source.

    s (runs, 13): `scanner_vector` of each run;  run: (n,) integers;  R_HT (3, 3), t_HT (3,);  R_MH (n, 3, 3), t_MH (n,
    3): the poses;  t: (n, 3) ball centres in M, mm;  alpha: (n,) rad.
    """
    found = _space(1)._replace(x=np.full((len(R_MH), 2), np.nan))
    given = (R_HT, t_HT, R_MH, t_MH, t, alpha)
    R_HT, t_HT, R_MH, t_MH, t, alpha = (np.ascontiguousarray(v, dtype=np.float64) for v in given)
    _project_all(s, run, R_HT, t_HT, R_MH, t_MH, t, alpha, NO, found, np.empty((1, 2, 3)))
    return found.x


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
    given = (T_HT.R, T_HT.t, T_MH.R, T_MH.t, np.broadcast_to(t, (n, 3)), np.broadcast_to(alpha, (n,)))
    # Copies: contiguous and writable, whatever was given, so that the kernel is compiled for one kind of array.
    R_HT, t_HT, R_MH, t_MH, t_k, angle = (np.array(x, dtype=np.float64, order="C") for x in given)
    index = np.zeros(n, dtype=np.int64) if run is None else np.array(run, dtype=np.int64)
    b, J_w = _space(n), np.zeros((n, 2, 3))
    _project_all(s, index, R_HT, t_HT, R_MH, t_MH, t_k, angle, YES, b, J_w)
    return ProjectionBlocks(
        x_D=b.x, J_w_HT=J_w, J_t_HT=b.G_T, J_t=b.G_H @ R_MH, J_scanner=b.J_s, x_H=b.x_H, t=t_k,
        R_MH=R_MH, G_H=b.G_H,
    )  # fmt: skip


def whiteners(covariance: Array) -> Array:
    """W (n, 2, 2) with W C W^T = 1: what turns residuals in px into residuals in standard deviations."""
    return np.linalg.inv(np.linalg.cholesky(covariance))
