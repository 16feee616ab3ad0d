"""The usual paths with as many views and within the same limits: circular, triangle (eq. 11) and sine (sec. 6.1)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from tomopose.geometry.rotations import R_z, convention_from_rotation
from tomopose.planning.part_scan.stations import FULL_TURN, Machine, shared, turns
from tomopose.trajectory.feasibility import TOLERANCE
from tomopose.trajectory.tilt import eq10_rotation, sine_wave, triangle_wave
from tomopose.units import Array

PERIODS = 7
TRIANGLE, SINE, SINE_OFFSET = math.radians(8.0), math.radians(4.0), math.radians(1.0)
HALVINGS = 30


def usual_paths(machine: Machine, N: int) -> dict[str, Array]:
    """Axes (N, 7) of each path; tilts are scaled down until all axes are within the limits."""
    waves: dict[str, Callable[[Array, float], Array]] = {
        "circular": lambda alpha, share: 0.0 * alpha,
        "triangle": lambda alpha, share: share * partial(triangle_wave, amplitude=TRIANGLE, periods=PERIODS)(alpha),
        "sine": lambda alpha, share: share * sine_wave(alpha, amplitude=SINE, periods=PERIODS, offset=SINE_OFFSET),
    }
    return {name: _largest(machine, N, wave) for name, wave in waves.items()}


def _largest(machine: Machine, N: int, wave: Callable[[Array, float], Array]) -> Array:
    turn = turns(machine, FULL_TURN / N)
    if len(turn) != N:
        turn = np.linspace(turn[0], turn[-1], N)
    alpha, rz = shared(machine, turn)

    def axes(share: float) -> Array:
        q = np.zeros((N, 7))
        R = eq10_rotation(alpha, wave(turn, share), machine.T_HT.R) @ R_z(rz)
        q[:, 3:6] = np.radians(convention_from_rotation(R, "pi-hexapod"))
        q[:, 6] = alpha
        # axes that may not be at zero take the nearest value that they may have
        q[:, :3] = np.clip(q[:, :3], machine.limits.low[:3], machine.limits.high[:3])
        return q

    def inside(q: Array) -> bool:
        low, high = machine.limits.low[:6] - TOLERANCE, machine.limits.high[:6] + TOLERANCE
        return bool(((q[:, :6] >= low) & (q[:, :6] <= high)).all())

    fits, fails = 0.0, 1.0
    if inside(axes(1.0)):
        return axes(1.0)
    for _ in range(HALVINGS):
        middle = (fits + fails) / 2
        fits, fails = (middle, fails) if inside(axes(middle)) else (fits, middle)
    return machine.clipped(axes(fits))
