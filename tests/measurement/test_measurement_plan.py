"""Measurement plans: what they may say, and what comes out of a volume whose truth is known."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
from blurred_shapes import as_volume
from scipy.special import ndtr

from tomopose.errors import FileError, InputError, SchemaVersionError, UnitError
from tomopose.measurement.measure import measure
from tomopose.measurement.plan import plan_from, plan_schema, read_plan
from tomopose.measurement.results import write_results
from tomopose.volume import VoxelGrid

V, SIGMA = 0.1, 0.1
HALF = np.array([1.73, 1.41, 1.92])
CENTRE = np.array([0.32, -0.21, 0.14])

PLAN = """
schema = "tomopose/measurement-plan/1"
unit = "mm"
name = "block"

[alignment]
kind = "datum"
datums = ["top", "front", "side"]
start = [[1, 0, 0, 0.30], [0, 1, 0, -0.20], [0, 0, 1, 0.15]]

[features.top]
kind = "plane"
point = [0, 0, 1.92]
direction = [0, 0, 1]
u = [1.73, 0, 0]
v = [0, 1.41, 0]

[features.bottom]
kind = "plane"
point = [0, 0, -1.92]
direction = [0, 0, -1]
u = [1.73, 0, 0]
v = [0, 1.41, 0]

[features.front]
kind = "plane"
point = [0, 1.41, 0]
direction = [0, 1, 0]
u = [1.73, 0, 0]
v = [0, 0, 1.92]

[features.side]
kind = "plane"
point = [1.73, 0, 0]
direction = [1, 0, 0]
u = [0, 1.41, 0]
v = [0, 0, 1.92]
source = "surface"

[[measurands]]
name = "L1"
kind = "distance"
of = ["top", "bottom"]
calibrated_mm = 3.84
u_calibrated_mm = 0.0003
mpe = { A_um = 9.0, K = 50.0 }

[[measurands]]
name = "square"
kind = "angle"
of = ["top", "side"]
nominal_deg = 90

[[measurands]]
name = "flatness"
kind = "form_95"
of = ["top"]
tolerance_mm = 0.002
nominal_mm = 0.0

[[measurands]]
name = "height"
kind = "z"
of = ["top"]
"""


def block(noise=0.0, seed=0):
    grid = VoxelGrid(shape=(58, 52, 57), spacing=np.full(3, V))
    axes = [grid.origin[a] + V * np.arange(grid.n_xyz[a]) for a in range(3)]
    x, y, z = (ndtr((s - c + h) / SIGMA) - ndtr((s - c - h) / SIGMA)
               for s, c, h in zip(axes, CENTRE, HALF, strict=True))
    values = z[:, None, None] * y[None, :, None] * x[None, None, :]
    return as_volume(values + noise * np.random.default_rng(seed).standard_normal(grid.shape), grid)


@pytest.fixture
def document():
    return tomllib.loads(PLAN)


@pytest.fixture(scope="module")
def plan():
    return plan_from(tomllib.loads(PLAN))


def test_a_clean_block(plan):
    found = measure(block(), plan)
    by_name = {r.name: r for r in found.results}
    length = by_name["L1"]
    assert length.value == pytest.approx(3.84, abs=1e-4 * V)
    assert length.direction == "bidirectional"
    assert length.error == pytest.approx(length.value - 3.84)
    assert length.limit == pytest.approx((9 + 3.84 / 50) / 1000)
    assert length.within
    assert by_name["square"].value == pytest.approx(np.pi / 2, abs=1e-6)
    assert by_name["flatness"].within
    assert by_name["height"].value == pytest.approx(CENTRE[2] + HALF[2], abs=2e-6)


def test_repeats_side_by_side_and_their_files(plan, tmp_path):
    found = measure({f"scan {k}": block(0.03, k) for k in range(4)}, plan)
    assert found.volumes == ("scan 0", "scan 1", "scan 2", "scan 3")
    repeat = {r.name: r for r in found.repeats()}["L1"]
    values = [r.value for r in found.results if r.name == "L1"]
    assert repeat.n == 4
    assert repeat.s == pytest.approx(np.std(values, ddof=1))
    assert 2 * repeat.s <= repeat.U
    write_results(found, tmp_path / "out")
    document = json.loads((tmp_path / "out" / "measurement.json").read_text(encoding="utf-8"))
    assert document["schema"] == "tomopose/measurement/1"
    assert len(document["results"]) == 16
    lines = (tmp_path / "out" / "measurement.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 17
    with pytest.raises(FileError, match="exists"):
        write_results(found, tmp_path / "out")


def test_the_same_numbers_twice(plan):
    one, two = (measure(block(0.03, 7), plan) for _ in range(2))
    assert [r.value for r in one.results] == [r.value for r in two.results]


def test_expansion_to_twenty_degrees(document):
    document["temperature_C"], document["expansion_per_K"] = 30.0, 23e-6
    found = measure(block(), plan_from(document))
    assert {r.name: r.value for r in found.results}["L1"] == pytest.approx(3.84 / (1 + 23e-5), abs=1e-4 * V)


def test_the_schema_is_published():
    schema = plan_schema()
    assert {"schema", "unit", "features", "measurands", "spheres"} <= set(schema["properties"])


def test_a_plan_is_read_from_toml(tmp_path):
    path = tmp_path / "plan.toml"
    path.write_text(PLAN, encoding="utf-8")
    assert read_plan(path).name == "block"
    with pytest.raises(FileError, match="does not exist"):
        read_plan(tmp_path / "other.toml")
    path.write_text("unit = ", encoding="utf-8")
    with pytest.raises(FileError, match="TOML"):
        read_plan(path)


class TestBadPlans:
    def test_another_schema(self, document):
        with pytest.raises(SchemaVersionError):
            plan_from(document | {"schema": "tomopose/measurement-plan/9"})

    def test_no_unit(self, document):
        del document["unit"]
        with pytest.raises(UnitError, match="unit"):
            plan_from(document)

    def test_an_unknown_feature(self, document):
        document["measurands"][0]["of"] = ["top", "lid"]
        with pytest.raises(InputError, match="unknown feature lid"):
            plan_from(document)

    def test_an_unknown_key(self, document):
        document["features"]["top"]["radius"] = 3
        with pytest.raises(InputError, match="radius"):
            plan_from(document)

    def test_an_incomplete_feature(self, document):
        del document["features"]["top"]["u"]
        with pytest.raises(InputError, match="needs u"):
            plan_from(document)

    def test_one_feature_for_a_distance(self, document):
        document["measurands"][0]["of"] = ["top"]
        with pytest.raises(InputError, match="2 feature"):
            plan_from(document)

    def test_a_region_without_points(self, document):
        document["alignment"] = {"kind": "none", "start": [[1, 0, 0, 9.0], [0, 1, 0, 0], [0, 0, 1, 0]]}
        with pytest.raises(InputError, match="'top'"):
            measure(block(), plan_from(document))

    def test_a_surface_region_without_points(self, document):
        document["features"] = {"top": document["features"]["top"] | {"source": "surface", "point": [0, 0, 7.0]}}
        document["alignment"] = {"kind": "none"}
        document["measurands"] = [{"name": "z", "kind": "z", "of": ["top"]}]
        with pytest.raises(InputError, match="no surface points"):
            measure(block(), plan_from(document))

    def test_a_safety_distance_that_leaves_nothing(self, document):
        document["features"]["top"]["safety_mm"] = 5.0
        with pytest.raises(InputError, match="leaves nothing"):
            measure(block(), plan_from(document))

    def test_a_measurand_that_a_feature_does_not_have(self, document):
        document["measurands"] = [{"name": "D", "kind": "diameter", "of": ["top"]}]
        with pytest.raises(InputError, match="no radius"):
            measure(block(), plan_from(document))
