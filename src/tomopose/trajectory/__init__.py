"""Trajectories: calibration poses, scans, whether they can be driven, and how complete their data are."""

from tomopose.trajectory.feasibility import TravelLimits
from tomopose.trajectory.pose_grid import pose_grid
from tomopose.trajectory.scan import circular_scan, scan, table_angles, tilted_scan
from tomopose.trajectory.tilt import hexapod_rotation, sine_tilt, sine_wave, triangle_tilt, triangle_wave

__all__ = [
    "TravelLimits",
    "circular_scan",
    "hexapod_rotation",
    "pose_grid",
    "scan",
    "sine_tilt",
    "sine_wave",
    "table_angles",
    "tilted_scan",
    "triangle_tilt",
    "triangle_wave",
]
