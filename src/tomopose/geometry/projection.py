"""Eqs. (3), (5), (6): from points to pixels, and what a projection matrix says about source and panel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, OutOfViewError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array, float_array, rows_at
from tomopose.values import Column, Rows, value

PANEL_TOLERANCE = 1e-7
"""Largest relative skew and aspect error of a matrix that still counts as a flat panel of rectangular pixels."""


def project(P: ArrayLike, x: ArrayLike) -> Array:
    """Pixels (..., m, 2) of points x (m, 3), mm, under matrices P (..., 3, 4).  Eq. (2).  NaN where w <= 0."""
    P, x = np.asarray(P, dtype=np.float64), np.asarray(x, dtype=np.float64)
    h = np.einsum("...ij,mj->...mi", P[..., :3], x) + P[..., None, :, 3]
    w = h[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(w > 0, h[..., :2] / w, np.nan)


def project_ball(
    scanner: Scanner, *, T_HT: RigidTransform, T_MH: RigidTransform, t: ArrayLike, alpha: Array | float = 0.0
) -> Array:
    r"""Project the ball centre onto the detector, once per pose.  Eq. (6).

    Parameters
    ----------
    scanner:  intrinsic geometry, taken as known.
    T_HT:     manipulator base -> table; what calibration is for.
    T_MH:     moved plate -> manipulator base, one per pose k.
    t:        ball centre in M, mm, shape (3,), or (n, 3) where poses carry different balls.
    alpha:    table angle, rad; the paper holds it at 0.

    Returns
    -------
    x_D, shape (n, 2), px; (0, 0) is the centre of the bottom-left pixel.  NaN where the ball is behind the source.

    Raises
    ------
    FrameMismatchError
        If a transform joins other frames than its name says.
    """
    T_HT, T_MH = T_HT.require(Frame.H, Frame.T), T_MH.require(Frame.M, Frame.H)
    n = len(T_MH)
    t = np.broadcast_to(np.asarray(t, dtype=np.float64), (n, 3))
    T_TW = scanner.T_TW(np.broadcast_to(np.asarray(alpha, dtype=np.float64), (n,)))
    x_H = (T_MH.R @ t[:, :, None])[..., 0] + T_MH.t
    x_T = T_HT.apply(x_H)
    x_W = (T_TW.R @ x_T[:, :, None])[..., 0] + T_TW.t
    result: Array = project((scanner.P_S @ scanner.T_WS.matrix)[None], x_W)[0]
    return result


def object_motion(
    scanner: Scanner,
    *,
    T_HT: RigidTransform,
    T_MH: RigidTransform,
    alpha: Array | float = 0.0,
    home: RigidTransform | None = None,
) -> Array:
    """The motions (n, 4, 4) of the object from home to each pose, W -> W: the chain of eq. (5) without the scanner.

    Home is table angle 0 and manipulator at zero, so that x_W0 = home x_M; the printed T_HT^-1 of eq. (5) denotes
    the inverse of (T_TW,0 T_HT T_MH,0) with two identities.  home: another T_MH,0, such as a robot's working pose,
    whose zero is far from the scanner.
    """
    HT, MH = T_HT.require(Frame.H, Frame.T).matrix, T_MH.require(Frame.M, Frame.H).matrix
    at_home = np.eye(4) if home is None else home.require(Frame.M, Frame.H).matrix
    T_TW = scanner.T_TW(np.broadcast_to(np.asarray(alpha, dtype=np.float64), (len(MH),)))
    motion: Array = T_TW.matrix @ HT @ MH @ np.linalg.inv(scanner.T_TW(0.0).matrix @ HT @ at_home)
    return motion


def eq5_matrices(
    scanner: Scanner,
    *,
    T_HT: RigidTransform,
    T_MH: RigidTransform,
    alpha: Array | float = 0.0,
    home: RigidTransform | None = None,
) -> Array:
    """The matrices P_j (n, 3, 4) that take points of W, object at home, to pixels.  Eq. (5).

    home: as in `object_motion`.  |P[2, :3]| = 1 and w is the depth in mm.
    """
    motion = object_motion(scanner, T_HT=T_HT, T_MH=T_MH, alpha=alpha, home=home)
    return scanner.P_S @ (scanner.T_WS.matrix @ motion)


def canonical(P: ArrayLike, in_front: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """P scaled to |P[2, :3]| = 1 with w > 0 at the point `in_front` of W, mm.

    The origin is the field's convention (P[2, 3] > 0).  A robot that is behind the source puts the origin of W at
    home there too; a point of its object then gives the sign.
    """
    P = np.asarray(P, dtype=np.float64)
    if P.shape[-2:] != (3, 4):
        raise ShapeError(f"projection matrices are (n, 3, 4); got {P.shape}")
    if not np.isfinite(P).all():
        raise InputError("projection matrices hold values that are not finite")
    norm = np.linalg.norm(P[..., 2, :3], axis=-1)
    if (norm == 0).any():
        raise InputError(f"view {np.flatnonzero(norm == 0)[0]}: the third row of P is zero; not a cone-beam projection")
    depth = P[..., 2, :3] @ np.asarray(in_front, dtype=np.float64) + P[..., 2, 3]
    sign = np.where(depth < 0, -1.0, 1.0)
    # a matrix that was scaled once keeps its bits, so that a selection of views equals those of the whole
    norm = np.where(np.abs(norm - 1.0) <= 4 * np.finfo(np.float64).eps, 1.0, norm)
    result: Array = P * (sign / norm)[..., None, None]
    return result


@value
class ViewGeometry:
    """Source and panel of each view, in W, mm: what vector formats hold.

    source (n, 3); centre (n, 3) of the panel; U, V (n, 3): steps from pixel to pixel; d_SD (n,): along the panel
    normal; u_0, v_0 (n,): piercing point, px.
    """

    source: Array
    centre: Array
    U: Array
    V: Array
    d_SD: Array
    u_0: Array
    v_0: Array

    @property
    def normal(self) -> Array:
        """Unit vectors (n, 3) from the source towards the panel, at right angles to it."""
        n = np.cross(self.U, self.V)
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        sign = np.sign(np.einsum("ni,ni->n", n, self.centre - self.source))
        result: Array = n * sign[:, None]
        return result


def decompose(
    P: ArrayLike, *, n_u: int, n_v: int, p_u: float, p_v: float, in_front: ArrayLike = (0.0, 0.0, 0.0)
) -> ViewGeometry:
    """Source and panel of matrices P (n, 3, 4), given the panel's size and pitch; in_front as in `canonical`.

    P alone fixes only d_SD / pitch.  A matrix with skew or with an aspect that differs from p_u / p_v has no flat panel
    of that pitch: InputError names the view; nothing is rounded.
    """
    P = canonical(P, in_front)
    M_inv = np.linalg.inv(P[:, :, :3])
    a, b, c = M_inv[:, :, 0], M_inv[:, :, 1], M_inv[:, :, 2]
    len_a, len_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    d_u, d_v = p_u / len_a, p_v / len_b
    aspect = np.abs(d_u / d_v - 1)
    skewed = np.abs(np.einsum("ni,ni->n", a, b) / (len_a * len_b))
    for what, error in (("aspect ratio", aspect), ("skew", skewed)):
        bad = np.flatnonzero(error > PANEL_TOLERANCE)
        if bad.size:
            raise InputError(
                f"view {bad[0]}: {what} of P is off by {error[bad[0]]:.3g}; no flat panel with pixels of "
                f"{p_u:g} x {p_v:g} mm has this matrix ({bad.size} of {len(P)} views)"
            )
    D = (d_u + d_v) / 2
    source = -(M_inv @ P[:, :, 3:])[..., 0]
    U, V = D[:, None] * a, D[:, None] * b
    origin = source + D[:, None] * c
    return ViewGeometry(
        source=source,
        centre=origin + (n_u - 1) / 2 * U + (n_v - 1) / 2 * V,
        U=U,
        V=V,
        d_SD=D,
        u_0=-np.einsum("ni,ni->n", c, a) / len_a**2,
        v_0=-np.einsum("ni,ni->n", c, b) / len_b**2,
    )


def compose(source: ArrayLike, centre: ArrayLike, U: ArrayLike, V: ArrayLike, *, n_u: int, n_v: int) -> Array:
    """Matrices (n, 3, 4) of sources, panel centres and pixel steps (each (n, 3), mm): the inverse of `decompose`."""
    source, centre, U, V = (np.asarray(x, dtype=np.float64) for x in (source, centre, U, V))
    origin = centre - (n_u - 1) / 2 * U - (n_v - 1) / 2 * V
    M = np.linalg.inv(np.stack([U, V, origin - source], axis=-1))
    P = np.concatenate([M, -M @ source[..., None]], axis=-1)
    # The depth axis must point from the source to the panel; its sign is known here without looking at the W origin.
    result: Array = P / np.linalg.norm(P[:, 2, :3], axis=1)[:, None, None]
    return result


def row_flip(n_v: int) -> Array:
    """F (3, 3): pixel (u, v) to (u, n_v - 1 - v), for arrays whose row 0 is the top."""
    return np.array([[1.0, 0.0, 0.0], [0.0, -1.0, n_v - 1.0], [0.0, 0.0, 1.0]])


@value
class ProjectionMatrices(Rows):
    """Projection matrices of a scan: points of W (mm) to pixels of D.

    P: (n, 3, 4), kept at |P[2, :3]| = 1, w > 0.  n_u, n_v: detector size.  p_u, p_v: pitch, mm (P does not fix it).
    pose_id: n names.  points_sigma: (n, m) predicted standard uncertainty, px, of points over the field of view in the
    single view, where the calibration has a covariance.  points_sigma_shared: (n, m) the part of it that comes from the
    calibration and is shared by all views; the rest is the manipulator's scatter from pose to pose.  scanner: the
    scanner they were made for, where known.  in_front: (3,) mm, a point of W that lies in front of the source.
    """

    P: Array
    n_u: int
    n_v: int
    p_u: float
    p_v: float
    pose_id: tuple[str, ...]
    points_sigma: Array | None = None
    points_sigma_shared: Array | None = None
    scanner: Scanner | None = None
    in_front: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        in_front = float_array(self.in_front)
        if in_front.shape != (3,) or not np.isfinite(in_front).all():
            raise InputError(f"in_front is {self.in_front!r}; a point (x, y, z) of W in mm is needed")
        object.__setattr__(self, "in_front", in_front)
        P = np.asarray(self.P, dtype=np.float64)
        if P.ndim != 3:
            raise ShapeError(f"projection matrices are (n, 3, 4); got {P.shape}")
        P = float_array(canonical(P, in_front))
        if len(P) == 0:
            raise InputError("there are no projection matrices")
        if len(self.pose_id) != len(P):
            raise InputError(f"{len(P)} matrices but {len(self.pose_id)} pose ids")
        for name in ("n_u", "n_v"):
            value = getattr(self, name)
            if int(value) != value or value < 1:
                raise InputError(f"{name} is {value!r}; a positive whole number of pixels is needed")
        for name in ("p_u", "p_v"):
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value!r} mm; a positive pitch is needed")
        object.__setattr__(self, "P", P)
        object.__setattr__(self, "pose_id", tuple(str(i) for i in self.pose_id))
        for name in ("points_sigma", "points_sigma_shared"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, float_array(getattr(self, name)))

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> Array:
        return np.array(self.P, dtype=dtype)

    def columns(self) -> dict[str, Column]:
        """The twelve numbers of each view's matrix, row by row, and the predicted uncertainty where there is one."""
        columns: dict[str, Column] = {f"P_{i}{j}": self.P[:, i, j] for i in range(3) for j in range(4)}
        if self.points_sigma is not None:
            columns["points_sigma_rms_px"] = np.sqrt(np.mean(self.points_sigma**2, axis=1))
        return columns

    def project(self, x_W: ArrayLike) -> Array:
        """Pixels (n, m, 2) of points (m, 3) in W."""
        return project(self.P, x_W)

    def decompose(self) -> ViewGeometry:
        """Source and panel of each view."""
        return decompose(self.P, n_u=self.n_u, n_v=self.n_v, p_u=self.p_u, p_v=self.p_v, in_front=self.in_front)

    def top_first(self) -> Array:
        """The matrices for arrays whose row 0 is the top: F P."""
        return row_flip(self.n_v) @ self.P

    def select(self, index: object) -> ProjectionMatrices:
        """The views with those indices (or that mask or slice), in that order."""
        index = rows_at(len(self), index)
        return replace(
            self,
            P=self.P[index],
            pose_id=tuple(self.pose_id[i] for i in index),
            points_sigma=None if self.points_sigma is None else self.points_sigma[index],
            points_sigma_shared=None if self.points_sigma_shared is None else self.points_sigma_shared[index],
        )

    def binned(self, factor: int) -> ProjectionMatrices:
        """The matrices for images averaged over factor x factor pixels, by the rule of `Scanner.binned`."""
        if int(factor) != factor or factor < 1:
            raise InputError(f"binning factor is {factor!r}; a positive whole number is needed")
        B = np.array(
            [[1 / factor, 0, -(factor - 1) / 2 / factor], [0, 1 / factor, -(factor - 1) / 2 / factor], [0, 0, 1.0]]
        )
        return replace(
            self,
            P=B @ self.P,
            n_u=self.n_u // factor,
            n_v=self.n_v // factor,
            p_u=self.p_u * factor,
            p_v=self.p_v * factor,
            points_sigma=None if self.points_sigma is None else self.points_sigma / factor,
            points_sigma_shared=None if self.points_sigma_shared is None else self.points_sigma_shared / factor,
            scanner=None if self.scanner is None else self.scanner.binned(factor),
        )

    def require_in_front(self, x_W: ArrayLike) -> None:
        """OutOfViewError, naming the views, where points (m, 3) of W lie behind the source."""
        bad = np.flatnonzero(np.isnan(self.project(x_W)).any(axis=(1, 2)))
        if bad.size:
            raise OutOfViewError(
                f"{bad.size} views have points behind the source, first view {bad[0]}", indices=bad.tolist()
            )
