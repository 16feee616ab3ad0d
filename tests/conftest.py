"""Shared by all tests: where the reference data lie, and geometries that no symmetry can hide behind."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from tomopose import RigidTransform, Scanner
from tomopose.geometry.frames import Frame

# A deadline would be a timed assertion.
settings.register_profile("house", deadline=None)
settings.load_profile("house")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of third-party reference data.

    Its absence is a failure where CI is set, unless TOMOPOSE_WITHOUT_SHARED says that it is known; a skip elsewhere.
    """
    folder = Path(os.environ.get("TOMOPOSE_SHARED", ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        message = f"reference data not found at {folder}; set TOMOPOSE_SHARED to the folder that holds data/"
        if os.environ.get("CI") and not os.environ.get("TOMOPOSE_WITHOUT_SHARED"):
            pytest.fail(message)
        pytest.skip(message)
    return folder


@pytest.fixture
def scanner() -> Scanner:
    """Non-square pixels, off-centre piercing point, odd sizes."""
    return Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)


@pytest.fixture
def T_HT() -> RigidTransform:
    return RigidTransform.from_angles([0.02, -0.03, 3.05], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20231028)
