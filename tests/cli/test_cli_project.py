"""A project file states once what every verb needs; two commands lead from people's files to a report."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run
from tomopose.cli.project import read_project
from tomopose.cli.simulated import RADIOGRAPHS, write_run
from tomopose.errors import FileError, InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import convention_from_rotation
from tomopose.simulation.objects.mesh import write_stl
from tomopose.simulation.objects.shapes import Solid, box
from tomopose.simulation.objects.tessellate import tessellate

SCANNER = tp.Scanner(d_SD=1500.0, d_SR=555.0, p_u=0.4, p_v=0.4, u_0=90.0, v_0=101.0, n_u=181, n_v=203)
NOTES = "d_SD_mm = 1500\nd_SR_mm = 555\np_u_mm = 0.4\np_v_mm = 0.4\nn_u_px = 181\nn_v_px = 203\n"
XTEKCT = """[XTekCT]
SrcToObject=555
SrcToDetector=1500
DetectorPixelsX=181
DetectorPixelsY=203
DetectorPixelSizeX=0.4
DetectorPixelSizeY=0.4
Projections=8
InitialAngle=0
AngularStep=0
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of small radiographs, and its poses."""
    folder = tmp_path_factory.mktemp("made")
    poses = tp.PoseSequence.from_table(
        [[0, 0, 0], [4, 0, 0], [-4, 0, 0], [0, 4, 0], [0, 0, 4], [3, 3, -3], [-3, 2, 3], [2, -3, 1]],
        [[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5], [-5, 2, 0], [2, 2, -5], [0, -5, 3], [4, 4, 4]],
        pose_id=[f"p{k}" for k in range(8)],
    )
    T_HT = tp.RigidTransform.from_angles([0.007, -0.005, 3.126], [1.0, -0.5, 1.0], source=Frame.H, target=Frame.T)
    write_run(folder, tp.simulate_ball_run(SCANNER, T_HT=T_HT, t=[2.0, -3.0, 4.0], poses=poses, seed=3))
    return folder, poses


def pi_log(poses):
    angles = convention_from_rotation(poses.T_MH.R, "pi-hexapod")
    lines = []
    for k in range(len(poses)):
        values = zip("XYZUVW", (*poses.T_MH.t[k], *angles[k]), strict=True)
        lines += [f"09:41:{k:02d}.020 >> POS?", *(f"09:41:{k:02d}.031 << {a}={v:.7f}" for a, v in values)]
    return "\n".join(lines)


def kuka_dat(poses):
    angles = convention_from_rotation(poses.T_MH.R, "kuka")
    lines = ["DEFDAT RUN"]
    for k in range(len(poses)):
        x, a = poses.T_MH.t[k] + [600, -35, 420], angles[k]
        lines.append(
            f"DECL E6POS XP{k}={{X {x[0]:.6f},Y {x[1]:.6f},Z {x[2]:.6f},A {a[0]:.6f},B {a[1]:.6f},C {a[2]:.6f},S 2}}"
        )
    return "\n".join([*lines, "ENDDAT"])


def german_csv(poses):
    angles = convention_from_rotation(poses.T_MH.R, "pi-hexapod")
    rows = [";".join(f"{v:.7f}".replace(".", ",") for v in (*poses.T_MH.t[k], *angles[k])) for k in range(len(poses))]
    return "\n".join(["Nr;X_mm;Y_mm;Z_mm;U_deg;V_deg;W_deg", *(f"{k};{row}" for k, row in enumerate(rows))])


def nexus(path, made):
    images = tp.open_images(made / RADIOGRAPHS)
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"] = np.stack([image[::-1] for image in images])
        for name, value in (("x_pixel_size", 0.4), ("y_pixel_size", 0.4), ("distance", 945.0)):
            detector[name] = value
            detector[name].attrs["units"] = "mm"
        file["entry/instrument/source/distance"] = -555.0
        file["entry/instrument/source/distance"].attrs["units"] = "mm"
        file["entry/sample/rotation_angle"] = np.zeros(len(images))
        file["entry/sample/rotation_angle"].attrs["units"] = "degree"


STARTS = {
    "PI hexapod": {"scanner.txt": lambda _: NOTES, "positions.log": pi_log},
    "KUKA robot": {"scanner.txt": lambda _: NOTES, "run.dat": kuka_dat},
    "Nikon scanner": {"part.xtekct": lambda _: XTEKCT, "points.csv": german_csv},
    "NXtomo": {"positions.log": pi_log},
}
"""The starts of docs/howto/init.md, and the files that each has beside its images."""


def commands_of(start):
    """The words of the commands that the documentation gives for a start."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "howto" / "init.md").read_text(encoding="utf-8")
    block = re.search(rf"^{start}[^`]*```\n(.*?)```", text, flags=re.MULTILINE | re.DOTALL)
    assert block is not None, start
    return [line.split()[1:] for line in block[1].splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
def test_the_documented_commands_lead_from_the_files_that_people_have_to_a_report(
    start, made, tmp_path, monkeypatch, capsys
):
    """At most three commands, none of them with more than four options."""
    folder, poses = made
    monkeypatch.chdir(tmp_path)
    for name, text in STARTS[start].items():
        (tmp_path / name).write_text(text(poses))
    if start == "NXtomo":
        nexus(tmp_path / "scan.nxs", folder)
    else:
        shutil.copytree(folder / RADIOGRAPHS, tmp_path / "radiographs")
    commands = commands_of(start)
    assert len(commands) <= 3
    assert all(sum(word.startswith("--") for word in words) <= 4 for words in commands)
    codes = [run(words) for words in commands]
    assert codes[0] == 0, capsys.readouterr().err
    assert codes[1] in (0, 3), capsys.readouterr().err  # eight poses are few: finished, doubtful at most
    assert (tmp_path / "cal" / "report.html").is_file()
    found = json.loads((tmp_path / "cal" / "calibration.json").read_text())
    assert found["d_rms_px"] < 0.05


@pytest.fixture
def project(files, monkeypatch):
    """A run as files, and the working folder in it."""
    monkeypatch.chdir(files.folder)
    text = 'scanner = "scanner.json"\nposes = "poses.csv"\nball_diameter_mm = 8.0\n'
    text += 'machine = "CT 3"\noperator = "A. Example"\n'
    (files.folder / "tomopose.toml").write_text(text + '[certificates]\nroom = "20.1 deg C"\n')
    return files


def test_a_verb_takes_from_the_project_what_its_options_do_not_say(project, capsys):
    assert run(["calibrate", "--observations", "observations.csv", "--out", "cal", "--quiet"]) == 0
    made = project.json("cal/calibration.json")["provenance"]["arguments"]
    assert made["measurement"] == {"machine": "CT 3", "operator": "A. Example", "room": "20.1 deg C"}
    report = (project.folder / "cal" / "report.html").read_text()
    for fact in ("CT 3", "A. Example", "20.1 deg C"):
        assert fact in report


CERTIFICATE = """machine = "CT 3"
serial = "SN-4711"
operator = "A. Example"
ball_certificate = "K-118"
temperature_C = "20.1"
valid_until = "2027-03-31"
"""
STATED = ("CT 3", "SN-4711", "A. Example", "K-118", "20.1", "2027-03-31")
"""What must be readable in every report."""


@pytest.fixture
def three(project):
    """A project with all fields of a certificate, and three calibrations made under it."""
    toml = project.folder / "tomopose.toml"
    toml.write_text('scanner = "scanner.json"\nposes = "poses.csv"\nball_diameter_mm = 8.0\n' + CERTIFICATE)
    rng = np.random.default_rng(1)
    seen = tp.read_observations(project.folder / "observations.csv")
    for k in range(3):
        moved = dataclasses.replace(seen, x_D=seen.x_D + 0.01 * rng.standard_normal(seen.x_D.shape))
        tp.write_observations(project.folder / f"run{k}.csv", moved)
        assert run(["calibrate", "--observations", f"run{k}.csv", "--out", f"cal{k}", "--quiet"]) in (0, 3)
    return project


@pytest.mark.slow
def test_the_fields_of_a_certificate_are_in_every_report(three):
    for k in range(3):
        words = ["monitor", "history.jsonl", "--add", f"cal{k}/calibration.json", "--out", "history.html", "--quiet"]
        assert run(words) in (0, 3)
    cal = ["--calibration", "cal0/calibration.json"]
    assert run(["compare", "cal0/calibration.json", "cal1/calibration.json", "--out", "change.html", "--quiet"]) in (
        0,
        3,
    )
    write_stl(three.folder / "part.stl", tessellate((Solid(shape=box(18.0, 14.0, 5.0), material="Al"),))[0][0])
    part = ["--part", "part.stl", "--mu-per-mm", "0.1", "--views", "6", "--out", "scan.csv", "--quiet"]
    assert run(["plan", "scan", *part]) == 0
    (three.folder / "matrices").mkdir()
    assert run(["matrices", *cal, "--poses", "scan.csv", "--out", "matrices/matrices.npz", "--quiet"]) in (0, 3)
    (three.folder / "found").mkdir()
    (three.folder / "run0.csv").rename(three.folder / "found" / "observations.csv")
    for folder in ("cal0", "matrices", "found"):
        out = ["--out", f"{folder}/again.html", "--certificate", "paper"] if folder == "cal0" else []
        assert run(["report", folder, *out, "--quiet"]) == 0
    pages = ["cal0/report.html", "cal0/again.html", "paper/certificate.html", "history.html", "change.html"]
    for page in (*pages, "scan.html", "matrices/report.html", "found/report.html"):
        text = (three.folder / page).read_text()
        assert [fact for fact in STATED if fact not in text] == [], page
    assert three.json("scan.json")["provenance"]["arguments"]["measurement"]["serial"] == "SN-4711"


@pytest.mark.slow
def test_a_report_takes_the_project_that_is_named_and_a_result_keeps_what_it_was_made_with(three, tmp_path_factory):
    other = tmp_path_factory.mktemp("other") / "b.toml"
    other.write_text('machine = "CT 9"\n')
    assert run(["report", "cal0", "--out", "kept.html", "--project", str(other), "--quiet"]) == 0
    text = (three.folder / "kept.html").read_text()
    assert "CT 3" in text
    assert "CT 9" not in text
    (three.folder / "found").mkdir()
    (three.folder / "run0.csv").rename(three.folder / "found" / "observations.csv")
    assert run(["report", "found", "--project", str(other), "--quiet"]) == 0
    assert "CT 9" in (three.folder / "found" / "report.html").read_text()


def test_options_win_and_another_project_can_be_named(project, tmp_path_factory, capsys):
    other = tmp_path_factory.mktemp("other")
    (other / "b.toml").write_text(f'scanner = "{(project.folder / "scanner.json").as_posix()}"\nposes = "none.csv"\n')
    words = ["calibrate", "--observations", "observations.csv", "--out", "cal", "--quiet"]
    words += ["--project", str(other / "b.toml")]
    assert run(words) == 1
    assert "none.csv does not exist" in capsys.readouterr().err
    assert run([*words, "--poses", "poses.csv"]) == 0


def test_a_project_with_a_wrong_key_is_refused_and_locks_nobody_out(project, capsys):
    (project.folder / "tomopose.toml").write_text('scaner = "scanner.json"\n')
    assert run(["calibrate", "--observations", "observations.csv", "--out", "cal"]) == 1
    assert "unknown key 'scaner'; did you mean 'scanner'?" in capsys.readouterr().err
    assert run(["calibrate", "--help"]) == 0
    assert run(["init", "--force", "--from", "scanner.json", "--from", "poses.csv", "--quiet"]) == 0
    values = read_project(project.folder / "tomopose.toml").values
    assert dict(values) == {"scanner": "scanner.json", "poses": "poses.csv"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('ball_diameter_mm = "8"', "a number is needed"),
        ("poses = 3", "text is needed"),
        ("certificates = 3", r"a table \[certificates\] is needed"),
    ],
)
def test_values_of_the_wrong_kind_are_refused(text, says, tmp_path):
    (tmp_path / "tomopose.toml").write_text(text + "\n")
    with pytest.raises(InputError, match=says):
        read_project(tmp_path / "tomopose.toml")


def test_a_project_that_is_not_there_is_said(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        read_project(tmp_path / "no.toml")


def test_import_poses_and_import_scanner_write_where_the_project_says(tmp_path, monkeypatch, shared_data):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tomopose.toml").write_text('scanner = "geo/scanner.json"\nposes = "geo/poses.csv"\n')
    assert run(["import-poses", str(shared_data / "cases" / "pose-logs" / "scan.dat"), "--quiet"]) == 0
    assert run(["import-scanner", str(shared_data / "cases" / "vendor-geometry" / "part.pca"), "--quiet"]) == 0
    assert len(tp.read_poses(tmp_path / "geo" / "poses.csv")) == 4
    assert tp.read_scanner(tmp_path / "geo" / "scanner.json").d_SD == 1173.53


def test_a_geometry_file_of_another_kind_is_answered_with_how_to_proceed(shared_data, tmp_path, capsys):
    file = shared_data / "cases" / "vendor-geometry" / "part.xtekct"
    assert run(["import-geometry", str(file), "--out", str(tmp_path / "m.npz")]) == 1
    assert "its scanner: tomopose import-scanner part.xtekct --out scanner.json" in capsys.readouterr().err
