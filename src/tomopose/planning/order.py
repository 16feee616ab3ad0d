"""The order of the poses: short moves, and the first pose once more at the end."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tomopose.geometry.rotations import rotation_angle_between
from tomopose.manipulator.poses import PoseSequence
from tomopose.planning.limits import PlanLimits
from tomopose.units import Array

TWO_OPT_PASSES = 30


def move_times(poses: PoseSequence, limits: PlanLimits) -> Array:
    """(n, n) s from pose to pose: the slowest of translation, rotation and table, and settling."""
    T, alpha = poses.T_MH, poses.alpha
    way = np.linalg.norm(T.t[:, None] - T.t[None], axis=2) / limits.speed
    n = len(poses)
    turn = rotation_angle_between(np.repeat(T.R, n, axis=0), np.tile(T.R, (n, 1, 1))).reshape(n, n) / limits.turn_speed
    table = np.abs(alpha[:, None] - alpha[None]) / limits.table_speed
    result: Array = limits.settle + np.maximum(np.maximum(way, turn), table)
    return result


def short_tour(cost: Array, start: int = 0) -> Array:
    """A closed tour over all n from `start`: nearest neighbour, then 2-opt.  Deterministic."""
    n = len(cost)
    left = np.ones(n, dtype=bool)
    tour = [start]
    left[start] = False
    while left.any():
        row = np.where(left, cost[tour[-1]], np.inf)
        tour.append(int(row.argmin()))
        left[tour[-1]] = False
    order = np.array([*tour, start])
    for _ in range(TWO_OPT_PASSES):
        changed = False
        for i in range(n - 1):
            a, b = order[i], order[i + 1]
            c, d = order[i + 2 : -1], order[i + 3 :]
            if not len(d):
                continue
            gain = cost[a, b] + cost[c, d] - cost[a, c] - cost[b, d]
            k = int(gain.argmax())
            if gain[k] > 1e-9:
                order[i + 1 : i + 3 + k] = order[i + 1 : i + 3 + k][::-1]
                changed = True
        if not changed:
            break
    return order[:-1]


def run_time(poses: PoseSequence, limits: PlanLimits) -> float:
    """s, of all moves and images in the order given."""
    cost = move_times(poses, limits)
    k = np.arange(len(poses) - 1)
    return float(cost[k, k + 1].sum() + len(poses) * limits.image_time)


def ordered(poses: PoseSequence, limits: PlanLimits) -> PoseSequence:
    """The poses in a short order, named p000, p001, ...; begins and ends with a pose that is in them twice.

    Where none does, the pose nearest to home is taken once more.
    """
    cost = move_times(poses, limits)
    same = (cost <= limits.settle * (1 + 1e-9)) & ~np.eye(len(cost), dtype=bool)
    first = np.argwhere(same)
    if len(first):
        start, twin = (int(k) for k in first[0])
        rest = np.delete(np.arange(len(cost)), twin)
        tour = rest[short_tour(cost[np.ix_(rest, rest)], int(np.flatnonzero(rest == start)[0]))]
    else:
        home = np.linalg.norm(poses.T_MH.t, axis=1) + 2 * np.linalg.norm(poses.rotation_vectors(), axis=1)
        tour = short_tour(cost, int(home.argmin()))
    return rows_of(poses, [*tour, tour[0]])


def rows_of(poses: PoseSequence, rows: ArrayLike) -> PoseSequence:
    """Those rows as a sequence of set poses named p000, p001, ...; a row may come more than once."""
    index = np.asarray(rows, dtype=np.intp)
    alpha = poses.alpha
    return PoseSequence(
        T_MH=poses.T_MH[index],
        pose_id=tuple(f"p{k:03d}" for k in range(len(index))),
        alpha=alpha[index],
        pivot=poses.pivot,
        convention=poses.convention,
        source="set",
    )
