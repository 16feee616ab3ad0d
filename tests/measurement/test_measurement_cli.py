"""`tomopose measure` and its page, on the blurred block."""

from __future__ import annotations

import csv
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import typer
from test_measurement_comparison import box, write_stl
from test_measurement_plan import CENTRE, HALF, PLAN, block

import tomopose as tp
from tomopose.cli import measure as verb
from tomopose.errors import FileError, InputError, UnitError
from tomopose.geometry.projection import project_ball
from tomopose.io.volume_files import write_volume
from tomopose.measurement.mesh.mesh import Mesh
from tomopose.trajectory.tilt import eq11_triangle

pytestmark = pytest.mark.slow  # its scans alone take ten seconds

REPEATS = """
[repeats]
"3D scan" = ["one", "two"]
"""


def run(*words):
    app = typer.Typer()
    verb.register(app)
    return typer.main.get_command(app).main(args=[str(w) for w in words], standalone_mode=False)


def rows_of(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Plans, three scans of the block, and its reference in part coordinates, in millimetres and in metres."""
    folder = tmp_path_factory.mktemp("measure")
    (folder / "plan.toml").write_text(PLAN, encoding="utf-8")
    (folder / "repeats.toml").write_text(PLAN + REPEATS, encoding="utf-8")
    (folder / "simple.toml").write_text(PLAN.replace('kind = "datum"', 'kind = "none"'), encoding="utf-8")
    for k in (1, 2, 3):
        write_volume(folder / f"scan{k}.h5", block(0.03, k))
    write_stl(folder / "part.stl", box(HALF, 10))
    write_stl(folder / "coarse.stl", box(HALF, 1))
    write_stl(folder / "metres.stl", Mesh(points=box(HALF, 10).points / 1000, faces=box(HALF, 10).faces))
    write_stl(folder / "open.stl", Mesh(points=box(HALF, 4).points, faces=box(HALF, 4).faces[3:]))
    return folder


@pytest.fixture(scope="module")
def measured(folder):
    """Two repeats and another trajectory, compared with the reference."""
    out = folder / "out"
    volumes = [
        w
        for name, k in (("one", 1), ("two", 2), ("circular", 3))
        for w in ("--volume", f"{name}={folder / f'scan{k}.h5'}")
    ]
    words = ["--reference", folder / "part.stl", "--fit", "datum", "--out", out, "--quiet"]
    assert run(folder / "repeats.toml", *volumes, *words) == 0
    return out


def test_the_summary(folder, capsys):
    out = folder / "summary"
    assert run(folder / "plan.toml", "--volume", folder / "scan1.h5", "--out", out, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["volumes"] == ["scan1"]
    assert said["results"] == 4
    assert said["alignments"]["scan1"]["rule"] == "datum, 3-2-1"
    with pytest.raises(FileError, match="exists"):
        run(folder / "plan.toml", "--volume", folder / "scan1.h5", "--out", out)


def test_a_limit_that_is_exceeded_by_more_than_the_uncertainty_is_exit_code_3(folder, capsys):
    """L1 is 3.84 mm; where 3.9 is wanted no noise makes up for it."""
    (folder / "beyond.toml").write_text(PLAN.replace("calibrated_mm = 3.84", "calibrated_mm = 3.9"), encoding="utf-8")
    out = folder / "beyond"
    assert run(folder / "beyond.toml", "--volume", folder / "scan1.h5", "--out", out, "--json") == 3
    said = json.loads(capsys.readouterr().out)
    assert said["beyond_limits"] == ["L1"]
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Not conforming" in page
    rows = {r["name"]: r for r in rows_of(out / "measurement.csv")}
    assert rows["L1"]["decision"] == "not conforming"


def test_what_cannot_be_decided_is_not_said_to_conform(folder, capsys):
    """An MPE between the error and the error plus its uncertainty: exit code 0, and nobody says "within limits"."""
    narrow = PLAN.replace("A_um = 9.0, K = 50.0", "A_um = 0.9")
    (folder / "narrow.toml").write_text(narrow, encoding="utf-8")
    out = folder / "narrow"
    assert run(folder / "narrow.toml", "--volume", folder / "scan1.h5", "--out", out) == 0
    assert "not decidable: scan1 L1" in capsys.readouterr().out
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Not decidable" in page
    assert "ithin limits" not in page


def test_the_report_shows_groups_side_by_side_and_the_comparison(measured):
    page = (measured / "report.html").read_text(encoding="utf-8")
    for words in (
        "Nominal-actual comparison: one",
        "Deviations in colour",
        "mesh3d",
        "Distances: groups side by side",
        "3D scan",
        "circular",
        "Repeats",
        "repeats.toml",
        "datum, 3-2-1",
    ):
        assert words in page


def test_repeats_count_only_their_own_group(measured):
    document = json.loads((measured / "measurement.json").read_text(encoding="utf-8"))
    assert {r["group"] for r in document["repeats"]} == {"3D scan"}
    assert {r["n"] for r in document["repeats"]} == {2}
    assert document["groups"] == {"3D scan": ["one", "two"]}
    said = {r["name"]: r["interval"] for r in document["repeats"]}
    assert said["L1"] == "repeats; mean error from the reference"
    assert "repeats; without the systematic part" in said.values()
    assert {r["interval"] for r in document["results"]} == {"fit alone, without the systematic part", "not determined"}
    assert "fit alone, without the systematic part" in (measured / "report.html").read_text(encoding="utf-8")
    assert set(document["provenance"]["inputs"]) == {"repeats.toml", "scan1.h5", "scan2.h5", "scan3.h5", "part.stl"}
    shares = {(r["volume"], r["name"]): r for r in rows_of(measured / "uncertainty.csv")}
    assert shares["one", "L1"]["repeats"] != ""
    assert shares["circular", "L1"]["repeats"] == ""
    assert float(shares["one", "L1"]["u"]) >= float(shares["one", "L1"]["fit"])


@pytest.mark.parametrize("name", ["one", "two", "circular"])
def test_every_file_of_the_comparison(measured, name):
    folder = measured / name
    summary = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
    assert summary["alignment"]["rule"] == "datum, 3-2-1"
    assert summary["alignment"]["t_mm"] == pytest.approx(CENTRE, abs=0.01)
    assert abs(summary["percentiles_mm"]["50 %"]) < 0.002
    n = summary["vertices"]
    assert len((folder / "comparison.csv").read_text(encoding="utf-8").splitlines()) == n + 1
    assert len(tp.read_mesh(folder / "comparison.ply").points) == n
    glb = (folder / "comparison.glb").read_bytes()
    assert struct.unpack_from("<I", glb, 8)[0] == len(glb)
    assert 'Name="deviation_um"' in (folder / "comparison.vtp").read_text(encoding="utf-8")


def test_the_picture_shows_the_part_in_the_colours_of_the_map(measured):
    from cmcrameri import cm
    from matplotlib.image import imread

    picture = imread(measured / "one" / "comparison.png")
    height, width = picture.shape[:2]
    assert width > 1000
    assert height > 500
    views = picture[:, : int(0.6 * width), :3]
    drawn = (views < 0.97).any(axis=2)
    assert 0.1 < drawn.mean() < 0.8
    # Faces fit within a micrometre or two: most of what is drawn has the hue of the map's middle, lit or shaded.
    hue = views[drawn] / np.maximum(views[drawn].sum(axis=1, keepdims=True), 1e-9)
    middle = np.array(cm.vik(0.5)[:3])
    assert np.mean(np.abs(hue - middle / middle.sum()).max(axis=1) < 0.03) > 0.5


@pytest.mark.parametrize("between", ["cells", "natural"])
def test_a_coarse_reference_is_refined_fitted_and_corrected(folder, between):
    """A reference of twelve triangles; a measuring machine found its top 10 um higher than nominal."""
    probed = [[x, y, HALF[2] + 0.010] for x in (-1.0, 0.0, 1.0) for y in (-0.8, 0.0, 0.8)]
    (folder / "cmm.csv").write_text(
        "x_mm,y_mm,z_mm\n" + "".join(f"{x},{y},{z}\n" for x, y, z in probed), encoding="utf-8"
    )
    out = folder / f"corrected {between}"
    assert (
        run(
            folder / "simple.toml",
            "--volume",
            folder / "scan1.h5",
            "--reference",
            folder / "coarse.stl",
            "--edge-mm",
            "0.2",
            "--cmm-points",
            folder / "cmm.csv",
            "--cmm-interpolation",
            between,
            "--fit",
            "best-fit",
            "--search-mm",
            "0.2",
            "--out",
            out,
            "--quiet",
        )
        == 0
    )
    table = np.genfromtxt(out / "comparison.csv", delimiter=",", skip_header=1)
    x, d = table[:, :3] - CENTRE, table[:, 3]
    inner = (np.abs(x[:, 0]) < 1.2) & (np.abs(x[:, 1]) < 0.9)
    top, bottom = (np.nanmedian(d[inner & (np.abs(x[:, 2] - s * HALF[2]) < 0.05)]) for s in (1, -1))
    # The measured block is nominal: against a raised top it lies 10 um too low, shared by the best fit.
    assert top + bottom == pytest.approx(-10.0, abs=1.0)
    summary = json.loads((out / "comparison.json").read_text(encoding="utf-8"))
    assert summary["alignment"]["rule"] == "best fit"
    assert summary["best_fit_moved_mm"] == pytest.approx(np.linalg.norm([0.02, -0.01, -0.01]), abs=0.01)


def test_a_calibration_adds_its_share(folder):
    scanner = tp.Scanner(d_SD=900.0, d_SR=200.0, p_u=0.6, p_v=0.63, u_0=29.3, v_0=31.1, n_u=60, n_v=63)
    T_HT = tp.RigidTransform.from_angles([0.01, 0.0, 3.1], [0.2, -0.1, 0.3], source=tp.Frame.H, target=tp.Frame.T)
    poses = tp.pose_grid(2, half_range=1.0)
    x = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=np.array([0.4, -0.3, 0.2]))
    seen = tp.BallObservations.from_sigma(x, 0.3, pose_id=poses.pose_id)
    calibration = tp.calibrate(scanner, poses, seen, hypotheses=False, robust=False)
    tp.write_calibration(folder / "calibration.json", calibration)
    tp.write_poses(folder / "scan.csv", tp.tilted_scan(36, eq11_triangle, R_HT=T_HT.R))
    out = folder / "with calibration"
    given = ["--calibration", folder / "calibration.json", "--poses", folder / "scan.csv"]
    assert run(folder / "plan.toml", "--volume", folder / "scan1.h5", "--out", out, "--quiet", *given) == 0
    rows = {r["name"]: r for r in rows_of(out / "uncertainty.csv")}
    fit, share, u = (float(rows["L1"][k]) for k in ("fit", "calibration", "u"))
    assert share > 0
    assert u == pytest.approx(np.hypot(fit, share))
    assert rows["flatness"]["calibration"] == ""
    assert rows["L1"]["interval"] == "fit, calibration; without the systematic part"
    assert "Uncertainty" in (out / "report.html").read_text(encoding="utf-8")
    with pytest.raises(InputError, match="no volume is named"):
        run(
            folder / "plan.toml",
            "--volume",
            folder / "scan1.h5",
            "--out",
            folder / "n",
            "--quiet",
            "--calibration",
            f"other={folder / 'calibration.json'}",
            "--poses",
            folder / "scan.csv",
        )
    assert (
        run(
            folder / "plan.toml",
            "--volume",
            folder / "scan1.h5",
            "--out",
            folder / "n",
            "--quiet",
            "--poses",
            folder / "scan.csv",
        )
        == 2
    )


SCENE = """
schema = "tomopose/scene/1"
seed = 1
[scanner]
d_SD_mm = 900.0
d_SR_mm = 200.0
p_u_mm = 0.5
p_v_mm = 0.5
u_0_px = 39.5
v_0_px = 43.5
n_u_px = 80
n_v_px = 88
[source]
voltage_kV = 120.0
filters = [{ material = "Cu", thickness_mm = 2.0 }]
[detector]
snr = 150.0
[[objects]]
kind = "solid"
material = "Al"
t_mm = [0.3, -0.2, 0.15]
shapes = [{ kind = "box", size_mm = [3.46, 2.82, 3.84] }]
[mount]
angles_deg = [0.0, 0.0, 0.0]
[poses.scan]
n = 40
tilt = "triangle"
"""


def test_virtual_scans_from_the_command_line(folder):
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    plan = (
        PLAN.replace("calibrated_mm = 3.84", "calibrated_mm = 3.84\nnominal_mm = 3.84")
        .replace("[alignment]", "[surface]\nsearch_distance_mm = 0.5\n[alignment]")
        .replace('kind = "datum"', 'kind = "none"')
    )
    (folder / "nominal.toml").write_text(plan, encoding="utf-8")
    out = folder / "simulated"
    assert (
        run(
            folder / "nominal.toml",
            "--volume",
            folder / "scan1.h5",
            "--simulate",
            folder / "scene.toml",
            "--draws",
            "3",
            "--seed",
            "4",
            "--simulate-voxel",
            "1.1",
            "--out",
            out,
            "--quiet",
        )
        == 0
    )
    rows = {r["name"]: r for r in rows_of(out / "uncertainty.csv")}
    length = rows["L1"]
    assert float(length["simulation"]) > 0
    value = json.loads((out / "measurement.json").read_text(encoding="utf-8"))["results"][0]["value"]
    assert float(length["corrected"]) == pytest.approx(value - float(length["mean_error"]))
    assert abs(float(length["mean_error"])) < 0.05
    assert float(length["value"]) == value
    assert length["interval"] == "virtual scans; corrected by simulation"
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "corrected by simulation / mm" in page
    assert f"{float(length['corrected']):.5f}" in page
    assert f"{value:.5f}" in page
    document = json.loads((out / "measurement.json").read_text(encoding="utf-8"))
    assert document["simulated"]["L1"]["runs"] == 3
    assert document["provenance"]["seed"] == 4


class TestRefused:
    def test_two_volumes_of_one_name(self, folder):
        with pytest.raises(InputError, match="two volumes"):
            run(
                folder / "plan.toml",
                "--volume",
                folder / "scan1.h5",
                "--volume",
                folder / "scan1.h5",
                "--out",
                folder / "other",
            )

    def test_a_missing_volume(self, folder):
        with pytest.raises(FileError, match="does not exist"):
            run(folder / "plan.toml", "--volume", folder / "none.h5", "--out", folder / "third")

    @pytest.mark.parametrize(
        ("file", "error", "words"),
        [
            ("metres.stl", UnitError, "metres"),
            ("open.stl", InputError, "watertight"),
            ("coarse.stl", InputError, "smaller triangles"),
        ],
    )
    def test_a_reference_that_cannot_be_one(self, folder, file, error, words):
        out = folder / "refused"
        with pytest.raises(error, match=words):
            run(folder / "plan.toml", "--volume", folder / "scan1.h5", "--reference", folder / file, "--out", out)
        assert not out.exists()

    def test_datum_without_datums(self, folder):
        with pytest.raises(InputError, match="three datums"):
            run(
                folder / "simple.toml",
                "--volume",
                folder / "scan1.h5",
                "--reference",
                folder / "part.stl",
                "--fit",
                "datum",
                "--out",
                folder / "refused",
            )

    @pytest.mark.parametrize("option", ["--fit", "--cmm-interpolation"])
    def test_an_unknown_choice(self, folder, option):
        assert run(folder / "plan.toml", "--volume", folder / "scan1.h5", option, "good", "--out", folder / "r") == 2

    def test_an_empty_volume(self, folder):
        empty = block()
        write_volume(folder / "empty.h5", replace(empty, values=np.zeros_like(empty.values)))
        with pytest.raises(InputError, match="no surface"):
            run(folder / "plan.toml", "--volume", folder / "empty.h5", "--out", folder / "refused")

    def test_an_inverted_volume(self, folder):
        scan = block()
        write_volume(folder / "inverted.h5", replace(scan, values=1 - scan.values))
        with pytest.raises(InputError, match="inverted"):
            run(folder / "plan.toml", "--volume", folder / "inverted.h5", "--out", folder / "refused")
