"""STEP through cascadio: a box with known sides, in millimetres and in metres; and what happens without it."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from step_box import step_box

from tomopose.errors import EngineMissingError, FileError
from tomopose.measurement.mesh.mesh_files import read_mesh

SIDES = np.array([10.0, 20.0, 30.0])


@pytest.mark.parametrize(("factor", "prefix"), [(1.0, ".MILLI."), (1e-3, "$")])
def test_a_box_has_its_sides_whatever_the_unit(tmp_path, factor, prefix):
    pytest.importorskip("cascadio", reason="the optional package cascadio is not installed")
    path = tmp_path / "box.step"
    path.write_text(step_box(SIDES * factor, prefix), encoding="ascii")
    mesh = read_mesh(path).require_closed()
    assert np.ptp(mesh.points, axis=0) == pytest.approx(SIDES, abs=1e-5)
    assert len(np.unique(mesh.elements)) == 6
    area = 0.5 * np.linalg.norm(mesh.face_normals, axis=1).sum()
    assert area == pytest.approx(2 * (10 * 20 + 20 * 30 + 30 * 10), rel=1e-6)


def test_without_cascadio_the_line_to_install_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cascadio", None)
    path = tmp_path / "box.stp"
    path.write_text(step_box(SIDES), encoding="ascii")
    with pytest.raises(EngineMissingError, match="cascadio") as raised:
        read_mesh(path)
    assert raised.value.install_line == "pip install cascadio"


def test_files_that_hold_no_solid(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        read_mesh(tmp_path / "none.step")
    pytest.importorskip("cascadio", reason="the optional package cascadio is not installed")
    path = tmp_path / "text.step"
    path.write_text("no STEP", encoding="ascii")
    with pytest.raises(FileError, match="no solid"):
        read_mesh(path)
