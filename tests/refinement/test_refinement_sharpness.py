"""The blur of a volume's edges, as the report of a refinement states it before and after."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage

import tomopose as tp
from tomopose.refinement.sharpness import edge_blurs_mm

GRID = tp.VoxelGrid(shape=(44, 46, 48), spacing=0.3, centre=(1.0, -2.0, 0.5))


def ball(blur_voxel, noise=0.0):
    """A ball of 4 mm radius, its edge a Gaussian step: fine voxels averaged by 4, then blurred."""
    fine = np.stack(np.meshgrid(*(np.arange(4 * n) for n in GRID.shape), indexing="ij"), -1)
    z, y, x = (0.3 / 4 * (fine[..., k] - (4 * n - 1) / 2) for k, n in enumerate(GRID.shape))
    inside = ((x - 0.1) ** 2 + (y + 0.07) ** 2 + z**2 < 16).astype(np.float32)
    coarse = inside.reshape(GRID.shape[0], 4, GRID.shape[1], 4, GRID.shape[2], 4).mean(axis=(1, 3, 5))
    values = 0.05 * scipy.ndimage.gaussian_filter(coarse, blur_voxel)
    values += noise * np.random.default_rng(0).standard_normal(values.shape)
    return tp.Volume(values=values.astype(np.float32), grid=GRID)


@pytest.mark.parametrize(("blur", "noise"), [(0.9, 0.0), (1.6, 0.0), (1.2, 0.001)])
def test_the_blur_of_a_balls_edge_is_found_in_millimetres(blur, noise):
    expected = 0.3 * np.sqrt(blur**2 + 1 / 12)  # a voxel's own width has the variance 1/12
    blurred, sharp = edge_blurs_mm(ball(blur, noise), ball(0.7, noise))
    assert blurred == pytest.approx(expected, rel=0.06)
    assert sharp == pytest.approx(0.3 * np.sqrt(0.7**2 + 1 / 12), rel=0.06)


def test_edges_that_are_not_where_they_should_be_are_blurred_ones():
    sharp = ball(0.7)
    apart = 0.5 * (np.roll(sharp.values, 2, axis=0) + np.roll(sharp.values, -2, axis=0))
    doubled, right = edge_blurs_mm(tp.Volume(values=apart, grid=GRID), sharp)
    assert doubled > 1.3 * right


def test_a_volume_without_a_surface_has_no_blur():
    flat = tp.Volume(values=np.full(GRID.shape, 0.02, dtype=np.float32), grid=GRID)
    assert np.isnan(edge_blurs_mm(ball(0.9), flat)).all()
    blurred, sharp = edge_blurs_mm(flat, ball(0.9))
    assert np.isnan(blurred)
    assert sharp > 0
