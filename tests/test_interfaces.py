"""The published interfaces: verbs, Python names, and the whole check that users' scripts can rest on them."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

import tomopose
from tomopose.cli.main import VERBS

PUBLISHED_VERBS = {
    "demo", "simulate", "detect", "calibrate", "diagnose", "plan", "matrices", "export", "import_geometry",
    "reconstruct", "measure", "report", "study", "doctor", "compare", "monitor", "import_poses",
}  # fmt: skip
PUBLISHED_NAMES = {
    "BallObservations", "Calibration", "PoseSequence", "ProjectionMatrices", "RigidTransform", "Scanner",
    "TomoposeError", "Volume", "VoxelGrid", "append_history", "calibrate", "detect", "errors", "export", "open_images",
    "projection_matrices", "read_calibration", "read_geometry", "read_matrices", "read_observations", "read_poses",
    "read_scanner", "reconstruct", "write_calibration", "write_matrices", "write_observations", "write_poses",
    "write_scanner", "write_volume",
}  # fmt: skip


def test_published_verbs_and_names_are_there():
    assert set(VERBS) >= PUBLISHED_VERBS
    assert set(tomopose.__all__) >= PUBLISHED_NAMES


@pytest.mark.slow
def test_the_interface_check_passes(shared_data, tmp_path):
    """The check runs the command line that lies beside the interpreter, as a user has it."""
    check = shared_data.parent / "check" / "conformance.py"
    if importlib.util.find_spec("tomopose") is None or not (Path(sys.executable).parent / "tomopose").exists():
        pytest.skip("tomopose is not installed in this environment")
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, str(check)], check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].endswith(" 0 failed")
