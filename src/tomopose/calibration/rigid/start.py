"""A start for eq. (7) from the data alone: no guess is ever asked for.

A pixel says that the ball lies on a known ray of the table frame T: two linear equations n . x_T + d = 0 each.  With
x_T = R_HT y_k + t_HT and y_k = R_MH t + t_MH taken at t = 0, a linear resection gives R_HT (nine numbers, projected on
SO(3)) and t_HT; with R_HT known, t_HT and t are linear together; the two steps are repeated.  Should the optimum that
is reached from there look poor, the 24 rotations of the cube and two turned copies of them serve as starts as well.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tomopose.calibration.model.problem import Problem
from tomopose.units import Array

ROUNDS = 2
RANK_TOLERANCE = 1e-9
MOVED_SOURCE = 1e-3
"""The source counts as moved in T when it moves by more than this part of its distance."""


@dataclass(frozen=True, kw_only=True)
class Rays:
    """n (k, 2, 3), d (k, 2): n . x_T + d = 0 for every pixel, divided by the depth so that they count pixels;
    source (3,): where the source is in T in the first pose, mm."""

    n: Array
    d: Array
    source: Array


def ray_equations(problem: Problem) -> Rays:
    """The two planes through the source in which each observed centre lies."""
    n, d = np.empty((len(problem), 2, 3)), np.empty((len(problem), 2))
    source = np.zeros(3)
    for r, scanner in enumerate(problem.scanners):
        alone = len(problem.scanners) == 1
        mine = slice(None) if alone else problem.run == r
        alpha, which = np.unique(problem.alpha[mine], return_inverse=True)
        T_WS, T_TW = scanner.T_WS.matrix, scanner.T_TW(alpha)
        P = (scanner.P_S @ T_WS @ T_TW.matrix)[which.reshape(-1)]
        rows = P[:, :2] - problem.x_D[mine][:, :, None] * P[:, 2:]
        n[mine], d[mine] = rows[:, :, :3] / scanner.d_SR, rows[:, :, 3] / scanner.d_SR
        if r == problem.run[0]:
            first = int(which.reshape(-1)[0])
            at_W = -T_WS[:3, :3].T @ T_WS[:3, 3]
            source = T_TW.R[first].T @ (at_W - T_TW.t[first])
    return Rays(n=n, d=d, source=source)


def _solve(N: Array, g: Array) -> Array:
    """N^-1 g, directions without information left at zero."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    value, V = np.linalg.eigh(N * scale[:, None] * scale)
    good = value > RANK_TOLERANCE * value[-1]
    V = V[:, good]
    result: Array = scale * (V @ ((V.T @ (scale * g)) / value[good]))
    return result


def positions_for(problem: Problem, R_HT: Array, rays: Rays) -> tuple[Array, Array]:
    """t_HT (3,) and t (balls, 3) that fit best under a given R_HT: linear."""
    k, n_b = len(problem), len(problem.ball_ids)
    nR = rays.n @ R_HT
    A: Array = np.zeros((k, 2, 3 + 3 * n_b))
    A[:, :, :3] = rays.n
    if n_b == 1:
        A[:, :, 3:] = nR @ problem.R_MH
    else:
        column = 3 + 3 * problem.ball[:, None] + np.arange(3)
        np.put_along_axis(A, np.broadcast_to(column[:, None, :], (k, 2, 3)), nR @ problem.R_MH, axis=2)
    b = -rays.d - (nR @ problem.t_MH[:, :, None])[..., 0]
    A = A.reshape(2 * k, -1)
    x = _solve(A.T @ A, A.T @ b.ravel())
    return x[:3], x[3:].reshape(n_b, 3)


def resection(problem: Problem, t: Array, rays: Rays) -> Array:
    """R_HT (3, 3) from the linear resection with the balls taken at t (balls, 3).

    Written from one source position s, n . (A y + c) + l (n . s + d) = 0 with c = t_HT - l s is homogeneous in
    (A, c, l); l drops out where the source keeps its place in T, that is, while the table does not move.  A is a
    rotation except for its scale and sign, which det A > 0 settles: the mirrored solution is never taken.
    """
    n = rays.n
    y = (problem.R_MH @ t[problem.ball][:, :, None])[..., 0] + problem.t_MH
    k = len(problem)
    rest = n @ rays.source + rays.d
    moved = np.abs(rest).max() > MOVED_SOURCE * np.linalg.norm(rays.source) * np.abs(n).max()
    A: Array = np.empty((k, 2, 13 if moved else 12))
    A[:, :, :9] = (n[:, :, :, None] * y[:, None, None, :]).reshape(k, 2, 9)
    A[:, :, 9:12] = n
    if moved:
        A[:, :, 12] = rest
    A = A.reshape(2 * k, -1)
    N = A.T @ A
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    x = scale * np.linalg.eigh(N * scale[:, None] * scale)[1][:, 0]
    B = x[:9].reshape(3, 3)
    U, _, V = np.linalg.svd(-B if np.linalg.det(B) < 0 else B)
    # of (nearly) flat data the sign of det may still be lost
    result: Array = U @ V if np.linalg.det(U @ V) > 0 else U @ np.diag([1.0, 1.0, -1.0]) @ V
    return result


def closed_form(problem: Problem, rays: Rays) -> tuple[Array, Array, Array]:
    """R_HT, t_HT, t by the alternation of the two linear steps."""
    t = np.zeros((len(problem.ball_ids), 3))
    for _ in range(ROUNDS):
        R_HT = resection(problem, t, rays)
        t_HT, t = positions_for(problem, R_HT, rays)
    return R_HT, t_HT, t


def turned_about_beam(problem: Problem, R_HT: Array, rays: Rays) -> tuple[Array, Array, Array]:
    """The start half a turn about the beam from R_HT: what the closed form of nearly flat data may land on behind the
    source, since only the weak change of magnification distinguishes the two."""
    beam = rays.source / np.linalg.norm(rays.source)
    turned = (2 * np.outer(beam, beam) - np.eye(3)) @ R_HT
    return (turned, *positions_for(problem, turned, rays))


@functools.cache
def _cube_rotations() -> Array:
    """(72, 3, 3): the 24 rotations of the cube, then the same turned by 45 degrees about (1,1,1) and (1,-1,0)."""
    cube = Rotation.create_group("O").as_matrix()
    turns = [np.eye(3)]
    turns += [
        Rotation.from_rotvec(np.pi / 4 * np.array(a) / np.linalg.norm(a)).as_matrix()
        for a in ((1.0, 1.0, 1.0), (1.0, -1.0, 0.0))
    ]
    return np.concatenate([cube @ turn for turn in turns])


def other_starts(problem: Problem, rays: Rays) -> Iterator[tuple[Array, Array, Array]]:
    """Starts from 72 rotations spread over SO(3), each with its best t_HT and t."""
    for R_HT in _cube_rotations():
        yield (R_HT, *positions_for(problem, R_HT, rays))
