"""How large the silhouettes of balls should be, and how large they are: a gauge that the centres do not hold."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tomopose.calibration.model.covariance import median
from tomopose.calibration.model.problem import Problem
from tomopose.geometry.scanner import R_WS, Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Cameras:
    """at_angle (k, 3, 4): from T to pixels, of every run at each of its table angles;  beams (k, 4): direction of the
    beam in T and offset, which give a point's distance from the focal spot along it, mm;  alpha (k,) rad, run (k,): of
    these;  which (n,): the one of every row;  d_SR (n,) mm;  source (3,): where the source is in T in the first pose,
    mm."""

    at_angle: Array
    beams: Array
    alpha: Array
    run: npt.NDArray[np.int64]
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
        return cls._seen(problem.scanners, np.concatenate(alpha), np.concatenate(run), which)

    @classmethod
    def _seen(
        cls,
        scanners: tuple[Scanner, ...],
        alpha: Array,
        run: npt.NDArray[np.int64],
        which: npt.NDArray[np.int64],
    ) -> Cameras:
        P, beams, source = np.empty((len(alpha), 3, 4)), np.empty((len(alpha), 4)), np.zeros(3)
        first = which[0]
        for r, scanner in enumerate(scanners):
            mine = run == r
            T_TW = scanner.T_TW(alpha[mine])
            to_S = R_WS @ np.concatenate([T_TW.R, T_TW.t[:, :, None]], axis=2)
            to_S[:, 2, 3] += scanner.d_SR
            P[mine], beams[mine] = scanner.K @ to_S, to_S[:, 2]
            if r == run[first]:
                own = to_S[first - np.flatnonzero(mine)[0]]
                source = -own[:, :3].T @ own[:, 3]
        d_SR = np.array([s.d_SR for s in scanners])[run][which]
        return cls(at_angle=P, beams=beams, alpha=alpha, run=run, which=which, d_SR=d_SR, source=source)

    def with_scanners(self, scanners: tuple[Scanner, ...]) -> Cameras:
        """The same table angles seen by scanners with other values."""
        return self._seen(scanners, self.alpha, self.run, self.which)

    @property
    def P(self) -> Array:
        """(n, 3, 4): from T to pixels, of every row."""
        return np.asarray(self.at_angle[self.which])

    @property
    def beam(self) -> Array:
        """(n, 4): the beam of every row."""
        return np.asarray(self.beams[self.which])


def chain_matrices(problem: Problem, scanners: tuple[Scanner, ...], T_HT: RigidTransform) -> Array:
    """(n, 3, 4): from the moved plate M to pixels, of every row's pose as reported."""
    T_MH = np.zeros((len(problem), 4, 4))
    T_MH[:, :3, :3], T_MH[:, :3, 3], T_MH[:, 3, 3] = problem.R_MH, problem.t_MH, 1.0
    return np.asarray(Cameras.of(replace(problem, scanners=scanners)).P @ T_HT.matrix @ T_MH)


def silhouette_outlines(P: Array, centres: Array, diameter: float, which: npt.NDArray[np.int64] | None = None) -> Array:
    """(n,) px^2: product of the semi axes of the silhouettes of balls at centres (n, 3), under P (n, 3, 4), or (k, 3,
    4) where `which` (n,) names the one of every ball.

    The dual quadric of a sphere, x x^T - r^2 diag(1, 1, 1, 0), has the dual conic P Q P^T as its outline (Hartley and
    Zisserman, Multiple View Geometry, sec. 8.3), which gives the ellipse's centre and shape: with C = P Q P^T scaled to
    C_33 = 1, S = m m^T - C_12, where m is the upper part of its last column.
    """
    M = P[:, :, :3]
    B = (diameter / 2.0) ** 2 * (M @ np.swapaxes(M, 1, 2))
    if which is not None:
        P, B = P[which], B[which]
    y = (P[:, :, :3] @ centres[:, :, None])[..., 0] + P[:, :, 3]
    a, b, c = y.T
    B_aa, B_ab, B_ac, B_bb, B_bc, B_cc = (B[:, i, j] for i, j in _UPPER)
    scale = 1.0 / (c * c - B_cc)
    m_a, m_b = (a * c - B_ac) * scale, (b * c - B_bc) * scale
    S_aa, S_bb = m_a * m_a - (a * a - B_aa) * scale, m_b * m_b - (b * b - B_bb) * scale
    S_ab = m_a * m_b - (a * b - B_ab) * scale
    outline: Array = np.sqrt(np.maximum(S_aa * S_bb - S_ab * S_ab, 0.0))
    return outline


_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def size_ratio_of(
    problem: Problem,
    P: Array,
    centres: Array,
    diameter: float | None = None,
    which: npt.NDArray[np.int64] | None = None,
) -> float | None:
    """Median over the rows of the measured size of the silhouette over the calculated one.

    P, centres (n, 3), which: as of `silhouette_outlines`, of the ball of each row;  diameter: mm, in place of the
    problem's own.  None without outlines or without a diameter.
    """
    diameter = problem.ball_diameter if diameter is None else diameter
    if problem.outline is None or diameter is None:
        return None
    known = np.isfinite(problem.outline)
    if not known.any():
        return None
    measured = problem.outline
    if not known.all():
        measured, centres = measured[known], centres[known]
        P, which = (P[known], None) if which is None else (P, which[known])
    calculated = silhouette_outlines(P, centres, diameter, which)
    with np.errstate(divide="ignore"):
        return float(np.sqrt(median(measured / calculated)))
