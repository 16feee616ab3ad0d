"""Calibration poses and a tilted scan, as tables of rows that have names."""

import math

import tomopose as tp
from tomopose.trajectory.tilt import eq11_triangle

poses = tp.pose_grid(3, half_range=10.0, tilt=math.radians(5.0), table_angles=[0.0, math.radians(90.0)])
print(len(poses), "poses; the first:", poses[0].T_MH.t[0])
turned = poses[poses.alpha > 0]
print(len(turned), "of them at 90 degrees; pose", turned.pose_id[0], "is", turned[turned.pose_id[0]].alpha)
print(tp.tilted_scan(90, eq11_triangle).pose_id[-1])
