"""Do my matrices mean what I think?  Project points by hand, through tomopose and through an exported file.

python examples/own_geometry_check.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import eq5_matrices
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle


def main(folder: Path) -> float:
    scanner = tp.Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.21, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)
    T_HT = tp.RigidTransform.from_angles([0.01, -0.02, 3.1], [2.0, -1.5, 4.0], source=tp.Frame.H, target=tp.Frame.T)
    scan = tilted_scan(90, eq11_triangle)
    P = tp.ProjectionMatrices(
        P=eq5_matrices(scanner, T_HT=T_HT, T_MH=scan.T_MH, alpha=scan.alpha),
        n_u=scanner.n_u,
        n_v=scanner.n_v,
        p_u=scanner.p_u,
        p_v=scanner.p_v,
        pose_id=scan.pose_id,
    )
    points = np.array([[10.0, 5.0, -3.0], [-8.0, 12.0, 20.0]])

    by_hand = []
    for j in range(len(P)):
        u, v, w = P.P[j] @ np.vstack([points.T, np.ones(len(points))])
        by_hand.append(np.stack([u / w, v / w], axis=1))

    tp.export(P, folder, formats=["astra"])
    back = tp.read_geometry(folder / "astra.npy")

    worst = max(np.abs(P.project(points) - by_hand).max(), np.abs(back.project(points) - by_hand).max())
    print(f"largest difference over {len(P)} views: {worst:.2e} px")
    return float(worst)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
