"""A start for eq. (7) from the data alone: no guess is ever asked for.

A pixel says that the ball lies on a known ray of the table frame T: two linear equations n . x_T + d = 0 each.  With
x_T = R_HT y_k + t_HT and y_k = R_MH t + t_MH taken at t = 0, a linear resection gives R_HT (nine numbers, projected on
SO(3)) and t_HT; with R_HT known, t_HT and t are linear together; the two steps are repeated.  Should the optimum that
is reached from there look poor, the 24 rotations of the cube and two turned copies of them serve as starts as well.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from tomopose.calibration.model.problem import Problem
from tomopose.calibration.model.silhouettes import Cameras
from tomopose.calibration.model.tall import parts
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


def ray_equations(problem: Problem, cameras: Cameras | None = None) -> Rays:
    """The two planes through the source in which each observed centre lies; cameras: of the problem, where known."""
    c = Cameras.of(problem) if cameras is None else cameras
    rows = (c.P[:, :2] - problem.x_D[:, :, None] * c.P[:, 2:]) / c.d_SR[:, None, None]
    return Rays(n=np.ascontiguousarray(rows[:, :, :3]), d=np.ascontiguousarray(rows[:, :, 3]), source=c.source)


def _solve(N: Array, g: Array) -> Array:
    """N^-1 g, (a, m), of matrices N (a, m, m) and g (a, m); directions without information are left at zero."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("aii->ai", N), 1e-300))
    value, V = np.linalg.eigh(N * scale[:, :, None] * scale[:, None, :])
    good = value > RANK_TOLERANCE * value[:, -1:]
    z = np.where(good, np.einsum("aij,ai->aj", V, scale * g) / np.where(good, value, 1.0), 0.0)
    return np.asarray(scale * (V @ z[:, :, None])[..., 0])


@dataclass(frozen=True, kw_only=True)
class _Stack:
    """Several readings of k images each: poses R (a, k, 3, 3), t (a, k, 3), ball (a, k) of `balls`; rays n (a, k, 2,
    3), d (a, k, 2), source (a, 3)."""

    R: Array
    t: Array
    ball: npt.NDArray[np.int64]
    balls: int
    n: Array
    d: Array
    source: Array

    @classmethod
    def of(cls, problems: Sequence[Problem], rays: Sequence[Rays], rows: Sequence[npt.NDArray[np.int64]]) -> _Stack:
        """The rows (k,) of problems that have equally many balls."""
        each = list(zip(problems, rays, rows, strict=True))
        return cls(
            R=np.stack([p.R_MH[k] for p, _, k in each]),
            t=np.stack([p.t_MH[k] for p, _, k in each]),
            ball=np.stack([p.ball[k] for p, _, k in each]),
            balls=len(problems[0].ball_ids),
            n=np.stack([r.n[k] for _, r, k in each]),
            d=np.stack([r.d[k] for _, r, k in each]),
            source=np.stack([r.source for r in rays]),
        )


def _positions(s: _Stack, R_HT: Array) -> tuple[Array, Array]:
    """t_HT (a, 3) and t (a, balls, 3) that fit best under given R_HT (a, 3, 3): linear."""
    a, k = s.t.shape[:2]
    m = 3 + 3 * s.balls
    N, g = np.zeros((a, m, m)), np.zeros((a, m))
    for some in parts(k):
        n, R = s.n[:, some], s.R[:, some]
        size = n.shape[1]
        nR = (n.reshape(a, 2 * size, 3) @ R_HT).reshape(a, size, 2, 3)
        A: Array = np.zeros((a, size, 2, m))
        A[..., :3] = n
        if s.balls == 1:
            A[..., 3:] = nR @ R
        else:
            column = 3 + 3 * s.ball[:, some, None] + np.arange(3)
            np.put_along_axis(A, np.broadcast_to(column[:, :, None, :], (a, size, 2, 3)), nR @ R, axis=3)
        b = -s.d[:, some] - (nR @ s.t[:, some, :, None])[..., 0]
        A = A.reshape(a, 2 * size, m)
        At = np.swapaxes(A, 1, 2)
        N += At @ A
        g += (At @ b.reshape(a, 2 * size, 1))[..., 0]
    x = _solve(N, g)
    return x[:, :3], x[:, 3:].reshape(a, s.balls, 3)


def positions_for(
    problem: Problem, R_HT: Array, rays: Rays, rows: npt.NDArray[np.int64] | None = None
) -> tuple[Array, Array]:
    """t_HT (3,) and t (balls, 3) that fit some rows (k,), or all, best under a given R_HT: linear."""
    some = np.arange(len(problem)) if rows is None else rows
    t_HT, t = _positions(_Stack.of([problem], [rays], [some]), R_HT[None])
    return t_HT[0], t[0]


def _resections(s: _Stack, t: Array) -> Array:
    """R_HT (a, 3, 3) from the linear resection with the balls taken at t (a, balls, 3).

    Written from one source position s, n . (A y + c) + l (n . s + d) = 0 with c = t_HT - l s is homogeneous in
    (A, c, l); l drops out where the source keeps its place in T, that is, while the table does not move.  A is a
    rotation except for its scale and sign, which det A > 0 settles: the mirrored solution is never taken.
    """
    a, k = s.t.shape[:2]
    y = (s.R @ np.take_along_axis(t, s.ball[:, :, None], axis=1)[..., None])[..., 0] + s.t
    rest = (s.n @ s.source[:, None, :, None])[..., 0] + s.d
    far = np.linalg.norm(s.source, axis=1) * np.abs(s.n).max(axis=(1, 2, 3))
    moved = np.abs(rest).max(axis=(1, 2)) > MOVED_SOURCE * far
    A: Array = np.empty((a, k, 2, 13))
    A[..., :9] = (s.n[..., :, None] * y[:, :, None, None, :]).reshape(a, k, 2, 9)
    A[..., 9:12] = s.n
    A[..., 12] = rest
    A = A.reshape(a, 2 * k, 13)
    N = np.swapaxes(A, 1, 2) @ A
    B = np.empty((a, 3, 3))
    for which, m in ((moved, 13), (~moved, 12)):
        if which.any():
            part = N[which, :m, :m]
            scale = 1.0 / np.sqrt(np.maximum(np.einsum("aii->ai", part), 1e-300))
            V = np.linalg.eigh(part * scale[:, :, None] * scale[:, None, :])[1]
            B[which] = (scale * V[:, :, 0])[:, :9].reshape(-1, 3, 3)
    U, _, V = np.linalg.svd(np.where(np.linalg.det(B) < 0, -1.0, 1.0)[:, None, None] * B)
    # of (nearly) flat data the sign of det may still be lost
    U[:, :, 2] *= np.where(np.linalg.det(U @ V) > 0, 1.0, -1.0)[:, None]
    return np.asarray(U @ V)


def closed_forms(
    problems: Sequence[Problem], rays: Sequence[Rays], rows: Sequence[npt.NDArray[np.int64]]
) -> list[tuple[Array, Array, Array]]:
    """R_HT, t_HT, t of each by the alternation of the two linear steps, from rows (k,) of it, equally many of each."""
    s = _Stack.of(problems, rays, rows)
    t = np.zeros((len(problems), s.balls, 3))
    for _ in range(ROUNDS):
        R_HT = _resections(s, t)
        t_HT, t = _positions(s, R_HT)
    return list(zip(R_HT, t_HT, t, strict=True))


def closed_form(problem: Problem, rays: Rays) -> tuple[Array, Array, Array]:
    """R_HT, t_HT, t by the alternation of the two linear steps."""
    return closed_forms([problem], [rays], [np.arange(len(problem))])[0]


def turned_about_beam(
    problem: Problem, R_HT: Array, rays: Rays, rows: npt.NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """The start half a turn about the beam from R_HT, by some rows (k,): what the closed form of nearly flat data may
    land on behind the source, since only the weak change of magnification distinguishes the two."""
    beam = rays.source / np.linalg.norm(rays.source)
    turned = (2 * np.outer(beam, beam) - np.eye(3)) @ R_HT
    return (turned, *positions_for(problem, turned, rays, rows))


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
