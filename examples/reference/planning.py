"""How much of the object's planes does a circular and a tilted scan see?"""

import math

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import eq5_matrices
from tomopose.trajectory.tilt import eq11_triangle

scanner = tp.Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=1021.4, v_0=1026.8, n_u=2048, n_v=2048)
T_HT = tp.RigidTransform.from_angles([0.0, 0.0, math.pi], [0.0, 0.0, 0.0], source=tp.Frame.H, target=tp.Frame.T)
points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 15.0]])
for name, scan in {
    "circular": tp.circular_scan(180),
    "tilted": tp.tilted_scan(180, eq11_triangle),
}.items():
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=scan.T_MH, alpha=scan.alpha)
    path = np.array([-np.linalg.solve(view[:, :3], view[:, 3]) for view in P])  # where the source is, seen from W
    print(name, tp.tuy_completeness(path, points).share)
