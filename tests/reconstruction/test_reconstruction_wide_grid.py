"""A grid wider than the field of view: what no ray reaches is 0, what all views see is what a smaller grid holds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from reconstruction_phantom import Balls, images_of

from tomopose.io import read_matrices
from tomopose.reconstruction import reconstruct
from tomopose.volume import VoxelGrid


@pytest.fixture(scope="module")
def scan(shared_data):
    folder = shared_data / "cases" / "reconstruct-wide-grid"
    matrices = read_matrices(folder / "matrices.npz")
    spheres = json.loads((folder / "spheres.json").read_text(encoding="utf-8"))["spheres"]
    objects = Balls(
        centres=np.array([s["centre_mm"] for s in spheres], dtype=float),
        radii=np.array([s["radius_mm"] for s in spheres], dtype=float),
        mu=np.array([s["density_per_mm"] for s in spheres]),
    )
    return matrices, images_of(matrices, objects, fine=1)


def volume_of(scan, n, **settings):
    matrices, images = scan
    grid = VoxelGrid(shape=(24, n, n), spacing=1.0)
    return reconstruct(images, matrices, grid, images_are="line-integrals", **settings)


@pytest.mark.slow
@pytest.mark.parametrize("n", [68, 78, 100])
def test_a_wide_grid_holds_the_small_one_and_nothing_beyond(scan, n):
    small, wide = volume_of(scan, 48), volume_of(scan, n)
    assert np.isfinite(wide.values).all()
    margin = (n - 48) // 2
    inner = wide.values[:, margin : margin + 48, margin : margin + 48]
    assert np.abs(inner - small.values).max() <= 1e-5 * np.ptp(small.values)
    index = np.stack(np.meshgrid(*map(np.arange, wide.grid.shape), indexing="ij"), axis=-1)
    u, v = np.moveaxis(scan[0].project(wide.grid.points(index).reshape(-1, 3)), -1, 0)
    views = ((u > -1) & (u < 128) & (v > -1) & (v < 128)).sum(axis=0).reshape(wide.grid.shape)
    assert not wide.values[views == 0].any()
    assert wide.values.min() > -0.12
    assert wide.values.max() < 0.13
    assert np.array_equal(volume_of(scan, n).values, wide.values)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["sart", "fdk+sart", "ossart", "cgls"])
def test_every_algorithm_stays_within_what_the_images_hold(scan, algorithm):
    wide = volume_of(scan, 100, algorithm=algorithm)
    assert np.isfinite(wide.values).all()
    assert np.abs(wide.values).max() < 0.15
