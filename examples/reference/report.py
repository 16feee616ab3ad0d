"""The figures of the reports in a notebook: each call returns a plotly figure, which a cell shows."""

import math

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import project_ball

scanner = tp.Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=1021.4, v_0=1026.8, n_u=2048, n_v=2048).exact()
T_HT = tp.RigidTransform.from_angles([0.01, -0.02, 3.1], [2.0, -1.5, 4.0], source=tp.Frame.H, target=tp.Frame.T)
poses = tp.pose_grid(3, half_range=10.0, tilt=math.radians(5.0), table_angles=[0.0, math.radians(90.0)])
x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=[10.0, -8.0, 16.0], alpha=poses.alpha)
noise = np.random.default_rng(1).normal(scale=0.01, size=x_D.shape)
observations = tp.BallObservations.from_sigma(x_D + noise, 0.01, pose_id=poses.pose_id)

calibration = tp.calibrate(scanner, poses, observations)
residuals = tp.plot_residuals(calibration, by="detector")
correlations = tp.plot_observability(calibration)
path = tp.plot_scan(tp.projection_matrices(calibration, poses))
print([figure.layout.title.text for figure in (residuals, correlations, path)])
