"""Geometry objects of other packages, made in memory: theirs project as ours, and a missing package names its
install.
"""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest

import tomopose as tp
from tomopose.errors import EngineMissingError, NotRepresentableError
from tomopose.geometry.projection import eq5_matrices, row_flip

pytestmark = pytest.mark.filterwarnings("ignore:builtin type .* has no __module__ attribute:DeprecationWarning")


@pytest.fixture
def matrices(scanner, T_HT):
    poses = tp.PoseSequence.from_table([[0, 0, 0], [1, 2, -3], [4, 0, 1]], [[0, 0, 0], [5, -3, 8], [2, 2, -6]])
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=np.array([0.0, 1.0, 2.0]))
    return tp.ProjectionMatrices(
        P=P, n_u=scanner.n_u, n_v=scanner.n_v, p_u=scanner.p_u, p_v=scanner.p_v, pose_id=("a", "b", "c")
    )


def test_astra_takes_the_object(matrices):
    astra = pytest.importorskip("astra")
    geometry = tp.to_astra(matrices, rows="top")
    assert geometry["type"] == "cone_vec"
    assert (geometry["DetectorRowCount"], geometry["DetectorColCount"]) == (1203, 1501)
    assert astra.geom_size(geometry) == (1203, 3, 1501)
    g = matrices.decompose()
    np.testing.assert_allclose(geometry["Vectors"], np.hstack([g.source, g.centre, g.U, -g.V]), atol=1e-9)


@pytest.mark.slow
def test_rtk_projects_as_the_matrices_do(matrices):
    itk = pytest.importorskip("itk")
    geometry = tp.to_rtk(matrices)
    X = np.random.default_rng(1).uniform(-20, 20, (8, 3))
    want = matrices.project(X)
    for k in range(3):
        M = np.asarray(itk.array_from_matrix(geometry.GetMatrix(k)))
        h = np.c_[X[:, [1, 2, 0]], np.ones(8)] @ M.T
        mm = h[:, :2] / h[:, 2:]
        px = mm / [matrices.p_u, matrices.p_v] + [(matrices.n_u - 1) / 2, (matrices.n_v - 1) / 2]
        np.testing.assert_allclose(px, want[k], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["to_cil", "to_tigre", "to_leap"])
def test_a_missing_package_names_its_install_line(name, matrices, monkeypatch):
    for module in ("cil", "cil.framework", "tigre", "leapctype"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(EngineMissingError) as caught:
        getattr(tp, name)(matrices)
    assert caught.value.install_line


def test_arguments_reach_the_packages_in_their_own_order(matrices, monkeypatch):
    """By their published signatures: set_modularbeam takes rows before columns, TIGRE its fields as [v, u]."""
    said = {}
    model = types.SimpleNamespace(set_modularbeam=lambda *a: said.update(beam=a))
    monkeypatch.setitem(sys.modules, "leapctype", types.SimpleNamespace(tomographicModels=lambda: model))
    monkeypatch.setitem(sys.modules, "tigre", types.SimpleNamespace(geometry=types.SimpleNamespace))
    assert tp.to_leap(matrices) is model
    n, rows, columns, height, width = said["beam"][:5]
    assert (n, rows, columns, height, width) == (3, 1203, 1501, 0.25, 0.2)
    geometry, angles = tp.to_tigre(matrices)
    assert geometry.nDetector.tolist() == [1203, 1501]
    assert geometry.sDetector.tolist() == pytest.approx([300.75, 300.2])
    assert angles.shape == (3, 3)


def test_mirrored_images_have_no_rtk_geometry(matrices):
    mirrored = tp.ProjectionMatrices(
        P=row_flip(matrices.n_v) @ matrices.P,
        n_u=matrices.n_u,
        n_v=matrices.n_v,
        p_u=matrices.p_u,
        p_v=matrices.p_v,
        pose_id=matrices.pose_id,
    )
    with pytest.raises(NotRepresentableError, match="mirrored"):
        tp.to_rtk(mirrored)
