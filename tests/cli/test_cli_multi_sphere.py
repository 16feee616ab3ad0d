"""`tomopose calibrate --method multi-sphere` from radiographs of a standard to the matrices of its path."""

from __future__ import annotations

import json

import numpy as np
import pytest

import tomopose as tp
from tomopose.calibration.uncertainty.trajectory import object_points
from tomopose.cli.main import run
from tomopose.geometry.frames import Frame
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.rotations import R_y, R_z
from tomopose.geometry.transforms import RigidTransform
from tomopose.simulation.objects.shapes import Solid, sphere
from tomopose.simulation.run import simulate_ball_run
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle

VIEWS = 5
NAMES = [f"K{i}" for i in range(8)]


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Radiographs of eight balls, two of which hide one another in some views; the plate is 30 um beside its table."""
    folder = tmp_path_factory.mktemp("standard")
    scanner = tp.Scanner(
        d_SD=1500.0, d_SR=283.5, p_u=0.8, p_v=0.8, u_0=254.2, v_0=249.9, n_u=511, n_v=507,
        sigma=dict.fromkeys(("d_SD", "d_SR", "p_u", "p_v", "u_0", "v_0", "eta", "theta", "phi"), 0.0),
    )  # fmt: skip
    k = np.arange(8)
    a, r = k * np.pi * (3 - np.sqrt(5)), 6 + 12 * ((3 * k) % 8) / 7
    x = np.stack([r * np.cos(a), r * np.sin(a), -24 + 48 * k / 7], axis=1)
    standard = tp.SphereStandard(names=tuple(NAMES), centres=x, diameters=np.full(8, 4.0), sigma=np.full(8, 3e-4))
    poses = tilted_scan(40, eq11_triangle).select(range(0, 5 * VIEWS, 5))
    rng = np.random.default_rng(2)
    T_MH = RigidTransform(
        R=poses.T_MH.R, t=poses.T_MH.t + 0.03 * rng.standard_normal((VIEWS, 3)), source=Frame.M, target=Frame.H
    )
    T_HT = RigidTransform(R=R_z(np.pi), t=[0.3, -0.2, 0.1], source=Frame.H, target=Frame.T)
    on_plate = x @ R_y(0.1).T + [0.2, 0.1, -0.3]
    balls = tuple(
        Solid(shape=sphere(2.0).placed(t=c), material="WC-Co", name=n) for c, n in zip(on_plate, NAMES, strict=True)
    )
    images = simulate_ball_run(
        scanner, T_HT=T_HT, t=on_plate[0], poses=poses, T_MH=T_MH, ball_diameter=4.0, solids=balls, seed=5
    )
    (folder / "images").mkdir()
    for j, image in enumerate(images):
        tp.write_tiff(folder / "images" / f"view_{j}.tif", image)
    tp.write_scanner(folder / "scanner.json", scanner)
    tp.write_poses(folder / "scan.csv", poses)
    tp.write_standard(folder / "standard.csv", standard)
    return folder, eq5_matrices(scanner, T_HT=T_HT, T_MH=T_MH, alpha=np.asarray(poses.alpha))


def words(folder, *more):
    named = {"scanner": "scanner.json", "poses": "scan.csv", "images": "images", "standard": "standard.csv"}
    parts = ["calibrate", "--method", "multi-sphere", "--out", str(folder / "path"), "--force", *more]
    for option, file in named.items():
        parts += [f"--{option}", str(folder / file)]
    return parts


def test_radiographs_of_a_standard_become_matrices_of_their_path(scan, capsys):
    folder, P = scan
    assert run(words(folder, "--json")) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["verdict"] == "trustworthy"
    assert said["views"] == VIEWS
    made = tp.read_matrices(folder / "path" / "matrices.npz")
    d = without_object_pose(made.P, P, object_points())
    assert np.sqrt(np.mean(d**2)) < 2.5 * np.sqrt(np.mean(made.points_sigma**2))
    assert np.sqrt(np.mean(d**2)) * 0.8 / 5.3 < 0.0005  # mm at the object; the plate is 0.03 mm beside its table
    kept = json.loads((folder / "path" / "multi-sphere.json").read_text())
    assert kept["schema"] == "tomopose/multi-sphere/1"
    assert {b for v in kept["views"] for b in v["balls"]} <= set(NAMES)
    observed = tp.read_observations(folder / "path" / "observations.csv")
    assert len(observed) == sum(len(v["balls"]) for v in kept["views"])
    page = (folder / "path" / "report.html").read_text()
    assert "Multi-sphere calibration" in page
    assert "What the manipulator does beside its table" in page


@pytest.mark.slow
def test_an_image_without_the_standard_ends_with_exit_3_and_its_name(scan, tmp_path):
    folder, _ = scan
    blank = tmp_path / "images"
    blank.mkdir()
    for path in sorted((folder / "images").iterdir()):
        (blank / path.name).write_bytes(path.read_bytes())
    rng = np.random.default_rng(0)
    tp.write_tiff(blank / "view_3.tif", (45000 + 200 * rng.standard_normal((507, 511))).astype(np.uint16), force=True)
    parts = words(folder, "--quiet")
    parts[parts.index("--images") + 1] = str(blank)
    parts[parts.index("--out") + 1] = str(tmp_path / "path")
    assert run(parts) == 3
    poses = tp.read_poses(folder / "scan.csv")
    kept = json.loads((tmp_path / "path" / "multi-sphere.json").read_text())
    assert list(kept["lost"]) == [poses.pose_id[3]]
    assert tp.read_matrices(tmp_path / "path" / "matrices.npz").pose_id == tuple(
        name for k, name in enumerate(poses.pose_id) if k != 3
    )


@pytest.mark.parametrize(
    "more", [["--ball-diameter-mm", "4"], ["--model", "kinematic"], ["--arrangement", "moving-scanner"]]
)
def test_options_of_the_other_method_are_refused(scan, more):
    folder, _ = scan
    assert run(words(folder, *more)) == 2
