"""tomopose: pose calibration for X-ray tomography.

From radiographs of one ball on a 6-DOF manipulator to projection matrices of any 3D scan trajectory, with uncertainty.
Names are imported when they are first used, so that `import tomopose` stays light.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "BallImage": "tomopose.detection.result",
    "BallObservations": "tomopose.observations",
    "Calibration": "tomopose.calibration.result",
    "Frame": "tomopose.geometry.frames",
    "ImageSequence": "tomopose.io",
    "InputWarning": "tomopose.io",
    "PoseSequence": "tomopose.manipulator.poses",
    "ProjectionMatrices": "tomopose.geometry.projection",
    "RawLayout": "tomopose.io",
    "RigidTransform": "tomopose.geometry.transforms",
    "Scanner": "tomopose.geometry.scanner",
    "SimulatedRun": "tomopose.simulation.run",
    "TomoposeError": "tomopose.errors",
    "TwinRobots": "tomopose.manipulator.twin",
    "Volume": "tomopose.volume",
    "VoxelGrid": "tomopose.volume",
    "append_history": "tomopose.calibration.records.history",
    "calibrate": "tomopose.calibration.solve",
    "calibrate_inverse": "tomopose.calibration.arrangements.moving_scanner",
    "calibrate_twin": "tomopose.calibration.arrangements.twin_robots",
    "circular_scan": "tomopose.trajectory.scan",
    "commands_for": "tomopose.manipulator.error_models",
    "compare": "tomopose.calibration.records.compare",
    "control_chart": "tomopose.calibration.records.history",
    "corrected_poses": "tomopose.manipulator.error_models",
    "d_rms_exact": "tomopose.calibration.records.truth",
    "detect": "tomopose.detection.run.detect",
    "detect_image": "tomopose.detection.image",
    "diagnose": "tomopose.calibration.checks.convention_tests",
    "export": "tomopose.exports",
    "inverse_poses": "tomopose.manipulator.inverse",
    "measure": "tomopose.measurement.measure",
    "monte_carlo": "tomopose.calibration.uncertainty.monte_carlo",
    "open_images": "tomopose.io",
    "pair_images": "tomopose.io",
    "plan_poses": "tomopose.planning.design",
    "pose_from_balls": "tomopose.calibration.arrangements.multi_sphere",
    "pose_grid": "tomopose.trajectory.pose_grid",
    "probe": "tomopose.measurement.probing",
    "projection_matrices": "tomopose.calibration.projection_matrices",
    "read_calibration": "tomopose.io",
    "read_gcs_log": "tomopose.io",
    "read_geometry": "tomopose.exports",
    "read_history": "tomopose.calibration.records.history",
    "read_manipulator": "tomopose.manipulator.files",
    "read_matrices": "tomopose.io",
    "read_mesh": "tomopose.measurement.mesh.mesh",
    "read_observations": "tomopose.io",
    "read_plan": "tomopose.measurement.plan",
    "read_poses": "tomopose.io",
    "read_scanner": "tomopose.io",
    "read_scene": "tomopose.simulation.scene.scene",
    "read_twin": "tomopose.manipulator.twin_file",
    "read_volume": "tomopose.io.volume_files",
    "reconstruct": "tomopose.reconstruction",
    "run_from_ctsimu": "tomopose.simulation.scene.ctsimu",
    "run_to_ctsimu": "tomopose.simulation.scene.ctsimu",
    "scene_schema": "tomopose.simulation.scene.scene",
    "simulate": "tomopose.simulation.scene.build",
    "simulate_ball_run": "tomopose.simulation.run",
    "surface": "tomopose.measurement.surface.surface",
    "tilted_scan": "tomopose.trajectory.scan",
    "tuy_completeness": "tomopose.trajectory.completeness",
    "twin_matrices": "tomopose.calibration.arrangements.twin_robots",
    "write_calibration": "tomopose.io",
    "write_hdf5": "tomopose.io",
    "write_matrices": "tomopose.io",
    "write_observations": "tomopose.io",
    "write_poses": "tomopose.io",
    "write_scanner": "tomopose.io",
    "write_tiff": "tomopose.io",
    "write_volume": "tomopose.io.volume_files",
}

__all__ = list(_HOME)  # kept sorted; a test holds it


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from tomopose.provenance import package_version

        return package_version()
    try:
        module = _HOME[name]
    except KeyError:
        raise AttributeError(f"module 'tomopose' has no attribute {name!r}") from None
    return getattr(importlib.import_module(module), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
