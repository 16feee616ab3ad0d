"""How large the silhouettes of balls should be, and how large they are: a gauge that the centres do not hold."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tomopose.calibration.model.covariance import median
from tomopose.calibration.model.problem import Problem
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.geometry.scanner import R_WS, Scanner, intrinsic_matrices
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Cameras:
    """at_angle (k, 3, 4): from T to pixels, of every run at each of its table angles;  beams (k, 4): direction of the
    beam in T and offset, which give a point's distance from the focal spot along it, mm;  alpha: the table angles of
    every run, rad;  which (n,): the place in these of every row;  d_SR (n,) mm;  source (3,): where the source is in T
    in the first pose, mm."""

    at_angle: Array
    beams: Array
    alpha: tuple[Array, ...]
    which: npt.NDArray[np.int64]
    d_SR: Array
    source: Array

    @classmethod
    def of(cls, problem: Problem) -> Cameras:
        """Of the scanners at the table angles of a problem."""
        alpha, run, which, k = [], [], np.empty(len(problem), dtype=np.int64), 0
        for r in range(len(problem.scanners)):
            mine = problem.run == r
            angles, place = np.unique(problem.alpha[mine], return_inverse=True)
            alpha.append(angles)
            run.append(np.full(len(angles), r))
            which[mine] = k + place.reshape(-1)
            k += len(angles)
        s = problem.s_0
        to_S = np.concatenate([_table_to_source(one[None], a)[0] for one, a in zip(s, alpha, strict=True)])
        first, runs = to_S[which[0]], np.concatenate(run)
        return cls(
            at_angle=_intrinsic(s)[runs] @ to_S,
            beams=to_S[:, 2],
            alpha=tuple(alpha),
            which=which,
            d_SR=s[runs[which], 1],
            source=-first[:, :3].T @ first[:, 3],
        )

    def seen_by(self, s: Array) -> Array:
        """(a, k, 3, 4): `at_angle` of scanners with other values, s (a, runs, 13) as of `scanner_vector`."""
        each = [_intrinsic(s[:, r])[:, None] @ _table_to_source(s[:, r], alpha) for r, alpha in enumerate(self.alpha)]
        return each[0] if len(each) == 1 else np.concatenate(each, axis=1)

    @property
    def P(self) -> Array:
        """(n, 3, 4): from T to pixels, of every row."""
        return np.asarray(self.at_angle[self.which])

    @property
    def beam(self) -> Array:
        """(n, 4): the beam of every row."""
        return np.asarray(self.beams[self.which])


def _intrinsic(s: Array) -> Array:
    """(a, 3, 3): from S to pixels, of scanner vectors s (a, 13)."""
    d_SD, _, p_u, p_v, u_0, v_0, eta, theta, phi = s.T[:9]
    return intrinsic_matrices(d_SD, p_u, p_v, u_0, v_0, R_x(theta) @ R_y(phi) @ R_z(eta))


def _table_to_source(s: Array, alpha: Array) -> Array:
    """(a, k, 3, 4): from T to S at table angles (k,), of scanner vectors s (a, 13); see `Scanner.T_TW`."""
    d_SR, (axis_y, tilt_x, tilt_y) = s[:, 1], s.T[9:12]
    axis = (R_x(tilt_x) @ R_y(tilt_y))[:, None]
    R = axis @ R_z(alpha) @ np.swapaxes(axis, -1, -2)
    t = axis_y[:, None, None] * (np.array([0.0, 1.0, 0.0]) - R[..., 1])
    T = np.empty((*R.shape[:2], 3, 4))
    T[..., :3], T[..., 3] = R_WS @ R, t @ R_WS.T
    T[..., 2, 3] += d_SR[:, None]
    return T


def chain_matrices(problem: Problem, scanners: tuple[Scanner, ...], T_HT: RigidTransform) -> Array:
    """(n, 3, 4): from the moved plate M to pixels, of every row's pose as reported."""
    T_MH = np.zeros((len(problem), 4, 4))
    T_MH[:, :3, :3], T_MH[:, :3, 3], T_MH[:, 3, 3] = problem.R_MH, problem.t_MH, 1.0
    return np.asarray(Cameras.of(replace(problem, scanners=scanners)).P @ T_HT.matrix @ T_MH)


def silhouette_outlines(P: Array, centres: Array, diameter: float) -> Array:
    """(n,) px^2: product of the semi axes of the silhouettes of balls at centres (n, 3), under P (n, 3, 4).

    The dual quadric of a sphere, x x^T - r^2 diag(1, 1, 1, 0), has the dual conic P Q P^T as its outline (Hartley and
    Zisserman, Multiple View Geometry, sec. 8.3), which gives the ellipse's centre and shape: with C = P Q P^T scaled to
    C_33 = 1, S = m m^T - C_12, where m is the upper part of its last column.
    """
    M = P[..., :3]
    return outlines_of(M @ np.swapaxes(M, -1, -2), (M @ centres[..., None])[..., 0] + P[..., 3], diameter)


def outlines_of(MM: Array, y: Array, diameter: float) -> Array:
    """The same of products M M^T (..., n, 3, 3) of the left parts M of the matrices, and images y (..., n, 3) of the
    centres, not divided by the depth."""
    quadric = (diameter / 2.0) ** 2
    B_aa, B_ab, B_ac, B_bb, B_bc, B_cc = (quadric * MM[..., i, j] for i, j in _UPPER)
    a, b, c = (y[..., i] for i in range(3))
    scale = 1.0 / (c * c - B_cc)
    m_a, m_b = (a * c - B_ac) * scale, (b * c - B_bc) * scale
    S_aa, S_bb = m_a * m_a - (a * a - B_aa) * scale, m_b * m_b - (b * b - B_bb) * scale
    S_ab = m_a * m_b - (a * b - B_ab) * scale
    outline: Array = np.sqrt(np.maximum(S_aa * S_bb - S_ab * S_ab, 0.0))
    return outline


_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def size_ratio_of(problem: Problem, P: Array, centres: Array, diameter: float | None = None) -> float | None:
    """Median over the rows of the measured size of the silhouette over the calculated one.

    P (n, 3, 4), centres (n, 3): of the ball of each row;  diameter: mm, in place of the problem's own.  None without
    outlines or without a diameter.
    """
    diameter = problem.ball_diameter if diameter is None else diameter
    if problem.outline is None or diameter is None:
        return None
    known = np.isfinite(problem.outline)
    if not known.any():
        return None
    measured = problem.outline
    if not known.all():
        measured, P, centres = measured[known], P[known], centres[known]
    calculated = silhouette_outlines(P, centres, diameter)
    with np.errstate(divide="ignore"):
        return float(np.sqrt(median(measured / calculated)))
