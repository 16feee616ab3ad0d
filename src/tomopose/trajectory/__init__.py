"""Trajectories: calibration poses, scans, whether they can be driven, and how complete their data are."""
