"""From observed centres to the mount, with a verdict and its reasons."""

import math

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import project_ball

exact = dict.fromkeys(("d_SD", "d_SR", "p_u", "p_v", "u_0", "v_0", "eta", "theta", "phi"), 0.0)
scanner = tp.Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=1021.4, v_0=1026.8, n_u=2048, n_v=2048, sigma=exact)
T_HT = tp.RigidTransform.from_angles([0.01, -0.02, 3.1], [2.0, -1.5, 4.0], source=tp.Frame.H, target=tp.Frame.T)
poses = tp.pose_grid(3, half_range=10.0, tilt=math.radians(5.0), table_angles=[0.0, math.radians(90.0)])
x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=[10.0, -8.0, 16.0], alpha=poses.alpha)
noise = np.random.default_rng(1).normal(scale=0.01, size=x_D.shape)
observations = tp.BallObservations.from_sigma(x_D + noise, 0.01, pose_id=poses.pose_id)

calibration = tp.calibrate(scanner, poses, observations)
print(calibration.verdict, *calibration.reasons)
print(f"d_rms {calibration.d_rms:.4f} px, mount {1000 * np.abs(calibration.T_HT.t - T_HT.t).max():.2f} um off")
