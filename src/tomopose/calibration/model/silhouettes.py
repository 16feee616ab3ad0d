"""How large the silhouettes of balls should be, and how large they are: a gauge that the centres do not hold."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.model.problem import Problem
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Cameras:
    """P (n, 3, 4): from T to pixels, of every row;  d_SR (n,) mm;  source (3,): where the
    source is in T in the first pose, mm."""

    P: Array
    d_SR: Array
    source: Array

    @classmethod
    def of(cls, problem: Problem) -> Cameras:
        """Of the scanners at the table angles of a problem."""
        P, d_SR, source = np.empty((len(problem), 3, 4)), np.empty(len(problem)), np.zeros(3)
        for r, scanner in enumerate(problem.scanners):
            alone = len(problem.scanners) == 1
            mine = slice(None) if alone else problem.run == r
            alpha, which = np.unique(problem.alpha[mine], return_inverse=True)
            T_WS, T_TW = scanner.T_WS.matrix, scanner.T_TW(alpha)
            P[mine] = (scanner.P_S @ T_WS @ T_TW.matrix)[which.reshape(-1)]
            d_SR[mine] = scanner.d_SR
            if r == problem.run[0]:
                first = int(which.reshape(-1)[0])
                at_W = -T_WS[:3, :3].T @ T_WS[:3, 3]
                source = T_TW.R[first].T @ (at_W - T_TW.t[first])
        return cls(P=P, d_SR=d_SR, source=source)


def chain_matrices(problem: Problem, scanners: tuple[Scanner, ...], T_HT: RigidTransform) -> Array:
    """(n, 3, 4): from the moved plate M to pixels, of every row's pose as reported."""
    T_MH = np.zeros((len(problem), 4, 4))
    T_MH[:, :3, :3], T_MH[:, :3, 3], T_MH[:, 3, 3] = problem.R_MH, problem.t_MH, 1.0
    return np.asarray(Cameras.of(replace(problem, scanners=scanners)).P @ T_HT.matrix @ T_MH)


def silhouette_outlines(P: Array, centres: Array, diameter: float) -> Array:
    """(n,) px^2: product of the semi axes of the silhouettes of balls at centres (n, 3), under P (n, 3, 4).

    The dual quadric of a sphere, x x^T - r^2 diag(1, 1, 1, 0), has the dual conic P Q P^T as its outline (Hartley and
    Zisserman, Multiple View Geometry, sec. 8.3), which gives the ellipse's centre and shape.
    """
    M = P[:, :, :3]
    y = (M @ centres[:, :, None])[..., 0] + P[:, :, 3]
    C = y[:, :, None] * y[:, None, :] - (diameter / 2.0) ** 2 * (M @ np.swapaxes(M, 1, 2))
    C = C / C[:, 2:, 2:]
    m = C[:, :2, 2]
    S = m[:, :, None] * m[:, None, :] - C[:, :2, :2]
    outline: Array = np.sqrt(np.maximum(S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0], 0.0))
    return outline


def size_ratio_of(problem: Problem, P: Array, centres: Array, diameter: float | None = None) -> float | None:
    """Median over the rows of the measured size of the silhouette over the calculated one.

    P (n, 3, 4): from the balls' frame to pixels;  centres (n, 3): of the ball of each row;  diameter: mm, in place of
    the problem's own.  None without outlines or without a diameter.
    """
    diameter = problem.ball_diameter if diameter is None else diameter
    if problem.outline is None or diameter is None:
        return None
    known = np.isfinite(problem.outline)
    if not known.any():
        return None
    calculated = silhouette_outlines(P[known], centres[known], diameter)
    with np.errstate(divide="ignore"):
        return float(np.sqrt(np.median(problem.outline[known] / calculated)))
