"""Why a second table angle: the same noise, the paper's poses with the table still, and with it at 0 and 90 degrees.

    python examples/what_poses_can_tell.py

The residual is the same for both plans. What differs is what they can determine.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import project_ball
from tomopose.trajectory.pose_grid import pose_grid

NOISE_PX = 0.02


def main() -> dict[str, tp.Calibration]:
    scanner = tp.Scanner(
        d_SD=1500.0,
        d_SR=283.5,
        p_u=0.2,
        p_v=0.2,
        u_0=1021.4,
        v_0=1026.8,
        n_u=2048,
        n_v=2048,
    )
    # All values are exact (standard uncertainty 0) but two: half a millimetre, two pixels.
    scanner = replace(scanner, sigma={**scanner.exact().sigma, "d_SR": 0.5, "u_0": 2.0})
    T_HT = tp.RigidTransform.from_angles([0.01, -0.02, 3.1], [2.0, -1.5, 4.0], source=tp.Frame.H, target=tp.Frame.T)
    results = {}
    for name, table_angles in (("table still", (0.0,)), ("table at 0 and 90 degrees", (0.0, np.pi / 2))):
        poses = pose_grid(3, table_angles=table_angles)
        exact = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=[3.0, -2.0, 21.0], alpha=poses.alpha)
        noise = np.random.default_rng(1).normal(scale=NOISE_PX, size=exact.shape)
        observations = tp.BallObservations.from_sigma(exact + noise, NOISE_PX, pose_id=poses.pose_id)
        calibration = tp.calibrate(scanner, poses, observations)
        u = {p.name: p.u for p in calibration.parameters}
        print(f"{name}: {len(poses)} poses, d_rms {calibration.d_rms:.4f} px, {calibration.verdict}")
        print(f"  d_SR to {u['d_SR'] * 1000:.1f} um, u_0 to {u['u_0']:.4f} px, t_HT,x to {u['t_HT_x'] * 1000:.1f} um")
        for note in calibration.observability.notes:
            print(f"  {note}")
        results[name] = calibration
    return results


if __name__ == "__main__":
    main()
