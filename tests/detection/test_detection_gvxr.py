"""Detection against another simulator's truth: 56 radiographs that this project did not render."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from tomopose import Scanner
from tomopose.detection import detect
from tomopose.observations import BallObservations
from tomopose.units import Array


@pytest.fixture(scope="module")
def gvxr(shared_data: Path) -> tuple[BallObservations, Array, Array]:
    folder = shared_data / "ball-radiographs-gvxr"
    known = json.loads((folder / "scanner.json").read_text())
    scanner = Scanner(d_SD=known["d_SD_mm"], d_SR=known["d_SR_mm"], p_u=known["p_u_mm"], p_v=known["p_v_mm"],
                      u_0=known["u_0_px"], v_0=known["v_0_px"], n_u=known["n_u_px"], n_v=known["n_v_px"])  # fmt: skip
    poses = json.loads((folder / "truth.json").read_text())["poses"]
    files = sorted((folder / "radiographs").glob("*.tif"))
    observations = detect((tifffile.imread(f)[::-1] for f in files), scanner, ball_diameter=8.0)
    truth = np.array([[p["u_px"], p["v_px"]] for p in poses])
    ellipse = np.array([[p["u_ellipse_px"], p["v_ellipse_px"]] for p in poses])
    return observations, truth, ellipse


@pytest.mark.slow
def test_centres_within_a_thousandth_of_a_pixel(gvxr: tuple[BallObservations, Array, Array]) -> None:
    observations, truth, _ = gvxr
    assert observations.seen.all()
    assert set(observations.status or ()) == {"ok"}
    error = observations.x_D - truth
    rms_px = float(np.sqrt((error**2).sum(axis=1).mean()))
    assert rms_px < 0.0010
    assert np.abs(error.mean(axis=0)).max() < 0.0003


def test_ellipse_centres_lie_where_the_silhouette_is(gvxr: tuple[BallObservations, Array, Array]) -> None:
    observations, truth, ellipse = gvxr
    assert observations.x_ellipse is not None
    assert np.sqrt(((observations.x_ellipse - ellipse) ** 2).sum(axis=1).mean()) < 0.0010
    assert np.linalg.norm(observations.x_ellipse - truth, axis=1).max() > 0.02


def test_sigma_is_of_the_size_of_the_error(gvxr: tuple[BallObservations, Array, Array]) -> None:
    """The renderer's own floor of about 0.0007 px comes on top of the noise that sigma speaks of."""
    observations, truth, _ = gvxr
    error = observations.x_D - truth
    floor = 0.0007**2 / 2 * np.eye(2)
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(observations.covariance + floor), error) / 2
    assert 0.6 < chi2.mean() < 1.3
