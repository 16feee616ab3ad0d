"""The prior of the views' motions, from what the calibration, the matrices or the settings state."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.calibration.uncertainty.trajectory import plate_points, scatter_variance, trajectory_sigma
from tomopose.refinement.joint_fit.motions import pixel_jacobian
from tomopose.refinement.stated import points_of, prior_of, shared_motions

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "calibration"))
from calibration_cases import SCANNER, observe, paper_poses

GRID = tp.VoxelGrid(shape=(40, 44, 48), spacing=0.5)


@pytest.fixture(scope="module")
def calibrated():
    poses, scan = paper_poses(), tp.circular_scan(12)
    calibration = tp.calibrate(replace(SCANNER, sigma={}), poses, observe(poses))
    return calibration, scan, tp.projection_matrices(calibration, scan)


def test_the_calibrations_covariance_becomes_motions_that_move_pixels_by_the_same(calibrated):
    calibration, scan, matrices = calibrated
    L, C = shared_motions(calibration, scan, matrices, GRID)
    points = points_of(GRID)
    K = pixel_jacobian(matrices.P, points, np.asarray(GRID.centre))
    moved = np.einsum("nmic,ncp->nmip", K, L)
    variance = np.einsum("nmip,pq,nmiq->nmi", moved, C, moved)
    expected = trajectory_sigma(calibration, scan, points) ** 2
    np.testing.assert_allclose(variance, expected, rtol=0.1, atol=1e-3 * expected.max())


def test_with_poses_the_prior_is_correlated_over_views_and_its_scatter_is_the_manipulators(calibrated):
    calibration, scan, matrices = calibrated
    prior, px = prior_of(matrices, GRID, tp.RefineSettings(), calibration, scan)
    assert prior.names[-1] == "shared by all views, of the calibration"
    C = prior.covariance.reshape(12, 6, 12, 6)
    assert np.abs(C[0, :, 1]).max() > 0.5 * np.abs(C[0, :, 0]).max()
    x_M = plate_points(calibration, points_of(GRID))
    assert px == pytest.approx(np.sqrt(np.mean(scatter_variance(calibration, scan, x_M))))


def test_without_poses_it_is_what_the_matrices_state_and_the_settings_win(calibrated):
    calibration, _, matrices = calibrated
    stated, px = prior_of(matrices, GRID, tp.RefineSettings(), calibration)
    assert len(stated.names) == 2
    assert px == pytest.approx(np.sqrt(np.mean(matrices.points_sigma**2)))
    _, px = prior_of(matrices, GRID, tp.RefineSettings(sigma_px=0.3), calibration)
    assert px == pytest.approx(0.3)


def test_binned_images_get_the_same_motions_and_a_scatter_in_their_own_pixels(calibrated):
    calibration, scan, matrices = calibrated
    binned = tp.projection_matrices(calibration, scan, binning=4)
    (L, C), (L_binned, C_binned) = (shared_motions(calibration, scan, m, GRID) for m in (matrices, binned))
    np.testing.assert_allclose(L_binned, L, rtol=1e-6, atol=1e-6 * np.abs(L).max())
    np.testing.assert_array_equal(C_binned, C)
    px, px_binned = (prior_of(m, GRID, tp.RefineSettings(), calibration, scan)[1] for m in (matrices, binned))
    assert px_binned == pytest.approx(px / 4)
    silent = replace(binned, points_sigma=None)
    assert prior_of(silent, GRID, tp.RefineSettings(), calibration)[1] == pytest.approx(calibration.d_rms / 4)
