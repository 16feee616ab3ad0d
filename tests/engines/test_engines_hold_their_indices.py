"""Whatever grid, path and panel: the CPU engine gives what the reference gives, and reads nothing beyond its arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tomopose.engines import make_engine
from tomopose.engines.back_projection import back_columns
from tomopose.engines.cpu import CpuEngine
from tomopose.engines.forward_projection import forward_columns
from tomopose.engines.geometry import index_geometry
from tomopose.engines.layout import BORDER, Lookup, Rays, Support
from tomopose.geometry.projection import ProjectionMatrices, compose
from tomopose.geometry.rotations import R_y, R_z
from tomopose.volume import VoxelGrid

AGREE = 1e-4
"""Largest |cpu - reference| over the range of the reference: the issue of float32 kernels on float64 geometry."""
GUARD = 4096
"""NaN values before and behind an array: whoever reads there gives NaN."""

near = st.floats(-1.0, 1.0, width=32)


@st.composite
def scenes(draw):
    """(matrices, grid): full turns, short scans and single views; flat and tilted paths; panels pushed aside; grids
    inside the field of view, wider than it, beside the panel, and up to the source."""
    n_x, n_y = draw(st.integers(1, 11)), draw(st.integers(1, 9))
    n_z = draw(st.sampled_from([1, 3, 15, 16, 17, 33, 40]))
    spacing = np.array([draw(st.floats(0.2, 3.0)) for _ in range(3)])
    half = float(np.abs(spacing * [n_x, n_y, n_z]).max()) / 2
    centre = np.array([draw(near) for _ in range(3)]) * draw(st.sampled_from([0.0, 1.0, 30.0]))
    n_u, n_v = draw(st.integers(1, 23)), draw(st.integers(1, 19))
    distance = draw(st.sampled_from([1.01, 1.8, 5.0, 200.0])) * (half * math.sqrt(3) + 1)
    stretch = draw(st.floats(1.0, 6.0))
    wide = draw(st.sampled_from([0.2, 1.0, 3.0])) * 2 * half * stretch
    p_u, p_v = wide / n_u, wide / n_v * draw(st.floats(0.6, 1.6))
    aside = np.array([draw(near), draw(near)]) * draw(st.sampled_from([0.0, 0.6, 2.5])) * [n_u * p_u, n_v * p_v]
    n = draw(st.integers(1, 4))
    arc = draw(st.sampled_from([0.3, math.pi, 2 * math.pi]))
    # 1e-15: a column seen edge-on except for rounding, whose inequalities divide by almost nothing
    tilt, first = draw(st.sampled_from([0.0, 1e-15, 1e-11, 0.14, 1.5])), draw(st.sampled_from([0.0, 0.4, math.pi / 2]))
    source, middle, U, V = [], [], [], []
    for k in range(n):
        R = R_z(first + arc * k / n) @ R_y(tilt * math.sin(3.0 * k + 1.0))
        source.append(R @ [-distance, 0.0, 0.0])
        middle.append(R @ [distance * (stretch - 1), *aside])
        U.append(R @ [0.0, p_u, 0.0])
        V.append(R @ [0.0, 0.0, p_v])
    P = compose(source, middle, U, V, n_u=n_u, n_v=n_v)
    middle_of_view = 0.5 * (np.array(source[0]) + np.array(middle[0]))
    matrices = ProjectionMatrices(
        P=P, n_u=n_u, n_v=n_v, p_u=p_u, p_v=p_v, pose_id=tuple(map(str, range(n))), in_front=middle_of_view
    )
    return matrices, VoxelGrid(shape=(n_z, n_y, n_x), spacing=spacing, centre=centre)


def decided(matrices: ProjectionMatrices, grid: VoxelGrid) -> np.ndarray:
    """(n, n_z, n_y, n_x): voxels whose place is not within rounding of the line where a view stops to see them."""
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1)
    u, v = np.moveaxis(matrices.project(grid.points(index).reshape(-1, 3)), -1, 0)
    margin = [np.abs(u + 1), np.abs(u - matrices.n_u), np.abs(v + 1), np.abs(v - matrices.n_v)]
    return ~(np.nanmin(np.array(margin + [np.full(u.shape, np.inf)]), axis=0) < 1e-7).reshape(-1, *grid.shape)


def one_axis(matrices: ProjectionMatrices, grid: VoxelGrid) -> np.ndarray:
    """(n, n_v, n_u): rays that are not, within rounding, equally steep along two axes."""
    v, u = np.meshgrid(np.arange(matrices.n_v), np.arange(matrices.n_u), indexing="ij")
    d = np.einsum("jab,vub->jvua", index_geometry(matrices, grid).M_inv, np.stack([u, v, np.ones_like(u)], axis=-1))
    largest = np.sort(np.abs(d), axis=-1)
    return largest[..., 2] - largest[..., 1] > 1e-9 * largest[..., 2]


def difference(found: np.ndarray, expected: np.ndarray, where: np.ndarray) -> float:
    """Largest difference over the range of what is expected; inf where one is not finite, or expected is 0 throughout
    and found is not."""
    if not (np.isfinite(found).all() and np.isfinite(expected).all()):
        return math.inf
    span = max(float(np.ptp(expected)), float(np.abs(expected).max(initial=0.0)))
    apart = float(np.abs(found - expected)[where].max(initial=0.0))
    return apart / span if span > 0 else (math.inf if apart > 0 else 0.0)


@pytest.mark.slow
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(scene=scenes(), seed=st.integers(0, 2**31), weight=st.sampled_from(["sum", "mean", "inverse-square"]))
def test_any_scene_gives_what_the_reference_gives(scene, seed, weight):
    matrices, grid = scene
    rng = np.random.default_rng(seed)
    every = list(range(len(matrices)))
    images = rng.random((len(every), matrices.n_v, matrices.n_u)).astype(np.float32)
    x = rng.random(grid.shape)
    reference = make_engine("reference", matrices, grid)
    expected = reference.empty()
    reference.back(images, every, into=expected, weight=weight)
    rays, voxels = one_axis(matrices, grid), decided(matrices, grid).all(axis=0)
    lines, lengths = reference.forward(reference.put(x), every), reference.lengths(every)
    spread = reference.transpose(np.where(rays, images, 0), every)
    for kernels in ("vector", "plain"):
        cpu = CpuEngine(matrices, grid, kernels=kernels, threads=1)
        found = cpu.empty()
        cpu.back(images, every, into=found, weight=weight)
        assert difference(cpu.values(found), expected, voxels) <= AGREE
        assert difference(cpu.forward(cpu.put(x), every), lines, rays) <= AGREE
        assert difference(cpu.values(cpu.transpose(np.where(rays, images, 0), every)), spread, ...) <= AGREE
        assert difference(cpu.lengths(every), lengths, ...) <= AGREE
        cpu.values(found)[:] = 0
        assert not found.any()  # the margin stays zero


def guarded(values: np.ndarray) -> np.ndarray:
    """A flat copy of an array, with NaN before and behind it in memory."""
    room = np.full(values.size + 2 * GUARD, np.nan, dtype=np.float32)
    room[GUARD:-GUARD] = values.reshape(-1)
    return room[GUARD:-GUARD]


@pytest.mark.slow
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(scene=scenes(), vector=st.booleans(), inverse_square=st.booleans())
def test_nothing_is_read_beyond_an_array(scene, vector, inverse_square):
    matrices, grid = scene
    cpu = CpuEngine(matrices, grid, threads=1)
    geometry = index_geometry(matrices, grid)
    n_x, _, n_z = grid.n_xyz
    bordered = np.ones((matrices.n_u + 2 * BORDER, matrices.n_v + 2 * BORDER), dtype=np.float32)
    full = cpu.put(np.ones(grid.shape))
    everywhere = Support(inside=np.zeros(0, dtype=np.uint8), layers=np.zeros(0, dtype=np.int32))
    for j in range(len(matrices)):
        state = guarded(cpu.empty())
        look = Lookup(
            P=geometry.P[j : j + 1],
            images=guarded(bordered).reshape(1, -1),
            n_u=matrices.n_u,
            n_v=matrices.n_v,
            scale=1.0,
            inverse_square=inverse_square,
            vector=vector and n_z >= 16,
        )
        back_columns(state, grid.n_xyz, look, False, False, everywhere, 0, n_x)
        assert np.isfinite(state).all()
        if not inverse_square:
            assert set(np.unique(state.round(5))) <= {0.0, 1.0}  # a look-up in ones gives 1, what is not seen 0
        image = np.empty((matrices.n_u, matrices.n_v), dtype=np.float32)
        rays = Rays(shape=grid.n_xyz, spacing=grid.spacing, source=geometry.source[j], M_inv=geometry.M_inv[j])
        forward_columns(guarded(full), rays, image, vector, 0, matrices.n_u)
        assert np.isfinite(image).all()
