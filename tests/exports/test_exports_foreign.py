"""Geometry files of other programs: CERA's dialects, RTK's oddities, matrices, robot JSON, geom.csv, scenarios."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from exports_cases import TOLERANCE_PX, pixels, points, random_matrices

import tomopose as tp
from tomopose.errors import ConventionError, FileError, InputError, InputWarning, UnitError
from tomopose.exports.robot_json import to_robot_json
from tomopose.exports.rx_views import to_rx_views

X = points(m=12)
CERA = {"n_u": 640, "n_v": 480, "p_u": 0.2, "p_v": 0.2}
READ = [
    "artist.txt",
    "conrad.txt",
    "epipolar.txt",
    "etri.txt",
    "negative.txt",
    "crlf.txt",
    "plain.config",
    "windows.config",
]


def assert_projects_as(matrices, P, atol=1e-9):
    P = np.asarray(P, dtype=float)
    np.testing.assert_allclose(matrices.project(X), pixels(P, X), rtol=0, atol=atol)


@pytest.fixture
def cera(shared_data):
    folder = shared_data / "cases" / "cera-tables"
    return folder, json.loads((folder / "expected.json").read_text())


@pytest.mark.parametrize("name", READ)
def test_tables_of_every_writer_hold_the_matrices_that_they_print(name, cera):
    folder, expected = cera
    given = {} if name.endswith(".config") else {**CERA, "format": "cera"}
    assert_projects_as(tp.read_geometry(folder / name, **given), expected[name])


def test_a_table_named_by_another_computer_is_taken_from_beside_its_config(cera):
    folder, expected = cera
    with pytest.warns(InputWarning, match=r"artist\.txt beside it was read"):
        matrices = tp.read_geometry(folder / "absolute.config")
    assert_projects_as(matrices, expected["absolute.config"])


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("skip2.config", "SkipProjectionInterval = 2; .*leaves projections out"),
        ("rotated.config", "Rotation = 90"),
        ("binned.config", "BinningFactor = 2"),
        ("count.config", "NumProjections is 4 but the table holds 5"),
    ],
)
def test_configs_that_change_the_projections_are_refused_by_key(name, says, cera):
    with pytest.raises(InputError, match=says):
        tp.read_geometry(cera[0] / name)


# -- RTK and ASTRA -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rtk_plain.xml", "rtk_unknown_tag.xml", "rtk_version2.xml", "twin_vectors.npy"])
def test_files_of_rtk_and_astra_users(name, shared_data):
    folder = shared_data / "cases" / "geometry-astra-rtk-tigre-leap"
    expected = json.loads((folder / "expected.json").read_text())
    if name.endswith(".npy"):
        matrices = tp.read_geometry(folder / name, n_u=1024, n_v=768, rows="bottom")
    else:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            matrices = tp.read_geometry(folder / name, n_u=512, n_v=400, side=folder / "rtk.json")
            bare = tp.read_geometry(folder / name, n_u=512, n_v=400, p_u=0.4, p_v=0.4)
        words = [str(w.message) for w in said]
        assert sum("<ProjectionAngle>" in w for w in words) == 2 * (name == "rtk_unknown_tag.xml")
        assert sum("taken as centred" in w for w in words) == 1
        np.testing.assert_allclose(bare.P, matrices.P, rtol=1e-12, atol=1e-9)
    px = matrices.project(np.array(expected["points_W_mm"]))
    np.testing.assert_allclose(px, np.array(expected["files"][name]), rtol=0, atol=1e-9)


# -- bare matrices, robot JSON, geom.csv -----------------------------------------------------------------------------


@pytest.fixture
def vendor(shared_data):
    folder = shared_data / "cases" / "vendor-geometry"
    return folder, json.loads((folder / "expected.json").read_text())["geometry"]


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("P.npy", {**CERA, "rows": "bottom"}),
        ("P.txt", {**CERA, "rows": "bottom"}),
        ("P.mat", {**CERA, "rows": "bottom"}),
        ("view.json", {}),
        ("geom.csv", {"n_u": 600, "n_v": 400}),
        ("geom.csv", {"p_u": 0.15, "p_v": 0.15}),
    ],
)
def test_files_of_other_makers(name, given, vendor):
    folder, expected = vendor
    assert_projects_as(tp.read_geometry(folder / name, **given), expected[name])


def test_bare_matrices_follow_their_row_order_and_need_size_and_pitch(tmp_path):
    m = random_matrices(3)
    flip = np.array([[1.0, 0, 0], [0, -1, m.n_v - 1], [0, 0, 1]])
    np.save(tmp_path / "P.npy", -3.0 * flip @ m.P)
    given = {"n_u": m.n_u, "n_v": m.n_v, "p_u": m.p_u, "p_v": m.p_v}
    assert_projects_as(tp.read_geometry(tmp_path / "P.npy", rows="top", **given), m.P)
    with pytest.raises(ConventionError, match="try --rows top"):
        tp.read_geometry(tmp_path / "P.npy", rows="bottom", **given)
    with pytest.raises(InputError, match="does not hold p_v; give p_v"):
        tp.read_geometry(tmp_path / "P.npy", rows="top", **{**given, "p_v": None})
    scipy.io.savemat(tmp_path / "P.mat", {"Pm": np.moveaxis(m.P, 0, 2), "n": 3})
    assert_projects_as(tp.read_geometry(tmp_path / "P.mat", rows="bottom", **given), m.P)


def test_vectors_are_not_taken_for_matrices(tmp_path):
    m = random_matrices(4)
    g = m.decompose()
    np.savetxt(tmp_path / "v.txt", np.hstack([g.source, g.centre, g.U, g.V]))
    given = {"n_u": m.n_u, "n_v": m.n_v, "p_u": m.p_u, "p_v": m.p_v, "rows": "bottom"}
    with pytest.raises(InputError, match="--format astra reads those"):
        tp.read_geometry(tmp_path / "v.txt", **given)
    assert_projects_as(tp.read_geometry(tmp_path / "v.txt", format="astra", **given), m.P)


def test_a_robot_scan_is_a_folder_of_views(tmp_path):
    m = random_matrices(5, n=12, fixed=True)
    for k, view in enumerate(to_robot_json(m)):
        view["detector"]["pixel_pitch_heigth_mm"] = view["detector"].pop("pixel_pitch_height_mm")
        (tmp_path / f"view_{k}.json").write_text(json.dumps(view))
    assert_projects_as(tp.read_geometry(tmp_path), m.P, atol=TOLERANCE_PX)
    view["projection_geometry"]["focal_spot_position_mm"][0] += 0.01
    (tmp_path / "view_11.json").write_text(json.dumps(view))
    with pytest.raises(InputError, match="view 11: projection_matrix_cera and the positions disagree by"):
        tp.read_geometry(tmp_path)


def test_a_panel_that_the_options_contradict_is_refused_with_its_maker(vendor, tmp_path):
    folder, _ = vendor
    with pytest.raises(InputError, match=r"robot-CT JSON of THD Deggendorf\), but 640 was given"):
        tp.read_geometry(folder / "view.json", n_u=640)
    with pytest.raises(InputError, match=r"geom\.csv of RX Solutions.*the panel is 90 mm along u"):
        tp.read_geometry(folder / "geom.csv", **CERA)
    with pytest.raises(InputError, match="neither the detector's size nor its pitch"):
        tp.read_geometry(folder / "geom.csv")
    m = random_matrices(6)
    (tmp_path / "g.csv").write_text(to_rx_views(m).rsplit(";", 2)[0])
    with pytest.raises(InputError, match="is the file truncated"):
        tp.read_geometry(tmp_path / "g.csv", n_u=m.n_u, n_v=m.n_v)


# -- other units and mirrors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "name"), [(0.001, "micrometres"), (0.07, "voxels"), (1000.0, "metres")])
def test_vectors_in_another_unit_are_caught_when_they_are_read(unit, name, tmp_path):
    m = random_matrices(7)
    g = m.decompose()
    np.save(tmp_path / "v.npy", np.hstack([g.source, g.centre, g.U, g.V]) / unit)
    with pytest.raises(UnitError, match="--unit-mm says what one unit of the file is"):
        tp.read_geometry(tmp_path / "v.npy", n_u=m.n_u, n_v=m.n_v, rows="bottom")
    back = tp.read_geometry(tmp_path / "v.npy", n_u=m.n_u, n_v=m.n_v, rows="bottom", unit_mm=unit)
    assert_projects_as(back, m.P, atol=1e-8)
    assert back.p_u == pytest.approx(m.p_u)


@pytest.mark.parametrize("unit", [0.001, 0.07, 1000.0])
def test_matrices_of_a_world_in_another_unit_are_caught_when_they_are_read(unit, tmp_path):
    m = random_matrices(8)
    P = m.P.copy()
    P[:, :, :3] *= unit
    np.save(tmp_path / "P.npy", P)
    given = {"n_u": m.n_u, "n_v": m.n_v, "p_u": m.p_u, "p_v": m.p_v, "rows": "bottom"}
    with pytest.raises(UnitError, match="are positions in micrometres, voxels or metres"):
        tp.read_geometry(tmp_path / "P.npy", **given)
    assert_projects_as(tp.read_geometry(tmp_path / "P.npy", unit_mm=unit, **given), m.P, atol=1e-8)


def test_mirrored_vectors_are_caught_when_they_are_read(tmp_path):
    m = random_matrices(9)
    g = m.decompose()
    np.save(tmp_path / "v.npy", np.hstack([g.source, g.centre, -g.U, g.V]))
    with pytest.raises(ConventionError, match="--mirrored accepts images that are mirrored"):
        tp.read_geometry(tmp_path / "v.npy", n_u=m.n_u, n_v=m.n_v, rows="bottom")
    back = tp.read_geometry(tmp_path / "v.npy", n_u=m.n_u, n_v=m.n_v, rows="bottom", mirrored=True)
    u = m.n_u - 1 - m.project(X)[..., 0]
    np.testing.assert_allclose(back.project(X)[..., 0], u, atol=TOLERANCE_PX)


# -- CTSimU --------------------------------------------------------------------------------------------------------


def scenarios():
    ctsimu = pytest.importorskip("ctsimu")
    return sorted(Path(ctsimu.__path__[0]).glob("evaluation/scenarios/*.json"))


@pytest.mark.slow
def test_the_nine_scenarios_of_ctsimu_give_its_own_matrices():
    from ctsimu.scenario import Scenario

    files = scenarios()
    assert len(files) == 9
    for file in files:
        matrices, scenario = tp.read_geometry(file), Scenario(str(file))
        P = []
        for k in range(len(matrices)):
            scenario.set_frame(k, reconstruction=True)
            P.append(np.array(scenario.current_geometry().projection_matrix(mode="CERA").value, dtype=float))
        np.testing.assert_allclose(matrices.project(X / 10), pixels(P, X / 10), rtol=0, atol=1e-6, err_msg=file.name)


def test_null_parameters_and_drift_files_are_those_of_ctsimu(tmp_path):
    from ctsimu.scenario import Scenario

    content = json.loads(scenarios()[0].read_text())
    content["acquisition"] |= {"number_of_projections": 6, "stop_angle": {"value": 360.0, "unit": "deg"}}
    content["geometry"]["stage"]["center"]["y"] = {
        "value": 0.5,
        "unit": "mm",
        "uncertainty": None,
        "drifts": [{"value": None, "file": "drift.csv", "unit": "mm", "known_to_reconstruction": True}],
    }
    content["geometry"]["stage"]["center"]["z"] = {"value": 0.25, "unit": "mm", "uncertainty": None, "drifts": None}
    content["geometry"]["detector"]["deviations"] = None
    content["geometry"]["source"]["beam_divergence"] = None
    (tmp_path / "drift.csv").write_text("# mm\n0.0\n0.1\n0.05\n0.2\n0.3\n-0.4\n")
    (tmp_path / "a.json").write_text(json.dumps(content))
    matrices, scenario = tp.read_geometry(tmp_path / "a.json"), Scenario(str(tmp_path / "a.json"))
    P = []
    for k in range(6):
        scenario.set_frame(k, reconstruction=True)
        P.append(np.array(scenario.current_geometry().projection_matrix(mode="CERA").value, dtype=float))
    np.testing.assert_allclose(matrices.project(X / 10), pixels(P, X / 10), rtol=0, atol=1e-6)
    (tmp_path / "drift.csv").unlink()
    with pytest.raises(FileError, match=r"names the drift file drift\.csv"):
        tp.read_geometry(tmp_path / "a.json")


def test_a_circular_openct_file_of_ctsimu_means_the_views_of_its_scenario(tmp_path):
    from ctsimu.geometry import create_OpenCT_config
    from ctsimu.scenario import Scenario

    content = json.loads(next(f for f in scenarios() if "2D-WE-2" in f.name).read_text())
    content["acquisition"] |= {"number_of_projections": 7, "stop_angle": {"value": 360.0, "unit": "deg"}}
    (tmp_path / "a.json").write_text(json.dumps(content))
    scenario = Scenario(str(tmp_path / "a.json"))
    P = []
    for k in range(7):
        scenario.set_frame(k, reconstruction=True)
        P.append(np.array(scenario.current_geometry().projection_matrix(mode="CERA").value, dtype=float))
    scenario.set_frame(0, reconstruction=True)
    create_OpenCT_config(
        scenario.current_geometry(),
        filename=str(tmp_path / "openct.json"),
        variant="circular",
        projection_files=[f"{k}.tif" for k in range(7)],
        total_angle=360.0,
    )
    matrices = tp.read_geometry(tmp_path / "openct.json")
    np.testing.assert_allclose(matrices.project(X / 10), pixels(P, X / 10), rtol=0, atol=1e-6)
