"""A start for eq. (7) from the data alone: no guess is ever asked for.

A pixel says that the ball lies on a known ray of the table frame T: two linear equations n . x_T + d = 0 each.  With
x_T = R_HT y_k + t_HT and y_k = R_MH t + t_MH taken at t = 0, a linear resection gives R_HT (nine numbers, projected on
SO(3)) and t_HT; with R_HT known, t_HT and t are linear together; the two steps are repeated.  Should the optimum that
is reached from there look poor, the 24 rotations of the cube and two turned copies of them serve as starts as well.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from tomopose.calibration.problem import Problem
from tomopose.units import Array

ROUNDS = 2
RANK_TOLERANCE = 1e-9
MOVED_SOURCE = 1e-3
"""The source counts as moved in T when it moves by more than this part of its distance."""


def ray_equations(problem: Problem) -> tuple[Array, Array]:
    """n (k, 2, 3), d (k, 2) with n . x_T + d = 0 for every pixel; divided by the depth, so that they count pixels."""
    n = np.empty((len(problem), 2, 3))
    d = np.empty((len(problem), 2))
    for r, scanner in enumerate(problem.scanners):
        mine = problem.run == r
        alpha, which = np.unique(problem.alpha[mine], return_inverse=True)
        P = (scanner.P_S @ (scanner.T_WS.matrix @ scanner.T_TW(alpha).matrix))[which.reshape(-1)]
        rows = P[:, :2] - problem.x_D[mine][:, :, None] * P[:, 2:]
        n[mine], d[mine] = rows[:, :, :3] / scanner.d_SR, rows[:, :, 3] / scanner.d_SR
    return n, d


def _solve(A: Array, b: Array) -> Array:
    """Least squares by normal equations, directions without information left at zero."""
    N, g = A.T @ A, A.T @ b
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    value, V = np.linalg.eigh(N * scale[:, None] * scale)
    good = value > RANK_TOLERANCE * value[-1]
    V = V[:, good]
    return scale * (V @ ((V.T @ (scale * g)) / value[good]))


def positions_for(problem: Problem, R_HT: Array, n: Array, d: Array) -> tuple[Array, Array]:
    """t_HT (3,) and t (balls, 3) that fit best under a given R_HT: linear."""
    k, n_b = len(problem), len(problem.ball_ids)
    nR = n @ R_HT
    A = np.zeros((k, 2, 3 + 3 * n_b))
    A[:, :, :3] = n
    column = 3 + 3 * problem.ball[:, None] + np.arange(3)
    np.put_along_axis(A, np.broadcast_to(column[:, None, :], (k, 2, 3)), nR @ problem.R_MH, axis=2)
    b = -d - (nR @ problem.t_MH[:, :, None])[..., 0]
    x = _solve(A.reshape(2 * k, -1), b.ravel())
    return x[:3], x[3:].reshape(n_b, 3)


def resection(problem: Problem, t: Array, n: Array, d: Array) -> Array:
    """R_HT (3, 3) from the linear resection with the balls taken at t (balls, 3).

    Written from one source position s, n . (A y + c) + l (n . s + d) = 0 with c = t_HT - l s is homogeneous in
    (A, c, l); l drops out where the source keeps its place in T, that is, while the table stands still.  A is a
    rotation but for its scale and sign, which det A > 0 settles: the mirrored solution is never taken.
    """
    y = np.einsum("kij,kj->ki", problem.R_MH, t[problem.ball]) + problem.t_MH
    k = len(problem)
    scanner = problem.scanners[problem.run[0]]
    source = (scanner.T_WS @ scanner.T_TW(float(problem.alpha[0]))).inv.t
    rest = n @ source + d
    columns = [(n[:, :, :, None] * y[:, None, None, :]).reshape(k, 2, 9), n]
    if np.abs(rest).max() > MOVED_SOURCE * np.linalg.norm(source) * np.abs(n).max():
        columns.append(rest[:, :, None])
    A = np.concatenate(columns, axis=2).reshape(2 * k, -1)
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("ij,ij->j", A, A), 1e-300))
    N = (A.T @ A) * scale[:, None] * scale
    x = scale * np.linalg.eigh(N)[1][:, 0]
    U, _, V = np.linalg.svd(x[:9].reshape(3, 3) * (np.sign(np.linalg.det(x[:9].reshape(3, 3))) or 1.0))
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))]) @ V


def closed_form(problem: Problem, n: Array, d: Array) -> tuple[Array, Array, Array]:
    """R_HT, t_HT, t by the alternation of the two linear steps."""
    t = np.zeros((len(problem.ball_ids), 3))
    for _ in range(ROUNDS):
        R_HT = resection(problem, t, n, d)
        t_HT, t = positions_for(problem, R_HT, n, d)
    return R_HT, t_HT, t


@functools.cache
def _cube_rotations() -> Array:
    """(72, 3, 3): the 24 rotations of the cube, then the same turned by 45 degrees about (1,1,1) and (1,-1,0)."""
    cube = Rotation.create_group("O").as_matrix()
    turns = [np.eye(3)]
    turns += [Rotation.from_rotvec(np.pi / 4 * np.array(a) / np.linalg.norm(a)).as_matrix() for a in
              ((1.0, 1.0, 1.0), (1.0, -1.0, 0.0))]
    return np.concatenate([cube @ turn for turn in turns])


def other_starts(problem: Problem, n: Array, d: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Starts from 72 rotations spread over SO(3), each with its best t_HT and t."""
    for R_HT in _cube_rotations():
        yield (R_HT, *positions_for(problem, R_HT, n, d))
