"""Matrices of any scan in the formats of reconstruction packages, and back."""

import tempfile
from pathlib import Path

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import eq5_matrices

scanner = tp.Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)
T_HT = tp.RigidTransform.from_angles([0.0, 0.0, 3.1], [2.0, -1.5, 4.0], source=tp.Frame.H, target=tp.Frame.T)
scan = tp.circular_scan(90)
P = eq5_matrices(scanner, T_HT=T_HT, T_MH=scan.T_MH, alpha=scan.alpha)
matrices = tp.ProjectionMatrices(P=P, n_u=1501, n_v=1203, p_u=0.2, p_v=0.25, pose_id=scan.pose_id)

with tempfile.TemporaryDirectory() as folder:
    written = tp.export(matrices, Path(folder) / "geometry", formats=["rtk", "astra"])
    back = tp.read_geometry(Path(folder) / "geometry" / "rtk.xml", rows="bottom")
    x = [[5.0, -3.0, 2.0]]
    print(sorted(written.files), f"{np.abs(back.project(x) - matrices.project(x)).max():.1e} px apart")
