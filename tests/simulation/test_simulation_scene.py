"""Scenes: the examples run, the schema says the same as the model, and what cannot be meant is refused by name."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from tomopose.errors import FileError, InputError
from tomopose.geometry.rotations import rotation_angle_between
from tomopose.simulation.objects.sphere_standard import sphere_centres, standard_layout
from tomopose.simulation.scene.build import simulate
from tomopose.simulation.scene.scene import read_scene, scene_from, scene_schema

SCENES = Path(__file__).resolve().parents[2] / "examples/scenes"

MINIMAL = {
    "schema": "tomopose/scene/1",
    "seed": 1,
    "scanner": {
        "d_SD_mm": 800.0,
        "d_SR_mm": 200.0,
        "p_u_mm": 0.8,
        "p_v_mm": 0.9,
        "u_0_px": 30.0,
        "v_0_px": 31.0,
        "n_u_px": 61,
        "n_v_px": 63,
    },
    "source": {"voltage_kV": 120.0},
    "detector": {},
    "objects": [{"kind": "ball", "diameter_mm": 4.0}],
    "poses": {"scan": {"n": 3}},
}


def changed(**parts):
    return {**MINIMAL, **parts}


@pytest.mark.parametrize(("name", "frames"), [("ball-m2.7", 189), ("ball-m5.3", 189), ("standard-3d", 1000)])
def test_the_examples_describe_the_paper_s_runs(name, frames):
    run = simulate(read_scene(SCENES / f"{name}.toml"))
    assert len(run) == frames
    assert run.scanner.magnification == pytest.approx(5.3 if "5.3" in name else 2.7, abs=0.01)
    assert run.scanner.n_u == (1024 if name == "standard-3d" else 2048)


@pytest.mark.slow
def test_the_small_example_uses_most_keys_and_is_the_same_everywhere():
    pytest.importorskip("xraydb")
    run = simulate(read_scene(SCENES / "small.toml"))
    image = run.image(2)
    assert (pickle.loads(pickle.dumps(run)).image(2, threads=2) == image).all()
    assert image.max() <= 60000
    assert (image == 0).sum() > 5
    assert 700 < np.sort(image[image > 0])[:50].mean() < 60000
    # The hexapod errs by tenths of a millimetre's lever, and the drives' stops are recorded.
    assert run.poses.T_MH_set is not None
    apart = rotation_angle_between(run.T_MH.R, run.poses.T_MH.R)
    assert 1e-5 < apart.max() < 5e-3
    assert run.truth()["poses"][0]["u_px"] != run.truth()["poses"][0]["u_ellipse_px"]


def test_truth_lies_where_the_detector_sees_the_ball():
    run = simulate(scene_from(changed(detector={"snr": 1e6})))
    image = run.image(1).astype(float)
    dark = image < 0.1 * 45000
    v, u = np.nonzero(dark)
    truth = run.truth()["poses"][1]
    # The lower half merges with nothing opaque: PEEK lets light through.
    assert u.mean() == pytest.approx(truth["u_ellipse_px"], abs=0.5)
    assert v.mean() == pytest.approx(truth["v_ellipse_px"], abs=0.5)


def test_the_schema_names_every_key_and_is_json():
    schema = json.loads(json.dumps(scene_schema()))
    assert set(schema["properties"]) >= {"schema", "seed", "scanner", "source", "detector", "objects", "poses"}
    assert "folder" not in schema["properties"]
    assert "blur_sigma_px" in schema["$defs"]["DetectorPart"]["properties"]


def test_the_published_schema_is_the_model_s():
    published = SCENES.parents[1] / "docs/formats/scene.schema.json"
    assert json.loads(published.read_text(encoding="utf-8")) == json.loads(json.dumps(scene_schema()))


@pytest.mark.parametrize(
    ("document", "words"),
    [
        (changed(schema="tomopose/scene/2"), "schema"),
        (changed(source={}), "either voltage_kV or spectrum"),
        (changed(detector={"snr": 10.0, "photons": 100.0}), "either snr or photons"),
        (changed(detector={"blur_px": 1.0}), "detector.blur_px"),
        (changed(poses={}), "one of file, grid and scan"),
        (changed(objects=[]), "objects"),
        (changed(objects=[{"kind": "teapot"}]), "objects"),
        (changed(objects=[{"kind": "ball"}, {"kind": "ball"}]), "at most one ball"),
        (changed(objects=[{"kind": "ball", "frame": "W"}]), "moves with the manipulator"),
        (changed(objects=[{"kind": "ball", "material": "wood"}]), "'wood' is unknown"),
        (changed(objects=[{"kind": "solid", "material": "Al", "shapes": [{"kind": "box"}]}]), "needs size_mm"),
        (
            changed(
                objects=[
                    {
                        "kind": "solid",
                        "material": "Al",
                        "shapes": [{"kind": "sphere", "do": "subtract", "radius_mm": 1.0}],
                    }
                ]
            ),
            "cannot subtract",
        ),
        (changed(materials={"x": {"density_g_cm3": 1.0}}), "either formula or mass_fractions"),
        (changed(poses={"file": "poses.csv"}), "takes its poses from poses.csv"),
        (changed(scanner={**MINIMAL["scanner"], "d_SR_mm": 900.0}), "d_SR"),
    ],
)
def test_what_cannot_be_meant_is_refused(document, words):
    with pytest.raises(InputError, match=words):
        simulate(scene_from(document))


def test_files_that_are_missing_or_damaged(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        read_scene(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("seed = = 3")
    with pytest.raises(FileError, match="no TOML"):
        read_scene(tmp_path / "bad.toml")
    scene = scene_from(changed(source={"spectrum": "s.csv"}), folder=str(tmp_path))
    with pytest.raises(FileError, match=r"s\.csv"):
        simulate(scene)
    (tmp_path / "s.csv").write_text("keV,photons\n10,1\n20,1\n")
    with pytest.raises(InputError, match="energy_keV"):
        simulate(scene)
    (tmp_path / "s.csv").write_text("energy_keV,photons\n60,1\n80,2\n")
    assert simulate(scene).spectrum.energy.tolist() == [60.0, 80.0]


def test_the_standard_s_coordinates_are_its_layout():
    c = sphere_centres()
    assert c.shape == (27, 3)
    np.testing.assert_allclose(c, standard_layout(), atol=1e-12)
    distances = np.sort(np.linalg.norm(c[:, None] - c[None], axis=2)[np.triu_indices(27, 1)])
    assert distances[0] > 6.0
    assert np.diff(distances).min() > 5e-4
