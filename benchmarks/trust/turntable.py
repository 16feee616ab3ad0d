"""Balls on a table that turns alone: do the intervals hold?  `python benchmarks/trust/turntable.py [RUNS]`.

The generator is benchmarks/reality/chain.py, which shares no code with the library.  Scanner values are drawn from the
stated standard deviations (u_0, v_0 and the roll from anywhere near), the balls are anywhere in the field of view.
Printed: the share of 95 % intervals that hold the truth, and how far a circular scan is off, in its stated sigma.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "reality"))

from chain import Panel, Table, World
from plans import points_in_view, scan_error

import tomopose as tp

SIGMA_PX = 0.0146
STATED = {"d_SD": 0.5, "d_SR": 0.15, "p_u": 2e-5, "p_v": 2e-5, "theta": 2e-3, "phi": 2e-3}
WIDE = {"u_0": 15.0, "v_0": 15.0, "eta": 0.01}
NOMINAL = {"d_SD": 1500.0, "d_SR": 283.5, "p_u": 0.2, "p_v": 0.2, "u_0": 1021.37, "v_0": 1026.81}


@dataclass
class Run:
    """What was measured, and the truth: values by name, balls (b, 3)."""

    scanner: tp.Scanner
    poses: tp.PoseSequence
    observations: tp.BallObservations
    world: World
    values: dict[str, float]
    balls: np.ndarray


def turntable_run(
    rng: np.random.Generator,
    *,
    balls: int = 4,
    angles: int = 40,
    table: Table | None = None,
    off: dict[str, float] | None = None,
    sense: float = 1.0,
    span: float = 2 * np.pi,
) -> Run:
    """A table with balls.  off: deviations of scanner values in place of drawn ones;  sense: -1 for a table whose
    angles are stated the other way round;  span: rad, that it turns."""
    drawn = {n: s * rng.standard_normal() for n, s in {**STATED, **WIDE}.items()}
    drawn = drawn if off is None else {n: off.get(n, 0.0) for n in drawn}
    values = {n: NOMINAL.get(n, 0.0) + d for n, d in drawn.items()}
    panel = Panel(**values)
    world = World(panel=panel, table=Table() if table is None else table)
    height = np.linspace(-15.0, 15.0, balls) if balls > 1 else np.array([12.0])
    azimuth = rng.uniform(0, 2 * np.pi, balls)
    radius = rng.uniform(6.0, 14.0, balls)
    x = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    alpha = np.tile(np.linspace(0, span, angles, endpoint=False), balls)
    ball = np.repeat(np.arange(balls), angles)
    zero = np.zeros((len(alpha), 3))
    seen = world.image(zero, zero, alpha, x[ball][:, None, :], rng, run=False)[:, 0]
    seen = seen + SIGMA_PX * rng.standard_normal(seen.shape)
    names = [str(k) for k in range(len(alpha))]
    poses = tp.PoseSequence.from_table(zero, zero, alpha=sense * alpha, ball_id=ball, pose_id=names)
    scanner = tp.Scanner(**NOMINAL, n_u=2048, n_v=2048)
    return Run(scanner, poses, tp.BallObservations.from_sigma(seen, SIGMA_PX, pose_id=names), world, values, x)


def scan_of(run: Run, calibration: tp.Calibration) -> tuple[float, float]:
    """(error, stated) px, rms per coordinate, of a circular scan; the object's rigid pose removed."""
    alpha = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    zero = np.zeros((24, 3))
    x = points_in_view(Panel())
    target = run.world.image(zero, zero, alpha, np.broadcast_to(x, (24, *x.shape)), np.random.default_rng(0), run=False)
    P = tp.projection_matrices(calibration, tp.PoseSequence.from_table(zero, zero, alpha=alpha), points=x)
    return scan_error(P.P, target, x), float(np.sqrt(np.mean(P.points_sigma_shared**2)))


def main(runs: int) -> None:
    held: dict[str, list[bool]] = {}
    ratio, verdicts = [], []
    for seed in range(runs):
        run = turntable_run(np.random.default_rng(seed))
        cal = tp.calibrate_turntable(run.scanner, run.poses, run.observations)
        verdicts.append(cal.verdict)
        for p in cal.parameters:
            if p.name in run.values:
                held.setdefault(p.name, []).append(abs(p.value - run.values[p.name]) < 1.96 * p.u)
        for i, x in enumerate(run.balls):
            for c in range(3):
                q = next(p for p in cal.parameters if p.name == f"t[{i}]_{'xyz'[c]}")
                if c < 2:
                    held.setdefault("radius and azimuth", []).append(abs(q.value - x[c]) < 1.96 * q.u)
        error, stated = scan_of(run, cal)
        ratio.append(error / stated)
    print(f"{runs} runs: trustworthy {verdicts.count('trustworthy')}")
    for name, inside in held.items():
        print(f"{name:20} {np.mean(inside):.3f} of {len(inside)} intervals hold")
    print(f"scan: error over stated sigma, median {np.median(ratio):.2f}, largest {max(ratio):.2f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
