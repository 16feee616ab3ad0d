"""`tp.plan_scan`: a planned scan as one call, and bad input in words."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from test_planning_predict import HALF, box_part

import tomopose as tp
from tomopose.errors import InputError, OutOfReachError
from tomopose.measurement.plan import plan_from

SCANNER = tp.Scanner(d_SD=1000.0, d_SR=400.0, p_u=1.6, p_v=1.5, u_0=23.3, v_0=20.1, n_u=47, n_v=43)
COARSE = {"alpha_step": math.radians(15.0), "tilt_step": math.radians(5.0), "sweeps": 2}


def sides() -> tp.MeasurementPlan:
    x = float(HALF[0])
    faces = {
        side: {"kind": "plane", "point": [s * x, 0, 0], "direction": [s, 0, 0], "u": [0, 5, 0], "v": [0, 0, 2.5]}
        for side, s in (("left", -1), ("right", 1))
    }
    rows = [{"name": "width", "kind": "distance", "of": ["left", "right"]}]
    return plan_from({"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": faces, "measurands": rows})


def test_a_part_becomes_poses_matrices_and_an_uncertainty_of_each_length():
    found = tp.plan_scan(box_part().mesh, views=8, mu_per_mm=0.05, scanner=SCANNER, features=sides(), options=COARSE)
    assert len(found.poses) == 8
    assert found.matrices.P.shape == (8, 3, 4)
    assert 0 < found.J <= found.bound
    assert set(found.u_mm) == {"width"}
    assert 0 < found.u_mm["width"] < 0.5
    assert found.document["lengths"] == [{"name": "width", "u_mm": found.u_mm["width"]}]
    assert json.loads(json.dumps(found.document))["constants"]["sweeps"] == 2


@pytest.mark.slow
def test_an_exact_uncertainty_is_asked_for_and_stated():
    how = {"views": 6, "mu_per_mm": 0.05, "scanner": SCANNER, "features": sides(), "options": COARSE}
    found, filters = (tp.plan_scan(box_part().mesh, **how, uncertainty=way) for way in ("exact", "filters"))
    assert found.document["constants"]["uncertainty"] == "exact"
    assert found.J == filters.J
    assert found.u_mm["width"] != filters.u_mm["width"]
    assert found.u_mm["width"] == pytest.approx(filters.u_mm["width"], rel=0.5)


def test_bad_input_is_answered_in_words(tmp_path: Path):
    mesh = box_part().mesh
    asked = {"views": 8, "mu_per_mm": 0.05}
    with pytest.raises(InputError, match="needs a scanner or a calibration"):
        tp.plan_scan(mesh, **asked)
    with pytest.raises(InputError, match="sweep is not known"):
        tp.plan_scan(mesh, **asked, scanner=SCANNER, options={"sweep": 2})
    with pytest.raises(InputError, match=r"sweeps is 1.5"):
        tp.plan_scan(mesh, **asked, scanner=SCANNER, options={"sweeps": 1.5})
    with pytest.raises(InputError, match="open: 3 edges"):
        tp.plan_scan(tp.Mesh(points=mesh.points, faces=mesh.faces[1:]), **asked, scanner=SCANNER)
    large = tp.Mesh(points=4 * mesh.points, faces=mesh.faces)
    with pytest.raises(OutOfReachError, match="larger than the view"):
        tp.plan_scan(large, **asked, scanner=SCANNER, options=COARSE)
    limits = tmp_path / "limits.toml"
    limits.write_text("[travel]\nz_mm = [3, -3]\n", encoding="utf-8")
    with pytest.raises(InputError, match="contradicts itself"):
        tp.plan_scan(mesh, **asked, scanner=SCANNER, limits=limits)
