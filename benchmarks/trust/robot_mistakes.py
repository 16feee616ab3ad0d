"""Robot tables under the wrong convention: named, or nothing advised?

`python benchmarks/trust/robot_mistakes.py [SEEDS]`.
Seven mistakes of people's robots, each with other poses, mount, ball and noise by a seed: the true reading must be the
only one that is advised, and nothing is ever advised that leaves more than 10 stated standard uncertainties.  The
centres come from benchmarks/reality/chain.py, which shares no code with the library.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "reality"))

from chain import Panel, World

import tomopose as tp

SIGMA_PX = 0.02
LIMIT = 10.0
PANEL = Panel(d_SD=1500.0, d_SR=620.0, p_u=0.2, p_v=0.2, u_0=1021.4, v_0=1026.8)


@dataclass
class Mistake:
    """right: name of the true reading; declared: the convention of the table; columns (n, 3 or 4): as written."""

    right: str
    declared: str
    columns: np.ndarray


def mistakes(R: Rotation) -> dict[str, Mistake]:
    degrees = np.degrees(R.as_rotvec())
    return {
        "rotation vector read as KUKA's A, B, C": Mistake(
            "rotation vector in degrees, columns reversed", "kuka", degrees
        ),
        "rotation vector read as Yaskawa's Rx, Ry, Rz": Mistake("rotation vector in degrees", "yaskawa", degrees),
        "roll, pitch, yaw read as UR's vector": Mistake("order ZYX", "ur", R.as_euler("xyz")),
        "fixed axes read as Staubli's moved ones": Mistake("order ZYX", "staubli", R.as_euler("xyz", degrees=True)),
        "quaternion w, x, y, z read as x, y, z, w": Mistake(
            "quaternion w first", "quaternion-xyzw", R.as_quat(scalar_first=True)
        ),
        "quaternion x, y, z, w read as w, x, y, z": Mistake("quaternion w last", "quaternion-wxyz", R.as_quat()),
        "Euler z-y-z read as KUKA's A, B, C": Mistake("order ZYZ", "kuka", R.as_euler("ZYZ", degrees=True)),
    }


def robot_run(seed: int, n: int = 60) -> tuple[tp.Scanner, Rotation, np.ndarray, tp.BallObservations]:
    """(scanner, rotations, positions (n, 3) mm, centres) of a robot that holds the ball before the panel."""
    rng = np.random.default_rng(seed)
    mount = Rotation.from_euler("XYZ", [*rng.normal(0, 0.04, 2), np.pi + rng.normal(0, 0.1)])
    t_HT = np.array([600.0, -30.0, -400.0]) + rng.normal(0, 40, 3)
    ball = rng.uniform([-30, -30, 80], [30, 30, 160])
    home = Rotation.from_euler("xyz", rng.uniform([150, -15, -60], [200, 15, 60]), degrees=True)
    R = home * Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (n, 3)))
    x_T = rng.uniform(-35, 35, (n, 3))
    t = mount.inv().apply(x_T - t_HT) - R.apply(ball)
    world = World(panel=PANEL, R_HT=mount.as_matrix(), t_HT=t_HT)
    x = world.image(R.as_euler("XYZ"), t, np.zeros(n), np.tile(ball, (n, 1, 1)), rng, run=False)[:, 0]
    names = [str(k) for k in range(n)]
    seen = tp.BallObservations.from_sigma(x + SIGMA_PX * rng.standard_normal(x.shape), SIGMA_PX, pose_id=names)
    scanner = tp.Scanner(
        d_SD=PANEL.d_SD, d_SR=PANEL.d_SR, p_u=0.2, p_v=0.2, u_0=PANEL.u_0, v_0=PANEL.v_0, n_u=2048, n_v=2048
    )
    return scanner, R, t, seen


def outcome(seed: int, name: str) -> str:
    """named | nothing advised | advised wrongly."""
    scanner, R, t, seen = robot_run(seed)
    mistake = mistakes(R)[name]
    poses = tp.PoseSequence.from_table(t, mistake.columns, convention=mistake.declared)
    found = tp.diagnose(scanner, poses, seen)
    if any(h.sigmas > LIMIT for h in found.leading):
        return "advised wrongly"
    if [h.name for h in found.leading] == [mistake.right]:
        return "named"
    return "advised wrongly" if found.leading else "nothing advised"


def main(seeds: int) -> None:
    for name in mistakes(Rotation.from_rotvec([[0.1, 0.2, 0.3]])):
        found = [outcome(seed, name) for seed in range(seeds)]
        counts = ", ".join(f"{found.count(word)} {word}" for word in ("named", "nothing advised", "advised wrongly"))
        print(f"{name:48} {counts}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
