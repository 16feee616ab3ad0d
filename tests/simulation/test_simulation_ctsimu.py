"""A run written as a CTSimU scenario and read back images the same; what cannot be read is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from tomopose import PoseSequence, RigidTransform, Scanner
from tomopose.errors import FileError, InputError
from tomopose.geometry.frames import Frame
from tomopose.simulation.objects.mesh import write_stl
from tomopose.simulation.objects.shapes import Solid, box, cylinder
from tomopose.simulation.projector.focal_spot import FocalSpot
from tomopose.simulation.run import ball_spectrum, render, simulate_ball_run, transmission
from tomopose.simulation.scene.ctsimu import blur_of, resolution_of, run_from_ctsimu
from tomopose.simulation.scene.ctsimu_writing import run_to_ctsimu

pytest.importorskip("embreex")
pytest.importorskip("manifold3d")
pytest.importorskip("trimesh")


@pytest.fixture
def run():
    scanner = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.8, p_v=0.9, u_0=31.3, v_0=28.7, n_u=61, n_v=57)
    mount = RigidTransform.from_angles([0.02, 0.03, 3.1], [0.5, -0.4, 0.3], source=Frame.H, target=Frame.T)
    poses = PoseSequence.from_table([[0, 0, 0], [1, 2, -1]], [[0, 0, 0], [5, -3, 2]], alpha=np.array([0.0, 0.7]))
    solids = (Solid(shape=(box(6, 4, 5) - cylinder(1, -5, 5)).placed(t=[0.5, 1.0, -1.0]), material="Al"),)
    made = simulate_ball_run(
        scanner, T_HT=mount, t=np.zeros(3), poses=poses, solids=solids, spectrum=ball_spectrum(copper=0.3)
    )
    return replace(made, t=None, ball_diameter=None, spot=FocalSpot(shape="gaussian", size_u=0.05, size_v=0.05))


@pytest.mark.parametrize("resolution", [1.5, 3.0, 6.0])
@pytest.mark.parametrize("opacity", [0.3, 1.0, 3.0])
def test_a_basic_spatial_resolution_dims_the_gap_of_its_own_wire_pair_by_20_percent(resolution, opacity):
    """Two round wires and a gap of that width, px, blurred and seen through square pixels, against ASTM E2002."""
    h = 0.01
    x = np.arange(-30, 30 + h / 2, h)
    chords = sum(2 * np.sqrt(np.clip(resolution**2 / 4 - (x - c) ** 2, 0, None)) for c in (-resolution, resolution))
    absorbed = 1 - np.exp(-opacity / resolution * chords)
    seen = uniform_filter1d(gaussian_filter1d(absorbed, blur_of(resolution) / h), round(1 / h))
    assert 1 - seen[len(x) // 2] / seen.max() == pytest.approx(0.2, abs=0.012)
    assert resolution_of(blur_of(resolution)) == pytest.approx(resolution)


@pytest.mark.slow
def test_there_and_back(run, tmp_path):
    content, files = run_to_ctsimu(run)
    for name, mesh in files.items():
        write_stl(tmp_path / name, mesh)
    content = json.loads(json.dumps(content))
    back = run_from_ctsimu(content, folder=tmp_path)
    assert back.scanner.d_SD == pytest.approx(800.0)
    assert back.detector.blur_sigma == pytest.approx(run.detector.blur_sigma)
    assert back.spot.size_u == pytest.approx(0.05)
    np.testing.assert_allclose(back.spectrum.weight, run.spectrum.weight, rtol=1e-12)
    for i in range(2):
        a, b = transmission(run, i), transmission(back, i)
        assert a.min() < 0.85
        np.testing.assert_allclose(a, b, atol=4e-3)


def test_the_scenario_is_of_the_format_and_names_its_materials(run):
    content, files = run_to_ctsimu(run)
    assert content["file"]["file_format_version"] == {"major": 1, "minor": 2}
    assert [s["material_id"] for s in content["samples"]] == ["Al"]
    assert [m["id"] for m in content["materials"]] == ["Al", "Cu", "W", "CsI"]
    assert content["source"]["filters"] == [{"material_id": "Cu", "thickness": {"value": 0.3, "unit": "mm"}}]
    assert content["source"]["target"]["material_id"] == "W"
    assert content["source"]["voltage"]["value"] == 120.0
    assert content["detector"]["scintillator"]["thickness"] == {"value": 0.6, "unit": "mm"}
    assert list(files) == [content["samples"][0]["file"]]


def test_what_is_not_read_is_refused(run, tmp_path):
    content, _ = run_to_ctsimu(run)
    with pytest.raises(InputError, match=r"unsharpness\.mtf"):
        run_from_ctsimu({**content, "detector": {**content["detector"], "unsharpness": {"mtf": "mtf.tsv"}}})
    with pytest.raises(InputError, match="voltage"):
        run_from_ctsimu({**content, "samples": [], "source": {**content["source"], "voltage": None}})
    with pytest.raises(InputError, match="names no mesh file"):
        run_from_ctsimu({**content, "samples": [{"name": "x"}]})


def test_a_sample_is_where_the_toolbox_puts_it(run, tmp_path):
    """The centre is that of the mesh's box; deviations turn about the stage's and the sample's own axes, in order."""
    ctsimu = pytest.importorskip("ctsimu.scenario")
    content, files = run_to_ctsimu(run)
    for name, mesh in files.items():
        write_stl(tmp_path / name, mesh)

    def turn(axis, deg, pivot=None):
        entry = {"type": "rotation", "axis": axis, "amount": {"value": deg, "unit": "deg"}}
        return entry if pivot is None else {**entry, "pivot": pivot}

    place = content["samples"][0]["position"]
    place["center"] = {a: {"value": x, "unit": "mm"} for a, x in zip("uvw", (3.0, -2.0, 1.0), strict=True)}
    place["vector_r"] = {a: {"value": x} for a, x in zip("uvw", (0.0, 2.0, 0.0), strict=True)}
    place["deviations"] = [
        turn({a: {"value": x} for a, x in zip("rst", (0, 0, 1), strict=True)}, -14.0),
        turn("s", 8.0),
        turn("u", 30.0, {a: {"value": x, "unit": "mm"} for a, x in zip("uvw", (1, 2, 3), strict=True)}),
        {"type": "translation", "axis": "w", "amount": {"value": 0.7, "unit": "mm"}, "known_to_reconstruction": False},
    ]
    toolbox = ctsimu.Scenario(json_dict=json.loads(json.dumps(content)))
    toolbox.set_frame(0)
    theirs = toolbox.samples[0].coordinate_system
    axes = np.column_stack([[v.x(), v.y(), v.z()] for v in (theirs.u, theirs.v, theirs.w)])
    centre = np.array([theirs.center.x(), theirs.center.y(), theirs.center.z()])
    x = next(iter(files.values())).vertices
    wanted = (x - (x.min(axis=0) + x.max(axis=0)) / 2) @ axes.T + centre
    found = run_from_ctsimu(content, folder=tmp_path).meshes[0].mesh.vertices * [-1.0, -1.0, 1.0]
    for of in (np.min, np.max, np.mean):
        np.testing.assert_allclose(of(found, axis=0), of(wanted, axis=0), atol=1e-5)
    place["deviations"] = [turn("x", 1.0)]
    with pytest.raises(InputError, match=r"components along u, v, w or r, s, t are needed"):
        run_from_ctsimu(content, folder=tmp_path)
    place["center"] = {a: {"value": 0.0, "unit": "mm"} for a in "xyz"}
    with pytest.raises(InputError, match="samples must be on the stage"):
        run_from_ctsimu(content, folder=tmp_path)


def test_images_show_deviations_that_a_reconstruction_does_not_know(run, tmp_path):
    content, files = run_to_ctsimu(run)
    for name, mesh in files.items():
        write_stl(tmp_path / name, mesh)
    content = json.loads(json.dumps(content))
    before = run_from_ctsimu(content, folder=tmp_path).T_MH.t[0]
    shift = {"type": "translation", "axis": "x", "amount": {"value": 2.0, "unit": "mm"}}
    content["geometry"]["stage"]["deviations"].append({**shift, "known_to_reconstruction": False})
    moved = run_from_ctsimu(content, folder=tmp_path)
    assert np.linalg.norm(moved.T_MH.t[0] - before) + abs(moved.scanner.d_SR - 200.0) > 1.0


def test_the_toolbox_s_own_scenarios_are_read(tmp_path):
    helpers = pytest.importorskip("ctsimu.helpers")
    scenario = helpers.json_from_pkg(helpers.pkg_scenario("2D-FB-2_2021-03-24v06r00dp.json"))
    (tmp_path / scenario["source"]["spectrum"]["file"]["value"]).write_text("# keV,photons\n60,1\n80,2\n")
    read = run_from_ctsimu(scenario, folder=tmp_path)
    assert read.detector.output == "raw"
    image = render(read, 0)
    u = (np.arange(501) - 250) * 0.4
    inside = np.arctan2((u + 0.2)[:, None] * 0.2, 30 * np.sqrt((u + 0.2)[:, None] ** 2 + 0.04 + 900))
    outside = np.arctan2((u - 0.2)[:, None] * 0.2, 30 * np.sqrt((u - 0.2)[:, None] ** 2 + 0.04 + 900))
    angle = (inside - outside)[:, 0]
    np.testing.assert_allclose(image[250], 60000 * angle / angle.max(), atol=0.51)
    scenario["source"]["spectrum"]["monochromatic"] = True
    np.testing.assert_array_equal(run_from_ctsimu(scenario, folder=tmp_path).spectrum.energy, [60, 80])


def test_dark_and_white_grey_values_are_the_scenario_s(run, tmp_path):
    content, files = run_to_ctsimu(run)
    for name, mesh in files.items():
        write_stl(tmp_path / name, mesh)
    content["detector"]["gray_value"] |= {"imin": {"value": 500}, "imax": {"value": 40500}}
    read = run_from_ctsimu(content, folder=tmp_path).detector
    assert (read.dark, read.white) == (500.0, 40000.0)
    content["detector"]["gray_value"]["imin"] = {"value": 50000}
    with pytest.raises(InputError, match="0 <= imin < imax"):
        run_from_ctsimu(content, folder=tmp_path)


def test_null_parameters_are_not_asked_for_and_a_spectrum_file_is_read(run, tmp_path):
    content, files = run_to_ctsimu(run)
    for name, mesh in files.items():
        write_stl(tmp_path / name, mesh)
    source, detector = content["source"], content["detector"]
    source["spectrum"] = {"monochromatic": False, "file": {"value": "tube.csv"}}
    source["spot"]["intensity_map"] = {"file": {"value": None}, "dim_x": None, "type": "uint16"}
    source["filters"] = []
    detector["gray_value"]["intensity_characteristics_file"] = {"value": None}
    detector["bad_pixel_map"] = {"file": {"value": None}}
    detector["columns"]["unit"] = detector["rows"]["unit"] = "px"
    (tmp_path / "tube.csv").write_text("# energy photons\n0\t0\n40\t1.0\n60\t3.0\n80\t2.0\n")
    back = run_from_ctsimu(content, folder=tmp_path)
    np.testing.assert_array_equal(back.spectrum.energy, [40, 60, 80])
    (tmp_path / "tube.csv").unlink()
    with pytest.raises(FileError, match=r"spectrum file .*tube\.csv cannot be read"):
        run_from_ctsimu(content, folder=tmp_path)
    source["spot"]["intensity_map"]["file"]["value"] = "spot.raw"
    with pytest.raises(InputError, match=r"spot\.intensity_map\.file \(spot\.raw\) is not read"):
        run_from_ctsimu(content, folder=tmp_path)
