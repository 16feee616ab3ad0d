"""Adapters of other packages: their geometry, their answers, and what they say when they cannot run."""

from __future__ import annotations

import builtins

import numpy as np
import pytest
from test_engines_agree import GRID, views

from tomopose.engines import astra, available_engines, make_engine, rtk
from tomopose.engines.protocol import require_returned
from tomopose.errors import EngineFailedError, EngineMissingError, InputError


def test_astra_vectors_project_as_the_matrices_do(rng):
    """By ASTRA's documented meaning: pixel (row, column) lies at C + (column - (columns - 1)/2) U + (row - ...) V."""
    matrices = views()
    x_W = rng.uniform(-3, 3, (20, 3))
    expected = matrices.project(x_W)
    for j, vector in enumerate(astra.cone_vectors(matrices)):
        S, C, U, V = vector.reshape(4, 3)
        normal = np.cross(U, V)
        d = x_W - S
        hit = S + d * ((C - S) @ normal / (d @ normal))[:, None]
        u = (hit - C) @ U / (U @ U) + (matrices.n_u - 1) / 2
        v = (hit - C) @ V / (V @ V) + (matrices.n_v - 1) / 2
        assert np.abs(np.stack([u, v], axis=1) - expected[j]).max() < 1e-8


@pytest.mark.authority
def test_astra_takes_the_geometry():
    package = pytest.importorskip("astra")
    engine = astra.AstraEngine(views(), GRID)
    geometry = engine.projection_geometry([4, 0])
    assert tuple(package.geom_size(geometry)) == (31, 2, 37)
    assert tuple(package.geom_size(engine._volume_geometry)) == GRID.shape
    window = engine._volume_geometry["option"]
    middle, spacing = GRID.centre, GRID.spacing
    for axis, name in enumerate("XYZ"):
        low, high = window[f"WindowMin{name}"], window[f"WindowMax{name}"]
        assert abs((low + high) / 2 - middle[axis]) < 1e-12
        assert abs((high - low) / GRID.n_xyz[axis] - spacing[axis]) < 1e-12
    with pytest.raises(InputError, match="view 9 does not exist"):
        engine.projection_geometry([9])
    with pytest.raises(InputError, match="'mean' only"):
        engine.back(np.zeros((1, 31, 37)), [0], into=engine.empty(), weight="inverse-square")


def test_astra_says_why_it_cannot_run():
    state = astra.availability()
    if state.available:
        pytest.skip("a CUDA GPU is here")
    assert state.reason
    assert state.install_line
    with pytest.raises(EngineMissingError, match="astra cannot run here") as refused:
        make_engine("astra", views(), GRID)
    assert refused.value.install_line == state.install_line
    assert make_engine("auto", views(), GRID).name == "cpu"


@pytest.mark.parametrize(("module", "extra"), [(astra, "gpu"), (rtk, "recon")])
def test_a_missing_package_is_named_with_its_install_line(module, extra, monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **named):
        if name.split(".")[0] in ("astra", "itk"):
            raise ImportError(f"No module named {name!r}")
        return real(name, *rest, **named)

    from importlib import metadata

    def absent(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.setattr(metadata, "version", absent)
    state = module.availability()
    assert not state.available
    assert "not installed" in state.reason
    assert f"tomopose[{extra}]" in state.install_line


def test_every_engine_is_listed():
    assert [state.name for state in available_engines()] == ["cpu", "reference", "rtk", "astra"]


def test_answers_are_checked():
    with pytest.raises(EngineFailedError, match="returned"):
        require_returned(np.zeros((2, 3)), (3, 3), "rtk")
    with pytest.raises(EngineFailedError, match="not finite"):
        require_returned(np.full((2, 2), np.nan), (2, 2), "rtk")


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.skipif(not rtk.availability().available, reason="itk-rtk is not installed")
def test_rtk_projects_alike_away_from_the_outer_faces(rng):
    matrices = views()
    x = np.zeros(GRID.shape, dtype=np.float32)
    x[2:-2, 2:-2, 2:-2] = rng.random((17, 14, 21))
    own, peer = make_engine("cpu", matrices, GRID), make_engine("rtk", matrices, GRID)
    every = [0, 1, 2, 3, 4]
    assert np.abs(own.forward(own.put(x), every) - peer.forward(peer.put(x), every)).max() < 1e-4
    y = rng.random((5, 31, 37))
    left = (peer.forward(peer.put(x), every).astype(float) * y).sum()
    right = (peer.values(peer.transpose(y, every)).astype(float) * x).sum()
    assert abs(left / right - 1) < 1e-5


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.skipif(not rtk.availability().available, reason="itk-rtk is not installed")
def test_rtk_counts_its_views():
    matrices = views()
    assert len(rtk.rtk_geometry(matrices, [2, 0, 2]).GetGantryAngles()) == 3
    with pytest.raises(InputError, match="view 7"):
        rtk.rtk_geometry(matrices, [7])
