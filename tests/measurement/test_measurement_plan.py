"""Measurement plans: what they may say, and what comes out of a volume whose truth is known."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
from blurred_shapes import as_volume
from scipy.special import ndtr

from tomopose.errors import FileError, InputError, SchemaVersionError, UnitError
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.measurement.alignment import datum, from_datums
from tomopose.measurement.conformity import Decision
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
    x, y, z = (
        ndtr((s - c + h) / SIGMA) - ndtr((s - c - h) / SIGMA) for s, c, h in zip(axes, CENTRE, HALF, strict=True)
    )
    values = z[:, None, None] * y[None, :, None] * x[None, None, :]
    return as_volume(values + noise * np.random.default_rng(seed).standard_normal(grid.shape), grid)


@pytest.fixture
def document():
    return tomllib.loads(PLAN)


@pytest.fixture(scope="module")
def plan():
    return plan_from(tomllib.loads(PLAN))


@pytest.mark.slow
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
    assert by_name["flatness"].value < by_name["flatness"].limit
    # One surface does not say how uncertain its form is, so no conformity is proved.
    assert by_name["flatness"].decision is Decision.NOT_DECIDABLE
    assert by_name["height"].value == pytest.approx(CENTRE[2] + HALF[2], abs=2e-6)


@pytest.mark.slow
def test_groups_of_repeats_side_by_side_and_their_files(document, tmp_path):
    """Three scans repeat one measurement; a fourth is another trajectory and no repeat of them."""
    document["repeats"] = {"3D scan": ["scan 0", "scan 1", "scan 2"]}
    found = measure({f"scan {k}": block(0.03, k) for k in range(4)}, plan_from(document))
    assert found.volumes == ("scan 0", "scan 1", "scan 2", "scan 3")
    repeats = found.repeats()
    assert {r.group for r in repeats} == {"3D scan"}
    repeat = {r.name: r for r in repeats}["L1"]
    values = [r.value for r in found.results if r.name == "L1" and r.volume != "scan 3"]
    assert repeat.n == 3
    assert repeat.mean == pytest.approx(np.mean(values))
    assert repeat.s == pytest.approx(np.std(values, ddof=1))
    u = np.hypot(max(repeat.s, np.mean([r.u for r in found.results if r.name == "L1"][:3])), 0.0003)
    assert 2 * repeat.s <= repeat.U
    assert 1.95 * u + abs(repeat.mean - 3.84) < repeat.U
    assert repeat.U_mean < repeat.U
    write_results(tmp_path / "out", found)
    document = json.loads((tmp_path / "out" / "measurement.json").read_text(encoding="utf-8"))
    assert document["schema"] == "tomopose/measurement/1"
    assert len(document["results"]) == 16
    lines = (tmp_path / "out" / "measurement.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 17
    with pytest.raises(FileError, match="exists"):
        write_results(tmp_path / "out", found)


def dented(depth, side=0.25, rim=0.12):
    """The block with a dent, mm, on its top: a square of 2 side in its middle, smooth at its rim."""
    whole = block()
    grid = whole.grid
    z, y, x = (grid.origin[2 - a] + V * np.arange(grid.shape[a]) for a in range(3))
    lateral = [ndtr((s - c + side) / rim) - ndtr((s - c - side) / rim) for s, c in ((y, CENTRE[1]), (x, CENTRE[0]))]
    top = CENTRE[2] + HALF[2] - depth / (2 * ndtr(side / rim) - 1) ** 2 * lateral[0][:, None] * lateral[1][None, :]
    bare = ndtr((CENTRE[2] + HALF[2] - z) / SIGMA)[:, None, None]
    return as_volume(whole.values * ndtr((top[None] - z[:, None, None]) / SIGMA) / np.maximum(bare, 1e-300), grid)


def test_the_form_of_a_dent_is_its_depth(document):
    """50 um on some percent of a face: an outlier rule would set the dent aside and state the noise."""
    document["measurands"] = [
        {"name": "flatness", "kind": "form", "of": ["top"]},
        {"name": "zone", "kind": "form", "of": ["top"], "reference": "minimum-zone"},
        {"name": "kept", "kind": "form", "of": ["robust"], "points": "kept"},
        {"name": "all of robust", "kind": "form", "of": ["robust"]},
    ]
    document["features"]["robust"] = document["features"]["top"] | {"outliers": 3.0}
    found = {r.name: r for r in measure(dented(0.05), plan_from(document)).results}
    for name in ("flatness", "zone", "all of robust"):
        assert found[name].value == pytest.approx(0.05, rel=0.05)
    assert found["flatness"].n_set_aside == 0
    assert "all points" in found["flatness"].method
    assert "minimum-zone plane" in found["zone"].method
    assert found["zone"].value <= found["flatness"].value + 1e-12
    # The robust option is the plan's, and the result says how many points it set aside.
    assert found["kept"].value < 0.5 * found["flatness"].value
    assert found["kept"].n_set_aside > 10
    assert f"{found['kept'].n_set_aside} points set aside" in found["kept"].method


@pytest.mark.slow
def test_a_form_beyond_its_tolerance_does_not_conform_unless_noise_makes_it(document):
    document["measurands"] = [{"name": "flatness", "kind": "form", "of": ["top"], "tolerance_mm": 0.01}]
    dent = measure(dented(0.05), plan_from(document)).results[0]
    noisy = measure(block(0.1, 2), plan_from(document)).results[0]
    assert min(dent.value, noisy.value) > 0.01
    assert dent.decision is Decision.NOT_CONFORMING
    assert noisy.decision is Decision.NOT_DECIDABLE


def test_reference_features_of_a_plan_are_fitted_and_named(document):
    document["features"]["top"]["reference"] = "minimum-zone"
    found = measure(block(0.03, 1), plan_from(document))
    top = found.features["volume"]["top"]
    assert top.association == "minimum-zone"
    assert len(top.contacts) == 4
    length = {r.name: r for r in found.results}["L1"]
    assert length.association == "least-squares and minimum-zone"
    assert np.isnan(length.u)
    assert found.to_json()["features"]["volume"]["top"]["association"] == "minimum-zone"


def test_a_straightness_is_signed_along_the_probed_normal(document):
    """A profile that bends to both sides: distances without a sign would state half of it."""
    points = np.linspace(-1, 1, 100)
    document["features"] = {
        "track": {
            "kind": "line",
            "point": [0, 0, 1.92],
            "direction": [1, 0, 0],
            "normal": [0, 0, 1],
            "length_mm": 2.0,
            "safety_mm": 0.0,
            "n_points": len(points),
        }
    }
    document["alignment"] = {"kind": "none", "start": [[1, 0, 0, 0.32], [0, 1, 0, -0.21], [0, 0, 1, 0.14]]}
    document["measurands"] = [
        {"name": "s", "kind": "form", "of": ["track"]},
        {"name": "zone", "kind": "form", "of": ["track"], "reference": "minimum-zone"},
    ]
    found = measure(block(0.03, 1), plan_from(document))
    track = found.features["volume"]["track"]
    value = {r.name: r.value for r in found.results}
    assert track.residuals.min() < 0 < track.residuals.max()
    assert value["s"] == pytest.approx(np.ptp(track.residuals))
    assert 0.5 * value["s"] < value["zone"] <= value["s"] + 1e-12


class TestStatedTerms:
    @pytest.mark.slow
    def test_what_no_scan_shows_is_stated_and_added(self, document):
        document["uncertainty"] = {"u_workpiece_mm": 0.0004, "u_drift_mm": 0.0002, "u_temperature_K": 0.5}
        document["expansion_per_K"] = 23e-6
        found = measure(block(0.03, 1), plan_from(document))
        length, budget = found.results[0], found.budgets()[0]
        assert length.stated == {
            "workpiece": 0.0004,
            "temperature": pytest.approx(3.84 * 23e-6 * 0.5, rel=1e-3),
            "drift": 0.0002,
        }
        assert budget.u == pytest.approx(np.hypot(np.hypot(length.u, 0.0004), length.stated["temperature"]))
        assert budget.interval == "fit, workpiece, temperature; without the systematic part"
        # The reference's own uncertainty belongs to the error, not to the value.
        assert budget.U_error > budget.U
        assert "workpiece" in found.budgets_csv().splitlines()[0]

    @pytest.mark.slow
    def test_an_unstated_uncertainty_of_the_reference_proves_no_conformity(self, document):
        del document["measurands"][0]["u_calibrated_mm"]
        found = measure(block(), plan_from(document))
        assert found.results[0].decision is Decision.NOT_DECIDABLE
        document["measurands"][0]["calibrated_mm"] = 3.9
        assert measure(block(), plan_from(document)).out_of_limits[0].name == "L1"

    @pytest.mark.slow
    def test_a_form_needs_no_nominal_value_to_be_judged(self, document):
        del document["measurands"][2]["nominal_mm"]
        found = measure(block(), plan_from(document))
        assert {r.name: r for r in found.results}["flatness"].reference == 0.0


@pytest.mark.slow
def test_volumes_are_no_repeats_unless_the_plan_says_so(plan):
    found = measure({"circular": block(0.03, 1), "tilted": block(0.03, 2)}, plan)
    assert found.repeats() == ()


@pytest.mark.slow
def test_the_transform_of_each_volume_is_reported(plan):
    found = measure(block(), plan)
    alignment = found.alignments["volume"]
    assert alignment.rule == "datum, 3-2-1"
    assert alignment.t == pytest.approx(CENTRE, abs=1e-4)
    assert found.to_json()["alignments"]["volume"]["rotation_vector_rad"] == pytest.approx(np.zeros(3), abs=1e-5)


def turned_block(turn, shift):
    """The block turned about its centre and moved, mm; blurred along its own axes, as sigma is the same along all."""
    grid = VoxelGrid(shape=(62, 58, 60), spacing=np.full(3, V))
    z, y, x = np.meshgrid(*(grid.origin[2 - a] + V * np.arange(grid.shape[a]) for a in range(3)), indexing="ij")
    local = (np.stack([x, y, z], axis=-1) - CENTRE - shift) @ turn
    values = np.ones(grid.shape)
    for a in range(3):
        values *= ndtr((local[..., a] + HALF[a]) / SIGMA) - ndtr((local[..., a] - HALF[a]) / SIGMA)
    return as_volume(values, grid)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["datum", "best-fit"])
def test_a_turned_part_is_found_by_datums_and_by_best_fit(document, kind):
    turn, shift = exp_rotation(np.array([0.012, -0.009, 0.015])), np.array([0.03, -0.02, 0.04])
    document["alignment"]["kind"] = kind
    for feature in document["features"].values():
        feature["source"] = "normals"
    found = measure(turned_block(turn, shift), plan_from(document))
    alignment = found.alignments["volume"]
    assert np.linalg.norm(log_rotation(alignment.R @ turn.T)) < 3e-5
    # The plan holds no face at the far side along y and x, so best fit and datums place the part alike.
    assert alignment.t == pytest.approx(CENTRE + shift, abs=1e-4)
    assert {r.name: r for r in found.results}["L1"].value == pytest.approx(3.84, abs=5e-5)


def test_lines_and_circles_are_features_of_a_plan(document):
    """A bore of 0.7 mm radius through a blurred slab: circle in it, line on its face."""
    grid = VoxelGrid(shape=(40, 44, 46), spacing=np.full(3, V))
    z, y, x = np.meshgrid(*(grid.origin[2 - a] + V * np.arange(grid.shape[a]) for a in range(3)), indexing="ij")
    slab = ndtr((z + 1.21) / SIGMA) - ndtr((z - 1.21) / SIGMA)
    values = slab * ndtr((np.hypot(x - 0.13, y + 0.07) - 0.7) / SIGMA)
    features = {
        "bore": {
            "kind": "circle",
            "point": [0.1, -0.1, 0.2],
            "direction": [0, 0, 1],
            "radius_mm": 0.7,
            "inward": True,
            "n_points": 200,
        },
        "track": {
            "kind": "line",
            "point": [0, 1.5, 1.21],
            "direction": [1, 0, 0],
            "normal": [0, 0, 1],
            "length_mm": 3.0,
            "safety_mm": 0.2,
            "n_points": 100,
        },
    }
    measurands = [
        {"name": "D", "kind": "diameter", "of": ["bore"]},
        {"name": "X", "kind": "x", "of": ["bore"]},
        {"name": "Z", "kind": "z", "of": ["track"]},
        {"name": "straightness", "kind": "form", "of": ["track"]},
        {"name": "between", "kind": "distance", "of": ["bore", "track"]},
    ]
    found = measure(
        as_volume(values, grid),
        plan_from(document | {"features": features, "measurands": measurands, "alignment": {"kind": "none"}}),
    )
    value = {r.name: r.value for r in found.results}
    assert value["D"] == pytest.approx(1.4, abs=2e-3)
    assert value["X"] == pytest.approx(0.13, abs=1e-4)
    assert value["Z"] == pytest.approx(1.21, abs=1e-4)
    assert value["straightness"] < 1e-3
    assert value["between"] == pytest.approx(np.hypot(1.5 + 0.07, 1.21 - 0.2), abs=1e-3)


class TestDatums:
    """3-2-1 from features of any kind: a known motion is found again."""

    turn, shift = exp_rotation(np.array([0.3, -0.7, 1.1])), np.array([4.0, -3.0, 2.0])
    plane = ("plane", [1.0, 2, 5], [0, 0, 1])
    side = ("plane", [4.0, 0, 1], [1, 0, 0])
    front = ("plane", [0.0, 7, 1], [0, 1, 0])
    bore = ("cylinder", [2.0, 3, 1], [0, 0, 1])
    pin = ("cylinder", [9.0, 1, 4], [0, 0, 1])
    rod = ("cylinder", [1.0, 1, 3], [1, 0, 0])
    ball = ("sphere", [6.0, -2, 1], None)

    def found(self, *datums):
        nominal = tuple(datum(*d) for d in datums)
        measured = tuple(
            datum(kind, self.turn @ x + self.shift, None if n is None else self.turn @ n) for kind, x, n in datums
        )
        return from_datums(nominal, measured)

    @pytest.mark.parametrize(
        "names",
        [
            ("plane", "side", "front"),
            ("plane", "bore", "pin"),
            ("plane", "rod", "ball"),
            ("rod", "ball", "plane"),
            ("plane", "bore", "ball"),
            ("bore", "pin", "plane"),
        ],
    )
    def test_a_motion_is_found(self, names):
        alignment = self.found(*(getattr(self, n) for n in names))
        assert np.abs(alignment.R - self.turn).max() < 1e-12
        assert np.abs(alignment.t - self.shift).max() < 1e-12

    def test_what_stays_free_is_refused(self):
        with pytest.raises(InputError, match="rotation about the first"):
            self.found(self.plane, ("plane", [1.0, 2, 9], [0, 0, -1]), ("plane", [1.0, 2, 3], [0, 0, 1]))
        with pytest.raises(InputError, match="free to move along"):
            self.found(self.plane, self.side, ("plane", [8.0, 1, 2], [1, 0, 0]))
        with pytest.raises(InputError, match="no direction"):
            self.found(self.ball, self.plane, self.side)


@pytest.mark.slow
def test_the_same_numbers_twice(plan):
    one, two = (measure(block(0.03, 7), plan) for _ in range(2))
    assert [r.value for r in one.results] == [r.value for r in two.results]


@pytest.mark.slow
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
    def test_repeats_of_a_volume_that_is_not_there_or_twice(self, document):
        with pytest.raises(InputError, match="absent"):
            measure(block(), plan_from(document | {"repeats": {"a": ["absent", "volume"]}}))
        with pytest.raises(InputError, match="two groups"):
            plan_from(document | {"repeats": {"a": ["one", "two"], "b": ["two"]}})

    def test_a_datum_that_is_no_feature(self, document):
        document["alignment"]["datums"] = ["top", "front", "lid"]
        with pytest.raises(InputError, match="lid"):
            plan_from(document)

    def test_a_circle_is_probed(self, document):
        document["features"]["c"] = {
            "kind": "circle",
            "point": [0, 0, 0],
            "direction": [0, 0, 1],
            "radius_mm": 1,
            "source": "surface",
        }
        with pytest.raises(InputError, match="probed"):
            plan_from(document)

    @pytest.mark.slow
    def test_a_line_whose_normal_runs_along_it(self, document):
        document["features"]["l"] = {
            "kind": "line",
            "point": [0, 0, 1.92],
            "direction": [1, 0, 0],
            "length_mm": 2,
            "normal": [2, 0, 0],
        }
        with pytest.raises(InputError, match="runs along it"):
            measure(block(), plan_from(document))

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"kind": "angle", "of": ["top", "side"], "tolerance_mm": 0.1, "nominal_deg": 90}, "takes no tolerance_mm"),
            ({"kind": "z", "of": ["top"], "tolerance_mm": 0.1}, "no value that it belongs to"),
            ({"kind": "z", "of": ["top"], "points": "kept"}, "belong to form"),
            ({"kind": "form", "of": ["top"], "reference": "maximum-inscribed"}, "has no maximum-inscribed"),
        ],
    )
    def test_a_measurand_that_says_two_things(self, document, change, words):
        document["measurands"] = [{"name": "m", **change}]
        with pytest.raises(InputError, match=words):
            plan_from(document)

    def test_a_feature_that_has_no_such_reference(self, document):
        document["features"]["top"]["reference"] = "minimum-circumscribed"
        with pytest.raises(InputError, match="no minimum-circumscribed"):
            plan_from(document)

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

    @pytest.mark.slow
    def test_a_measurand_that_a_feature_does_not_have(self, document):
        document["measurands"] = [{"name": "D", "kind": "diameter", "of": ["top"]}]
        with pytest.raises(InputError, match="no radius"):
            measure(block(), plan_from(document))
