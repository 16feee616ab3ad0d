"""The engines against one another on tilted views, with non-square pixels, odd sizes and anisotropic voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tomopose.engines import make_engine
from tomopose.engines.cpu import axes_of
from tomopose.engines.geometry import index_geometry
from tomopose.engines.layout import Rays
from tomopose.geometry.projection import ProjectionMatrices, compose
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.volume import VoxelGrid

GRID = VoxelGrid(shape=(21, 18, 25), spacing=np.array([0.5, 0.6, 0.4]), centre=np.array([0.3, -0.2, 0.5]))
# x dominant, y dominant, between both, from above (z dominant), and a view that mixes all three
ANGLES = ((0.1, 0.0), (1.7, 0.12), (0.78, -0.1), (0.4, 1.45), (2.3, 0.62))


def views(n_u: int = 37, n_v: int = 31, pitch: float = 1.0) -> ProjectionMatrices:
    source, centre, U, V = [], [], [], []
    for alpha, tilt in ANGLES:
        R = (R_z(alpha) @ R_y(-tilt) @ R_x(0.05)).T.T
        source.append(R @ [60.0, 0.0, 0.0])
        centre.append(R @ [-60.0, 1.3, -0.7])
        U.append(R @ [0.0, pitch, 0.0])
        V.append(R @ [0.0, 0.0, 1.2 * pitch])
    P = compose(source, centre, U, V, n_u=n_u, n_v=n_v)
    return ProjectionMatrices(P=P, n_u=n_u, n_v=n_v, p_u=pitch, p_v=1.2 * pitch, pose_id=tuple("abcde"))


def scale_of(a: np.ndarray) -> float:
    return float(np.abs(a).max())


def test_a_view_walks_along_the_axes_that_its_rays_are_steepest_along_and_no_others():
    matrices, geometry = views(), index_geometry(views(), GRID)
    several = 0
    for j in range(len(matrices)):
        rays = Rays(shape=GRID.n_xyz, spacing=GRID.spacing, source=geometry.source[j], M_inv=geometry.M_inv[j])
        u, v = np.meshgrid(np.arange(matrices.n_u), np.arange(matrices.n_v))
        d = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1) @ geometry.M_inv[j].T
        used = {int(a) for a in np.unique(np.abs(d).argmax(axis=1))}
        found = axes_of(rays, matrices.n_u, matrices.n_v)
        assert used == set(found) if len(used) == 1 else used <= set(found)
        several += len(used) > 1
    assert 0 < several < len(matrices)


@pytest.mark.parametrize("kernels", ["vector", "plain"])
@pytest.mark.parametrize("view", range(len(ANGLES)))
def test_forward_projection_is_josephs(kernels, view, rng):
    matrices, x = views(), rng.random(GRID.shape)
    reference, cpu = make_engine("reference", matrices, GRID), make_engine("cpu", matrices, GRID, kernels=kernels)
    expected = reference.forward(reference.put(x), [view])
    found = cpu.forward(cpu.put(x), [view])
    assert scale_of(expected) > 5  # the view sees the volume
    assert np.abs(found - expected).max() < 5e-5 * scale_of(expected)


@pytest.mark.parametrize("kernels", ["vector", "plain"])
@pytest.mark.parametrize("weight", ["sum", "mean", "inverse-square"])
@pytest.mark.parametrize("pitch", [1.0, 0.5])  # 0.5: part of the grid falls beside the detector
def test_back_projection_is_the_bilinear_look_up(kernels, weight, pitch, rng):
    matrices = views(pitch=pitch)
    images = rng.random((len(ANGLES), matrices.n_v, matrices.n_u))
    reference, cpu = make_engine("reference", matrices, GRID), make_engine("cpu", matrices, GRID, kernels=kernels)
    expected, found = reference.empty(), cpu.empty()
    for chosen in (range(len(ANGLES)), [3], [1, 2]):
        reference.back(images[list(chosen)], list(chosen), into=expected, weight=weight, scale=0.8)
        cpu.back(images[list(chosen)], list(chosen), into=found, weight=weight, scale=0.8)
    assert np.abs(cpu.values(found) - expected).max() < 2e-5 * scale_of(expected)
    margin = found.copy()
    cpu.values(margin)[:] = 0
    assert not margin.any()  # a write beyond a column would spoil every later forward projection


@pytest.mark.parametrize("weight", ["sum", "mean", "inverse-square"])
def test_long_columns_and_deep_volumes_are_worked_on_piece_by_piece(weight, rng):
    """150 layers and 90 planes: more than the kernels take at a time, and no multiple of it."""
    grid = VoxelGrid(shape=(150, 90, 7), spacing=np.array([0.4, 0.12, 0.1]), centre=np.array([0.3, -0.2, 0.5]))
    matrices, x = views(), rng.random(grid.shape)
    images = rng.random((len(ANGLES), matrices.n_v, matrices.n_u))
    every = list(range(len(ANGLES)))
    reference, cpu = make_engine("reference", matrices, grid), make_engine("cpu", matrices, grid)
    rays = reference.forward(reference.put(x), every)
    assert scale_of(rays) > 5
    assert np.abs(cpu.forward(cpu.put(x), every) - rays).max() < 5e-5 * scale_of(rays)
    expected, found = reference.empty(), cpu.empty()
    reference.back(images, every, into=expected, weight=weight)
    cpu.back(images, every, into=found, weight=weight)
    assert np.abs(cpu.values(found) - expected).max() < 2e-5 * scale_of(expected)


@pytest.mark.parametrize("name", ["cpu", "reference"])
def test_transpose_is_the_transpose(name, rng):
    matrices = views()
    engine = make_engine(name, matrices, GRID)
    x, y = rng.standard_normal(GRID.shape), rng.standard_normal((len(ANGLES), matrices.n_v, matrices.n_u))
    every = list(range(len(ANGLES)))
    left = float((engine.forward(engine.put(x), every).astype(np.float64) * y).sum())
    right = float((engine.values(engine.transpose(y, every)).astype(np.float64) * x).sum())
    size = np.linalg.norm(engine.forward(engine.put(x), every)) * np.linalg.norm(y)
    assert abs(left - right) < 1e-6 * size


def test_lengths_are_those_of_the_box():
    matrices = views()
    cpu, reference = make_engine("cpu", matrices, GRID), make_engine("reference", matrices, GRID)
    every = list(range(len(ANGLES)))
    assert np.abs(cpu.lengths(every) - reference.lengths(every)).max() < 1e-4
    ones = cpu.forward(cpu.put(np.ones(GRID.shape)), every)
    inner = cpu.lengths(every) > 6.0
    assert inner.sum() > 500
    assert abs(float((ones[inner] / cpu.lengths(every)[inner]).mean()) - 1) < 0.02


def test_results_do_not_depend_on_threads(rng):
    matrices = views()
    images = rng.random((len(ANGLES), matrices.n_v, matrices.n_u))
    volumes = []
    for threads in (1, 2, 5):
        engine = make_engine("cpu", matrices, GRID, threads=threads)
        x = engine.empty()
        engine.back(images, list(range(len(ANGLES))), into=x, weight="mean")
        volumes.append((engine.values(x).copy(), engine.forward(x, [0, 4])))
    for volume, image in volumes[1:]:
        assert np.array_equal(volume, volumes[0][0])
        assert np.array_equal(image, volumes[0][1])


def test_slabs_add_up_to_the_whole(rng):
    matrices, x = views(), rng.random(GRID.shape)
    whole = make_engine("cpu", matrices, GRID)
    expected = whole.forward(whole.put(x), [0, 1, 2, 3, 4])
    total = np.zeros_like(expected)
    for start, stop in ((0, 7), (7, 8), (8, 21)):
        slab = make_engine("cpu", matrices, GRID.slab(start, stop))
        total += slab.forward(slab.put(x[start:stop]), [0, 1, 2, 3, 4])
    # the steepest axis belongs to the ray, not to the slab, so that only float32 rounding is left
    assert np.abs(total - expected).max() < 2e-5 * scale_of(expected)


def test_short_columns_stay_plain(rng):
    grid = replace(GRID, shape=(5, 9, 8))
    matrices = views()
    images = rng.random((len(ANGLES), matrices.n_v, matrices.n_u))
    vector, plain = (make_engine("cpu", matrices, grid, kernels=k) for k in ("vector", "plain"))
    a, b = vector.empty(), plain.empty()
    for engine, state in ((vector, a), (plain, b)):
        engine.back(images, [0, 1, 2, 3, 4], into=state)
    assert np.abs(a - b).max() < 1e-5
    assert a.any()
