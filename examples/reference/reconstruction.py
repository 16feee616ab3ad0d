"""A ball of known attenuation, reconstructed from its exact line integrals on a circular scan."""

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import eq5_matrices

scanner = tp.Scanner(d_SD=600.0, d_SR=200.0, p_u=1.0, p_v=1.0, u_0=30.2, v_0=30.7, n_u=61, n_v=62)
T_HT = tp.RigidTransform.from_angles([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], source=tp.Frame.H, target=tp.Frame.T)
scan = tp.circular_scan(90)
P = eq5_matrices(scanner, T_HT=T_HT, T_MH=scan.T_MH, alpha=scan.alpha)
matrices = tp.ProjectionMatrices(P=P, n_u=61, n_v=62, p_u=1.0, p_v=1.0, pose_id=scan.pose_id)

radius, images = 6.0, []
v, u = np.mgrid[:62, :61]
for view in P:
    source = -np.linalg.solve(view[:, :3], view[:, 3])
    d = np.linalg.solve(view[:, :3], np.stack([u, v, np.ones_like(u)]).reshape(3, -1)).T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    nearest = np.linalg.norm(np.cross(d, source), axis=1)
    images.append((0.05 * 2 * np.sqrt(np.maximum(radius**2 - nearest**2, 0))).reshape(62, 61).astype(np.float32))

volume = tp.reconstruct(images, matrices, tp.VoxelGrid((25, 25, 25), 0.8), images_are="line-integrals")
print(f"attenuation in the middle {volume.values[12, 12, 12]:.4f} /mm, true 0.05 /mm")
