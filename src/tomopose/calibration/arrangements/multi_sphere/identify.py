"""Which circle of a radiograph is which ball of the standard, from one view alone or along the path.

A ball's radius on the panel gives its distance from the source to about a percent, so three circles are a triangle in
space.  Its sides select triples of the standard's balls; each gives a pose that is exact for its three centres, and the
pose under which most circles are balls wins.  Along the path the pose of the view before is tried first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

import numpy as np

from tomopose.calibration.arrangements.multi_sphere.standard import FEWEST_BALLS, SphereStandard
from tomopose.calibration.arrangements.multi_sphere.view_pose import pose_from_balls, refined_pose
from tomopose.errors import InputError, NotConvergedError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.point_motion import rigid_motion
from tomopose.geometry.projection import project
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array
from tomopose.values import value

DEPTH_PART = 0.01
"""Standard uncertainty of a distance from the source by a ball's radius: blur and transmission shift a rim by some
tenths of a pixel of thirty."""
SIDE_SIGMAS = 3.0
NEAR, CLOSE_PX = 1.0, 2.0
"""A circle within so many of its radii of a projected ball may be that ball; within CLOSE_PX it is."""
TRIPLES = 12
"""Triples of circles that are tried: one bad circle of six spoils half of them."""
MOST_SHARE, LEAST_SHARE = 0.7, 0.6
"""Share of the circles that must be balls: to end the search, and to accept its best."""
CLEAR_PX = 6.0
"""Least distance between the rims of two balls that both count, as in detection."""


class MeasuredBall(Protocol):
    """What detection says of one ball: centre (2,) px, its covariance (2, 2) px^2, radius px."""

    @property
    def x_D(self) -> Array: ...
    @property
    def covariance(self) -> Array: ...
    @property
    def radius(self) -> float: ...


@value
class Circles:
    """What was measured in one view: x_D (k, 2) px, covariance (k, 2, 2) px^2, radius (k,) px."""

    x_D: Array
    covariance: Array
    radius: Array

    def __len__(self) -> int:
        return len(self.x_D)

    @classmethod
    def of(cls, balls: Sequence[MeasuredBall]) -> Circles:
        """From the balls that detection measured in one radiograph."""
        return cls(
            x_D=np.array([b.x_D for b in balls]).reshape(-1, 2),
            covariance=np.array([b.covariance for b in balls]).reshape(-1, 2, 2),
            radius=np.array([b.radius for b in balls]),
        )


@dataclass(frozen=True, kw_only=True)
class Identified:
    """ball: (k,) index into the standard, -1 for a circle that is no ball of it;  T_MW: the pose it follows from."""

    ball: np.ndarray
    T_MW: RigidTransform

    @property
    def matched(self) -> int:
        return int((self.ball >= 0).sum())


def view_matrix(scanner: Scanner, T_MW: RigidTransform) -> Array:
    """(3, 4): points of M, mm, to pixels."""
    return np.asarray(scanner.P_S @ scanner.T_WS.matrix @ T_MW.matrix)


def identify(
    scanner: Scanner, circles: Circles, standard: SphereStandard, *, near: Sequence[RigidTransform] = ()
) -> Identified:
    """Which circle is which ball.

    near: poses M -> W to try first, as of the views before.

    Raises InputError where too few circles are there, where no pose explains most of them, or where two assignments
    explain them equally well.
    """
    if len(circles) < FEWEST_BALLS:
        raise InputError(f"{len(circles)} balls were measured; at least {FEWEST_BALLS} are needed")
    for T in near:
        found = _grown(scanner, circles, standard, T)
        if found is not None and found.matched >= max(FEWEST_BALLS, MOST_SHARE * len(circles)):
            return found
    best: list[Identified] = []
    for triple in _triples(circles):
        for T in _poses_of(scanner, circles, standard, triple):
            found = _grown(scanner, circles, standard, T)
            if found is not None:
                best = _ranked(best, found)
        if best and best[0].matched >= MOST_SHARE * len(circles):
            break
    if not best or best[0].matched < max(FEWEST_BALLS, LEAST_SHARE * len(circles)):
        most = best[0].matched if best else 0
        raise InputError(
            f"no pose of the standard explains the {len(circles)} circles of the view (the best {most}); are the "
            "coordinates, the diameters and the scanner's distances right?"
        )
    if len(best) > 1 and best[1].matched == best[0].matched:
        raise InputError(
            f"two poses of the standard explain {best[0].matched} of {len(circles)} circles equally well; the balls in "
            "view do not identify themselves"
        )
    return best[0]


def overlapping(scanner: Scanner, standard: SphereStandard, T_MW: RigidTransform) -> dict[int, int]:
    """Ball -> another ball whose image comes too near to its own, found or not."""
    P = view_matrix(scanner, T_MW)
    x = project(P[None], standard.centres)[0]
    depth = standard.centres @ P[2, :3] + P[2, 3]
    pitch = np.array([scanner.p_u, scanner.p_v])
    side = float(np.sqrt(pitch.prod()))
    radius = scanner.d_SD * standard.diameters / 2 / depth / side
    apart = np.linalg.norm((x[:, None] - x[None]) * pitch / side, axis=2)
    clear = radius[:, None] + radius[None] + CLEAR_PX
    np.fill_diagonal(clear, 0.0)
    hidden = apart < clear
    return {int(a): int(np.argmax(hidden[a])) for a in np.flatnonzero(hidden.any(axis=1))}


def _ranked(best: list[Identified], found: Identified) -> list[Identified]:
    """The two best different assignments."""
    if any(np.array_equal(found.ball, b.ball) for b in best):
        return best
    return sorted([*best, found], key=lambda f: -f.matched)[:2]


def _triples(circles: Circles) -> list[tuple[int, int, int]]:
    """Triples of circles with large triangles on the panel, no circle in more than half of them."""
    x = circles.x_D
    ranked = sorted(
        combinations(range(len(x)), 3),
        key=lambda t: -abs(float(np.cross([*(x[t[1]] - x[t[0]]), 0.0], [*(x[t[2]] - x[t[0]]), 0.0])[2])),
    )
    used = np.zeros(len(x), dtype=int)
    chosen = []
    for t in ranked:
        if used[list(t)].max() < TRIPLES // 2:
            chosen.append(t)
            used[list(t)] += 1
        if len(chosen) == TRIPLES:
            break
    return chosen


def _poses_of(
    scanner: Scanner, circles: Circles, standard: SphereStandard, triple: tuple[int, int, int]
) -> list[RigidTransform]:
    """Poses that bring three balls onto three circles, for all triples of balls whose sides fit."""
    rays = np.linalg.solve(scanner.P_S[:, :3], np.column_stack([circles.x_D[list(triple)], np.ones(3)]).T).T
    rays /= rays[:, 2:]
    side = np.sqrt(scanner.p_u * scanner.p_v)
    depth = scanner.d_SD * standard.diameters[None] / 2 / (circles.radius[list(triple), None] * side)
    x_S = rays[:, None] * depth[..., None]  # circle, ball that it may be, coordinate
    to_W = scanner.T_WS.inv
    D = np.linalg.norm(standard.centres[:, None] - standard.centres[None], axis=2)
    fits = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        length = np.linalg.norm(x_S[a][:, None] - x_S[b][None], axis=2)
        sigma = DEPTH_PART * np.sqrt(2.0) * float(depth[a].mean())
        fits.append((np.abs(length - D) < SIDE_SIGMAS * sigma) & ~np.eye(len(standard), dtype=bool))
    poses = []
    for i, j, k in np.argwhere(fits[0][:, :, None] & fits[1][:, None, :] & fits[2][None]):
        chosen = [int(i), int(j), int(k)]
        R, t = rigid_motion(standard.centres[chosen], to_W.apply(x_S[[0, 1, 2], chosen]))
        start = RigidTransform(R=R, t=t, source=Frame.M, target=Frame.W)
        T = refined_pose(scanner, circles.x_D[list(triple)], standard.centres[chosen], start)
        if T is not None:
            poses.append(T)
    return poses


def _grown(scanner: Scanner, circles: Circles, standard: SphereStandard, T: RigidTransform) -> Identified | None:
    """The assignment that a pose leads to: match what is near, solve, match what is close; None with too few."""
    for gate in (NEAR * circles.radius, NEAR * circles.radius, np.full(len(circles), CLOSE_PX)):
        ball = _matched(scanner, circles, standard, T, gate)
        mine = ball >= 0
        if mine.sum() < FEWEST_BALLS:
            return None
        try:
            T = pose_from_balls(scanner, circles.x_D[mine], standard.centres[ball[mine]], start=T).T_MW
        except (NotConvergedError, NotObservableError):
            return None
    ball = _matched(scanner, circles, standard, T, np.full(len(circles), CLOSE_PX))
    return Identified(ball=ball, T_MW=T)


def _matched(
    scanner: Scanner, circles: Circles, standard: SphereStandard, T: RigidTransform, gate: Array
) -> np.ndarray:
    """(k,) the ball that is projected nearest to each circle, within its gate, px, each ball once; else -1."""
    P = view_matrix(scanner, T)
    if (standard.centres @ P[2, :3] + P[2, 3] <= 0).any():
        return np.full(len(circles), -1)
    apart = np.linalg.norm(circles.x_D[:, None] - project(P[None], standard.centres)[0][None], axis=2)
    apart = np.where(apart < gate[:, None], apart, np.inf)
    out = np.full(len(circles), -1)
    while np.isfinite(apart).any():
        c, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
        out[c] = b
        apart[c, :], apart[:, b] = np.inf, np.inf
    return out
