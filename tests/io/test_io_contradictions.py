"""Results and tables that contradict themselves are refused by name; edited ones are named."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest

from tomopose import (
    BallObservations,
    ProjectionMatrices,
    calibrate,
    pose_grid,
    read_calibration,
    read_matrices,
    read_observations,
    read_poses,
    write_calibration,
    write_matrices,
    write_poses,
)
from tomopose.errors import InputError, UnitError
from tomopose.files import EditedWarning
from tomopose.geometry.projection import eq5_matrices, project_ball
from tomopose.reading.contradictions import require_consistent_calibration, require_covariance


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    """calibration.json of a small calibration, as its content."""
    from tomopose import RigidTransform, Scanner
    from tomopose.geometry.frames import Frame

    scanner = Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)
    T_HT = RigidTransform.from_angles([0.02, -0.03, 3.05], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T)
    poses = pose_grid(2)
    rng = np.random.default_rng(4)
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=np.array([5.0, 12.0, 3.0]), alpha=poses.alpha)
    observations = BallObservations(
        x_D=x_D + rng.normal(0, 0.02, x_D.shape),
        covariance=np.tile(np.eye(2) * 4e-4, (len(x_D), 1, 1)),
        pose_id=poses.pose_id,
    )
    path = tmp_path_factory.mktemp("calibration") / "calibration.json"
    write_calibration(path, calibrate(scanner, poses, observations))
    return json.loads(path.read_text())


def edited(document, tmp_path, change):
    copy = json.loads(json.dumps(document))
    change(copy)
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(copy))
    return path


def entry(document, i, j, value):
    document["covariance"]["matrix"][i][j] = value


def first(document, name):
    return next(p for p in document["parameters"] if p["name"] == name)


CONTRADICTIONS = [
    (lambda d: first(d, "t_HT_x").update(value=7.0), "t_HT_x is 7 in one place"),
    (lambda d: first(d, "t_x").update(value=7.0), "t_x is 7 in one place"),
    (lambda d: d["parameters"][0].update(expanded_uncertainty_k2=1.0), "expanded uncertainty"),
    (lambda d: d.update(chi2_dof=55.0), "chi2_dof is"),
    (lambda d: d["residuals"]["d_px"].__setitem__(3, 9.0), "residual 3 is"),
    (lambda d: entry(d, 0, 1, 1.0), "not symmetric"),
    (lambda d: entry(d, 2, 2, -1e-9), "a variance is not negative"),
    (lambda d: [entry(d, 0, 1, 1e-3), entry(d, 1, 0, 1e-3)], "not positive"),
    (lambda d: [entry(d, 0, 1, None), entry(d, 1, 0, None)], "is not finite"),
    (lambda d: d.update(dof=12.5), "dof is 12.5"),
    (lambda d: d.update(dof=True), "dof is True"),
    (lambda d: d.update(ball_ids=[0.5]), "a ball id is 0.5"),
    (lambda d: d.update(ball_ids=[0, 0], t_mm=d["t_mm"] * 2), "the ball id '0' occurs more than once"),
    (lambda d: d["residuals"]["pose_id"].__setitem__(1, d["residuals"]["pose_id"][0]), "pose id .* more than once"),
    (lambda d: d["covariance"]["names"].__setitem__(1, d["covariance"]["names"][0]), "more than once"),
    (lambda d: d["parameters"][0].update(standard_uncertainty=-1.0), "standard uncertainty of .* is -1"),
]


@pytest.mark.parametrize(("change", "words"), CONTRADICTIONS)
def test_a_calibration_that_contradicts_itself_is_refused(document, tmp_path, change, words):
    copy = json.loads(json.dumps(document))
    require_consistent_calibration(copy, "calibration.json", version=2)
    change(copy)
    with pytest.raises(InputError, match=rf"calibration\.json.*{words}"):
        require_consistent_calibration(copy, "calibration.json", version=2)
    if not document["schema"].endswith("/1"):
        with pytest.raises(InputError, match=words):
            read_calibration(edited(document, tmp_path, change))


def test_an_edited_calibration_is_named_and_a_sound_one_is_not(document, tmp_path):
    path = edited(document, tmp_path, lambda d: None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_calibration(path)
        path.write_text(json.dumps(dict(reversed(document.items())), indent=3))
        read_calibration(path)  # another layout is the same content
    with pytest.warns(EditedWarning, match=r"calibration\.json was edited"):
        read_calibration(edited(document, tmp_path, lambda d: d.update(status="very good")))


def test_a_direction_that_is_not_determined_may_have_no_variance():
    C = np.diag([1.0, np.inf, 2.0])
    C[1, :] = C[:, 1] = np.nan
    C[1, 1] = np.inf
    require_covariance(C, ["a", "b", "c"], "here")
    require_covariance(np.zeros((0, 0)), [], "here")


@pytest.fixture
def matrices(scanner, T_HT):
    poses = pose_grid(2)
    return ProjectionMatrices(
        P=eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=poses.alpha),
        n_u=scanner.n_u,
        n_v=scanner.n_v,
        p_u=scanner.p_u,
        p_v=scanner.p_v,
        pose_id=poses.pose_id,
        points_sigma=np.full((len(poses), 9), 0.01),
        scanner=scanner,
    )


def mirrored(content):
    content["P"] = content["P"].copy()
    content["P"][3, 0] *= -1


def other_scanner(content):
    content["scanner"] = np.array(str(content["scanner"]).replace('"n_u_px": 1501', '"n_u_px": 1502'))


def other_pitch(content):
    content["scanner"] = np.array(str(content["scanner"]).replace('"p_u_mm": 0.2', '"p_u_mm": 0.21'))


def twice(content):
    content["pose_id"] = content["pose_id"].copy()
    content["pose_id"][1] = content["pose_id"][0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (mirrored, "is mirrored, unlike"),
        (other_scanner, "n_u of the scanner is 1502"),
        (other_pitch, "p_u of the scanner is 0.21"),
        (twice, "pose id .* occurs more than once"),
        (lambda c: c.update(n_u=np.array(1501.5)), "n_u is 1501.5; a whole number"),
        (lambda c: c.update(n_u=np.array(np.inf)), "n_u is inf; a whole number"),
        (lambda c: c.update(P_points_sigma_px=-c["P_points_sigma_px"]), "negative or not finite"),
        (lambda c: c.update(P_points_sigma_px=c["P_points_sigma_px"] * np.nan), "negative or not finite"),
    ],
)
def test_matrices_that_contradict_themselves_are_refused(matrices, tmp_path, change, words):
    write_matrices(tmp_path / "m.npz", matrices)
    with np.load(tmp_path / "m.npz") as archive:
        content = dict(archive)
    change(content)
    np.savez(tmp_path / "m.npz", allow_pickle=False, **content)
    with pytest.raises(InputError, match=rf"m\.npz.*{words}"):
        read_matrices(tmp_path / "m.npz")


def test_edited_matrices_are_named(matrices, tmp_path):
    write_matrices(tmp_path / "m.npz", matrices)
    read_matrices(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as archive:
        content = dict(archive)
    content["P"] = content["P"] + 1e-6
    np.savez(tmp_path / "m.npz", allow_pickle=False, **content)
    with pytest.warns(EditedWarning, match=r"m\.npz was edited"):
        read_matrices(tmp_path / "m.npz")
    flipped = matrices.P.copy()
    flipped[0, 0] *= -1
    write_matrices(tmp_path / "f.npz", replace(matrices, P=flipped))
    with pytest.raises(InputError, match="mirrored"):
        read_matrices(tmp_path / "f.npz")


@pytest.mark.parametrize("sigma", ["1e-30", "1e-10", "1e5"])
def test_a_sigma_that_nobody_measures_is_refused(tmp_path, sigma):
    (tmp_path / "o.csv").write_text(f"pose_id,u_px,v_px,sigma_u_px,sigma_v_px\na,10,20,{sigma},0.01\n")
    with pytest.raises(InputError, match=r"o\.csv: row 1 .*sigma_u_px: sigma is .* px; a centre is measured"):
        read_observations(tmp_path / "o.csv")


def test_long_lines_and_cells_are_refused(tmp_path):
    for text, words in (("x" * 3000, "cell of 3000 characters"), (",".join(["1"] * 60_000), "characters; no table")):
        (tmp_path / "o.csv").write_text(f"pose_id,u_px,v_px,sigma_u_px,sigma_v_px\n{text},10,20,0.1,0.01\n")
        with pytest.raises(InputError, match=words):
            read_observations(tmp_path / "o.csv")


def poses_with(tmp_path, change):
    write_poses(tmp_path / "p.csv", pose_grid(3))
    lines = (tmp_path / "p.csv").read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if line.startswith("pose_id"))
    columns = lines[head].split(",")
    change(lines, head, columns)
    (tmp_path / "p.csv").write_text("\n".join(lines) + "\n")
    return tmp_path / "p.csv"


@pytest.mark.parametrize(
    ("names", "factor", "words"),
    [
        (("x_mm", "y_mm", "z_mm"), 1e-3, "metres among rows in mm"),
        (("rx_deg", "ry_deg", "rz_deg"), np.pi / 180, "radians among rows in degrees"),
    ],
)
def test_single_rows_in_another_unit_are_named(tmp_path, names, factor, words):
    def change(lines, head, columns):
        for k in range(head + 1, len(lines)):
            cells = lines[k].split(",")
            places = [columns.index(n) for n in names]
            if k % 7 == 0 and any(float(cells[p]) for p in places):
                for p in places:
                    cells[p] = repr(float(cells[p]) * factor)
                lines[k] = ",".join(cells)

    with pytest.raises(UnitError, match=words):
        read_poses(poses_with(tmp_path, change))


def test_encoders_near_zero_are_no_other_unit(tmp_path):
    rng = np.random.default_rng(5)

    def change(lines, head, columns):
        for k in range(head + 1, len(lines)):
            cells = lines[k].split(",")
            for n, noise in (("x_mm", 0.01), ("y_mm", 0.01), ("z_mm", 0.01), ("rx_deg", 0.002), ("ry_deg", 0.002)):
                p = columns.index(n)
                cells[p] = repr(float(cells[p]) + rng.normal(0, noise))
            lines[k] = ",".join(cells)

    assert len(read_poses(poses_with(tmp_path, change))) > 100


@pytest.mark.parametrize("at", [(-1600.0, 500.0), (3100.0, 500.0), (700.0, 1e5)])
def test_observations_off_the_panel_are_refused(scanner, at):
    observations = BallObservations.from_sigma(
        np.array([[700.0, 500.0], at]), np.array([0.02, 0.02]), pose_id=("a", "b")
    )
    with pytest.raises(InputError, match=r"o\.csv: row 2 \(pose 'b'\) is at .* off the panel of 1501 x 1203"):
        observations.require_on_panel(scanner, "o.csv")
    assert len(observations.select([0]).require_on_panel(scanner, "o.csv")) == 1
