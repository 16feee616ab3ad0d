"""The acceptance protocol: each quantity by its definition, decided by the uncertainty of the test."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import typer
from blurred_shapes import as_volume, balls_volume

from tomopose.cli import measure as verb
from tomopose.errors import InputError
from tomopose.io.volume_files import write_volume
from tomopose.measurement.acceptance.protocol import acceptance_protocol
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.conformity import Decision
from tomopose.measurement.features.fits import fit_sphere
from tomopose.measurement.measure import evaluate
from tomopose.measurement.plan import plan_from
from tomopose.measurement.probing import sphere_pattern
from tomopose.measurement.results import MeasurementResults
from tomopose.volume import VoxelGrid

CENTRES = np.array([[0, 0, 0], [20.0, 0, 3], [0, 25.0, 1], [5, 5, 30.0], [12, 18, 9.0]])
DIAMETER = 5.0


def document(**acceptance):
    return {
        "schema": "tomopose/measurement-plan/1",
        "unit": "mm",
        "name": "standard",
        "spheres": {
            "centres": CENTRES.tolist(),
            "diameter_mm": DIAMETER,
            "u_distance_mm": 0.0003,
            "u_diameter_mm": 0.0002,
        },
        "acceptance": {"u_form_mm": 0.0001, **acceptance},
    }


def results_of(plan, scale=1.0, growth=0.0, wave=0.0):
    """Results of balls in closed form: centres scaled, radii larger by growth, a wave of that amplitude on ball 1."""
    features = {}
    for k, c in enumerate(CENTRES):
        x, n = sphere_pattern(c * scale, DIAMETER / 2 + growth, 3000)
        if k == 0:
            x = x + wave * np.sign(n[:, :1] * n[:, 1:2]) * n
        features[f"sphere {k + 1:02d}"] = fit_sphere(x)
    rows = tuple(replace(r, volume="scan") for r in evaluate(plan, features, Alignment.none()))
    return MeasurementResults(plan_name="standard", results=rows, features={"scan": features})


def test_each_quantity_is_what_its_definition_says():
    plan = plan_from(document(mpe_E={"A_um": 9, "K": 50}))
    found = acceptance_protocol(results_of(plan, scale=1.0002, growth=0.001, wave=0.004), plan, "scan")
    sd = found.of("SD")
    true = [np.linalg.norm(CENTRES[i] - CENTRES[j]) for i, j in zip(*np.triu_indices(5, 1), strict=True)]
    assert [x.test_value for x in sd] == pytest.approx([0.0002 * d for d in true], abs=2e-5)
    assert [x.test_value for x in found.of("P_S")[1:]] == pytest.approx([0.002] * 4, abs=1e-9)
    # 25 patches of a wave of +-4 um: less than the whole range of 8, which is given beside it.
    assert 0.003 < found.of("P_F")[0].test_value < 0.0081
    assert found.informative["P_F of all points, largest"] == pytest.approx(0.008, rel=0.01)
    assert found.of("P_F")[1].test_value < 1e-9
    # Ball 1 with ball 2: SD + (P_S1 + P_S2) / 2 + P_F of the worse of both.
    e, form, size = found.of("E")[0], found.of("P_F"), found.of("P_S")
    assert e.test_value == pytest.approx(
        sd[0].test_value + (size[0].test_value + size[1].test_value) / 2 + form[0].test_value
    )
    assert e.reference == pytest.approx(true[0] + DIAMETER)
    assert e.mpe == pytest.approx((9 + (true[0] + DIAMETER) / 50) / 1000)


def test_a_length_that_is_too_short_is_made_shorter_by_the_form():
    plan = plan_from(document())
    found = acceptance_protocol(results_of(plan, scale=0.9995, growth=-0.001, wave=0.004), plan, "scan")
    assert found.of("E")[0].test_value == pytest.approx(
        found.of("SD")[0].test_value
        + (found.of("P_S")[0].test_value + found.of("P_S")[1].test_value) / 2
        - found.of("P_F")[0].test_value
    )


def test_the_uncertainty_is_that_of_the_test_and_not_of_the_instrument():
    plan = plan_from(document(mpe_SD={"A_um": 9}, mpe_PS_um=5, mpe_PF_um=9) | {"uncertainty": {"u_drift_mm": 0.0004}})
    found = acceptance_protocol(results_of(plan), plan, "scan")
    assert pytest.approx(2 * math.hypot(0.0003, 0.0004)) == found.of("SD")[0].U
    assert pytest.approx(2 * math.hypot(0.0002, 0.0004)) == found.of("P_S")[0].U
    assert pytest.approx(2 * 0.0001) == found.of("P_F")[0].U
    assert {found.decision(q) for q in ("SD", "P_S", "P_F")} == {Decision.CONFORMING}
    assert found.decision("E") is None


@pytest.mark.parametrize(
    ("growth", "expected"),
    [(0.0015, Decision.CONFORMING), (0.0025, Decision.NOT_DECIDABLE), (0.0035, Decision.NOT_CONFORMING)],
)
def test_one_bad_value_decides_a_quantity(growth, expected):
    plan = plan_from(document(mpe_PS_um=5))
    found = acceptance_protocol(results_of(plan, growth=growth), plan, "scan")
    assert found.decision("P_S") is expected


def test_what_is_not_stated_decides_nothing():
    content = document(mpe_SD={"A_um": 9}, mpe_PF_um=9)
    del content["spheres"]["u_distance_mm"], content["acceptance"]["u_form_mm"]
    plan = plan_from(content)
    found = acceptance_protocol(results_of(plan), plan, "scan")
    assert found.decision("SD") is Decision.NOT_DECIDABLE
    assert found.decision("P_F") is Decision.NOT_DECIDABLE
    assert any("u_distance_mm" in r and "u_form_mm" in r for r in found.remarks)


def test_the_longest_length_is_held_against_the_measuring_volume():
    plan = plan_from(document(longest_length_mm=100.0))
    found = acceptance_protocol(results_of(plan), plan, "scan")
    longest = max(x.reference for x in found.of("SD"))
    assert any(f"{longest:.0f} % of the longest" in r and "less than" in r for r in found.remarks)


def test_a_plan_without_spheres_or_with_a_corrected_scale_has_no_protocol():
    content = document()
    content["spheres"]["scale_correction"] = True
    plan = plan_from(content)
    with pytest.raises(InputError, match="scale_correction"):
        acceptance_protocol(results_of(plan), plan, "scan")
    bare = document()
    del bare["spheres"]
    bare["features"] = {"ball": {"kind": "sphere", "point": [0, 0, 0], "radius_mm": 2.5}}
    bare["measurands"] = [{"name": "D", "kind": "diameter", "of": ["ball"]}]
    with pytest.raises(InputError, match=r"needs \[spheres\]"):
        acceptance_protocol(results_of(plan), plan_from(bare), "scan")
    with pytest.raises(InputError, match="no results"):
        acceptance_protocol(results_of(plan_from(document())), plan_from(document()), "other")


@pytest.mark.slow
def test_the_command_writes_the_protocol_and_ends_with_3_where_a_limit_is_exceeded(tmp_path, capsys):
    """Seven balls in closed form with a blur of one voxel, which takes 2 sigma^2 / R off each diameter."""
    rng = np.random.default_rng(2)
    lattice = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)][:7], dtype=float)
    centres = 2.1 * lattice + rng.uniform(-0.4, 0.4, lattice.shape)
    grid = VoxelGrid.cube(n=60, spacing=0.12)
    volume = as_volume(balls_volume(grid, centres, np.full(7, 0.9), 0.12), grid)
    write_volume(tmp_path / "scan.h5", volume)
    plan = f"""
schema = "tomopose/measurement-plan/1"
unit = "mm"
name = "standard"
[spheres]
centres = {centres.tolist()}
diameter_mm = 1.8
u_distance_mm = 0.0003
u_diameter_mm = 0.0003
safety_mm = 0.1
mpe_distance = {{ A_um = 9.0, K = 50.0 }}
[acceptance]
machine = "CT of the laboratory"
mpe_PS_um = 5.0
mpe_PF_um = 9.0
u_form_mm = 0.0001
mpe_E = {{ A_um = 9.0, K = 50.0 }}
"""
    (tmp_path / "plan.toml").write_text(plan, encoding="utf-8")
    app = typer.Typer()
    verb.register(app)
    words = [str(tmp_path / "plan.toml"), "--volume", str(tmp_path / "scan.h5"), "--protocol", "--out"]
    out = tmp_path / "out"
    code = typer.main.get_command(app).main(args=[*words, str(out), "--json"], standalone_mode=False)
    said = json.loads(capsys.readouterr().out)["protocols"]["scan"]
    assert said == {"P_F": "conforming", "P_S": "not conforming", "SD": "conforming", "E": "not conforming"}
    assert code == 3
    content = json.loads((out / "protocol.json").read_text(encoding="utf-8"))
    assert content["schema"] == "tomopose/acceptance-protocol/1"
    assert content["guideline"] == "VDI/VDE 2630-1.3:2011"
    summary = {s["quantity"]: s for s in content["summary"]}
    assert summary["P_S"]["worst"]["test_value_um"] == pytest.approx(-1000 * 2 * 0.12**2 / 0.9, rel=0.05)
    assert summary["P_F"]["definition_of"] == "VDI/VDE 2630-1.3:2011"
    assert summary["E"]["definition_of"].startswith("this package")
    with (out / "protocol.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 7 + 7 + 21 + 21
    page = (out / "protocol.html").read_text(encoding="utf-8")
    for text in ("Not conforming", "CT of the laboratory", "P_S", "VDI/VDE 2630-1.3:2011", "not stated"):
        assert text in page
