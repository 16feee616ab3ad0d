"""In which order the views are taken: the least travel, and what fits in the time."""

from __future__ import annotations

import numpy as np

from tomopose.planning.order import short_tour
from tomopose.planning.part_scan.limits_file import MoveTime
from tomopose.planning.part_scan.stations import Machine
from tomopose.units import Array

HALF_TURN = np.pi


def steps(machine: Machine, a: Array, b: Array) -> Array:
    """(..., 7) by how much each axis moves from a to b, mm and deg; a free table takes the shorter way."""
    d = np.abs(b - a)
    if machine.turns_freely:
        d[..., 6] = HALF_TURN - np.abs(np.mod(d[..., 6], 2 * HALF_TURN) - HALF_TURN)
    d[..., 3:] = np.degrees(d[..., 3:])
    return d


def travel(machine: Machine, q: Array) -> float:
    """Sum over the steps and axes of a sequence q (n, 7), mm + deg."""
    return float(steps(machine, q[:-1], q[1:]).sum())


def _moves(machine: Machine, time: MoveTime, q: Array) -> Array:
    """(n - 1,) s that the slowest axis takes from each place of q (n, 7) to the next."""
    moves: Array = (steps(machine, q[:-1], q[1:]) / np.array([time.speed] * 3 + [time.speed_deg] * 4)).max(axis=1)
    return moves


def duration(machine: Machine, time: MoveTime, q: Array) -> float:
    """s: of every step the slowest axis and settling, and the images."""
    moves = _moves(machine, time, q)
    return float(moves.sum() + len(moves) * time.settle + len(q) * time.image)


def turn_duration(machine: Machine, time: MoveTime, q: Array) -> float:
    """s: without stops; each step takes as long as its slowest axis or its image, whichever is longer."""
    return float(np.maximum(_moves(machine, time, q), time.image).sum() + time.image)


def visiting_order(machine: Machine, q: Array) -> np.ndarray:
    """(n,) rows of q (n, 7) in a short order that begins nearest to the machine's present place: zero, or its limits.

    Nearest neighbour, then 2-opt, on a path that need not return; never longer than the order given.
    """
    if len(q) < 3:
        return np.arange(len(q))
    cost = steps(machine, q[:, None], q[None]).sum(axis=2)
    home = machine.clipped(np.zeros((1, 7)))
    start = int(steps(machine, home, q).sum(axis=1).argmin())
    # a last stop at no cost from anywhere makes the closed tour an open path
    open_cost = np.zeros((len(q) + 1, len(q) + 1))
    open_cost[:-1, :-1] = cost
    tour = short_tour(open_cost, start)
    at = int(np.flatnonzero(tour == len(q))[0])
    order = np.concatenate([tour[at + 1 :], tour[:at]])
    if travel(machine, q[order]) > travel(machine, q):
        return np.arange(len(q))
    return order
