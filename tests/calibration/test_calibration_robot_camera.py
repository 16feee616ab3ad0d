"""A real robot with a camera in hand: mounts from different corners scatter as their stated uncertainty says."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

STUDY = Path(__file__).resolve().parents[2] / "benchmarks" / "trust" / "robot_camera.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("robot_camera", STUDY)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["robot_camera"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_spread_of_mounts_agrees_with_the_stated_uncertainty(study, shared_data):
    found = study.study(shared_data / "robot-camera-kuka", range(5, 408, 6), joined=5, chance=False)
    assert found["residual_px"] == pytest.approx(0.8, abs=0.1)
    # J^T J takes the robot's errors as independent: too small
    assert found["plain"].rotation > 1.4
    assert found["plain"].mount > 1.4
    # no longer too small; medians, beside them, may be smaller: all corners share the errors of the same 28 poses
    assert 0.8 <= found["modelled"].rotation <= 1.25
    assert 0.8 <= found["modelled"].mount <= 1.25
    assert 0.6 <= found["modelled"].median_mount <= 1.25
