"""Every format, by its own definition, puts random points on the pixels that the matrices put them on: 1e-6 px."""

from __future__ import annotations

import numpy as np
import pytest
from exports_cases import TOLERANCE_PX, circular_matrices, geometries, pixels, points, random_matrices
from exports_definitions import DEFINITIONS, manifest
from hypothesis import HealthCheck, given, settings

from tomopose.exports import FORMATS, export, read_geometry

X = points(m=8)
QUICK = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.mark.slow
@pytest.mark.parametrize("rows", ["bottom", "top"])
@given(matrices=geometries())
@QUICK
def test_each_format_by_its_own_definition(matrices, rows, tmp_path_factory):
    folder = tmp_path_factory.mktemp("x") / "out"
    done = export(matrices, folder, rows=rows)
    assert not done.refused
    want = pixels(matrices.P, X)
    for name, definition in DEFINITIONS.items():
        np.testing.assert_allclose(definition(folder, X), want, rtol=0, atol=TOLERANCE_PX, err_msg=name)


def rounding_of_pitch(matrices):
    """mm: where a format holds points of the panel alone, a pitch is the difference of two over half a panel of pixels,
    each rounded to its last bit, in the file and in what it is calculated from."""
    views = matrices.decompose()
    farthest = max(np.abs(views.source).max(), np.abs(views.centre).max())
    return 4 * np.finfo(float).eps * farthest / (min(matrices.n_u, matrices.n_v) / 2)


@pytest.mark.slow
@given(matrices=geometries())
@QUICK
def test_every_format_comes_back(matrices, tmp_path_factory):
    """Through the folder alone, without a single option, in any format and either row order."""
    folder = tmp_path_factory.mktemp("x") / "out"
    for rows in ("bottom", "top"):
        export(matrices, folder, rows=rows, force=True)
        for name in FORMATS:
            back = read_geometry(folder, format=name)
            np.testing.assert_allclose(back.project(X), pixels(matrices.P, X), rtol=0, atol=TOLERANCE_PX, err_msg=name)
            assert (back.n_u, back.n_v, back.pose_id) == (matrices.n_u, matrices.n_v, matrices.pose_id)
            np.testing.assert_allclose(
                [back.p_u, back.p_v], [matrices.p_u, matrices.p_v], rtol=1e-12, atol=rounding_of_pitch(matrices)
            )
            np.testing.assert_allclose(np.linalg.norm(back.P[:, 2, :3], axis=1), 1, atol=1e-12)


def test_an_aligned_circular_scan_sits_at_every_gimbal_lock(tmp_path):
    matrices = circular_matrices()
    export(matrices, tmp_path / "out")
    for name, definition in DEFINITIONS.items():
        np.testing.assert_allclose(
            definition(tmp_path / "out", X), pixels(matrices.P, X), rtol=0, atol=TOLERANCE_PX, err_msg=name
        )


def test_rtk_turns_its_gantry_about_its_own_axis(tmp_path):
    """An aligned circular scan has gantry angles only: the condition for RTK's FDK and its angular weights."""
    export(circular_matrices(n=8), tmp_path / "out", formats=["rtk"])
    text = (tmp_path / "out" / "rtk.xml").read_text()
    angles = {
        k: [float(s.split("<")[0]) for s in text.split(f"<{k}>")[1:]]
        for k in ("GantryAngle", "OutOfPlaneAngle", "InPlaneAngle")
    }
    turn = np.exp(1j * np.radians(angles["GantryAngle"]))
    np.testing.assert_allclose(turn, np.exp(-2j * np.pi * np.arange(8) / 8), atol=1e-12)
    for k in ("OutOfPlaneAngle", "InPlaneAngle"):
        np.testing.assert_allclose(np.exp(1j * np.radians(angles[k])), 1, atol=1e-12)


def test_only_the_formats_that_can_follow_the_row_order(tmp_path):
    export(random_matrices(5), tmp_path / "out", rows="top")
    order = {name: entry["row0"] for name, entry in manifest(tmp_path / "out")["formats"].items()}
    assert order == {
        "astra": "top",
        "rtk": "bottom",
        "leap": "top",
        "tigre": "bottom",
        "cil": "top",
        "cera": "top",
        "openct": "bottom",
        "ctsimu": "bottom",
        "pyronn": "top",
        "thd": "top",
        "rx": "top",
    }
