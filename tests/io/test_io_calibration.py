"""calibration.json and matrices.npz: bit for bit, old files, and files that were tampered with."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tomopose import Calibration, ProjectionMatrices
from tomopose.calibration.result import Observability, Parameter
from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.geometry.projection import eq5_matrices
from tomopose.io import read_calibration, read_matrices, write_calibration, write_matrices
from tomopose.io.matrices_npz import read_matrices_provenance
from tomopose.provenance import Provenance, provenance
from tomopose.trajectory.pose_grid import pose_grid

KEPT = Path(__file__).parent / "files"
INTERFACE = {
    "schema",
    "T_HT",
    "t_mm",
    "ball_ids",
    "parameters",
    "covariance",
    "d_rms_px",
    "d_rms_um",
    "dof",
    "chi2_dof",
    "model",
    "manipulator",
    "observability",
    "hypotheses",
    "verdict",
    "reasons",
    "pivot_mm",
    "scanner",
    "residuals",
    "outliers",
    "status",
    "provenance",
}


@pytest.fixture
def cal(scanner, T_HT, rng) -> Calibration:
    n, names = 7, ("w_HT_x", "w_HT_y", "w_HT_z", "t_HT_x", "t[0]_x", "t[3]_x", "d_SR", "leg_1")
    covariance = rng.normal(size=(8, 8))
    covariance[7] = np.nan
    covariance[7, 7] = np.inf
    return Calibration(
        scanner=replace(scanner, eta=0.001, sigma={"u_0": 0.3}),
        T_HT=T_HT,
        balls={0: rng.normal(size=3), 3: rng.normal(size=3)},
        tangent=names,
        covariance=covariance,
        pose_id=tuple(f"p{k}" for k in range(n)),
        x_D=rng.normal(size=(n, 2)) * 300,
        residuals=rng.normal(size=(n, 2)) / 100,
        chi2=1 / 3,
        dof=5,
        parameters=(
            Parameter(name="t_HT_x", value=2 / 3, u=1e-3 / 7, unit="mm"),
            Parameter(name="leg_1", value=-0.0, u=float("nan"), unit="um"),
            Parameter(name="d_SR", value=310.1, u=float("inf"), unit="mm"),
        ),
        observability=Observability(singular_values=np.array([3.0, 1 / 7, 0.0]), unobservable=("leg 1",), notes=("x",)),
        outliers={"p9": "ball truncated"},
        model="kinematic",
        manipulator={"leg_1": 0.1, "all": [1.5, 2.5]},
        converged=False,
        status="stopped early",
        verdict="doubtful",
        reasons=("few poses", "no table angle"),
        hypotheses=({"name": "as declared", "chi2_dof": 1.1}, {"name": "mirrored", "chi2_dof": 99.0}),
        pivot=np.array([0.0, 0.1, 82.5]),
        convention="symetrie-hexapod",
        extra={"ball_diameter_mm": 8.0},
        provenance=Provenance(version="0.1.0", dependencies={"numpy": "2"}, inputs={"a": "b"}, seed=3),
    )


def assert_same(a: object, b: object) -> None:
    """Equal in every field, bit for bit, NaN included."""
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if f.name == "balls":
            assert list(x) == list(y)
            x, y = np.array(list(x.values())), np.array(list(y.values()))
        if f.name == "T_HT":
            x, y = x.matrix, y.matrix
        if f.name == "observability":
            assert_same(x, y)
        elif isinstance(x, np.ndarray):
            assert x.tobytes() == y.tobytes(), f.name
        elif f.name == "parameters":
            np.testing.assert_array_equal([(p.value, p.u) for p in x], [(p.value, p.u) for p in y])
            assert [(p.name, p.unit) for p in x] == [(p.name, p.unit) for p in y]
        else:
            assert x == y, f.name


def test_a_calibration_comes_back_bit_for_bit(tmp_path, cal):
    write_calibration(tmp_path / "c.json", cal)
    again = read_calibration(tmp_path / "c.json")
    assert_same(again, cal)
    assert np.signbit(again.parameters[1].value)
    assert (again.d_rms, again.d_rms_um, again.chi2_dof) == (cal.d_rms, cal.d_rms_um, cal.chi2_dof)


def test_a_bare_calibration_comes_back(tmp_path, cal):
    bare = replace(cal, pivot=None, provenance=None, outliers={}, manipulator={}, hypotheses=(), extra={}, reasons=())
    write_calibration(tmp_path / "c.json", bare)
    assert_same(read_calibration(tmp_path / "c.json"), bare)


def test_the_file_has_the_fixed_keys_and_units(tmp_path, cal):
    write_calibration(tmp_path / "c.json", cal)
    document = json.loads((tmp_path / "c.json").read_text())
    assert set(document) >= INTERFACE
    assert set(document["T_HT"]) == {"matrix", "angles_rad", "t_mm"}
    assert document["covariance"]["names"] == list(cal.tangent)
    assert document["covariance"]["units"] == ["rad"] * 3 + ["mm"] * 4 + ["um"]
    assert document["ball_ids"] == [0, 3]
    first = document["parameters"][0]
    assert first["expanded_uncertainty_k2"] == 2 * first["standard_uncertainty"]


def test_a_kept_file_of_version_1_still_loads():
    cal = read_calibration(KEPT / "calibration-1.json")
    assert cal.verdict == "doubtful"
    assert cal.pose_id == tuple(f"p{k}" for k in range(7))
    assert cal.scanner.eta == 0.001
    assert cal.d_rms == json.loads((KEPT / "calibration-1.json").read_text())["d_rms_px"]


def test_a_newer_schema_is_refused(tmp_path, cal):
    write_calibration(tmp_path / "c.json", cal)
    text = (tmp_path / "c.json").read_text().replace("tomopose/calibration/1", "tomopose/calibration/2")
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(SchemaVersionError, match="newer"):
        read_calibration(tmp_path / "c.json")


@pytest.mark.parametrize(
    ("edit", "error", "message"),
    [
        (lambda d: d.pop("covariance"), InputError, "the key 'covariance' is missing"),
        (lambda d: d["T_HT"]["t_mm"].__setitem__(0, 2.1), InputError, "contradict each other"),
        (lambda d: d["T_HT"]["angles_rad"].__setitem__(0, 0.021), InputError, "contradict each other"),
        (lambda d: d["covariance"]["matrix"].pop(), FileError, "damaged"),
        (lambda d: d["residuals"]["u_px"].pop(), FileError, "damaged"),
        (lambda d: d["ball_ids"].append(4), InputError, "3 ball_ids but 2 rows"),
        (lambda d: d.__setitem__("verdict", "fine"), InputError, "verdict 'fine'"),
        (lambda d: d["scanner"].pop("d_SD_mm"), InputError, "scanner: d_SD_mm missing"),
        (lambda d: d.__setitem__("parameters", 3), FileError, "damaged"),
    ],
)
def test_a_file_that_was_tampered_with_is_refused(tmp_path, cal, edit, error, message):
    path = tmp_path / "c.json"
    write_calibration(path, cal)
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))
    with pytest.raises(error, match=message):
        read_calibration(path)


def test_nothing_is_overwritten_without_force(tmp_path, cal):
    write_calibration(tmp_path / "c.json", cal)
    with pytest.raises(FileError, match="exists already"):
        write_calibration(tmp_path / "c.json", cal)


# -- matrices ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def matrices(scanner, T_HT, rng) -> ProjectionMatrices:
    poses = pose_grid(2)
    return ProjectionMatrices(
        P=eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH),
        n_u=scanner.n_u,
        n_v=scanner.n_v,
        p_u=scanner.p_u,
        p_v=scanner.p_v,
        pose_id=tuple(f"ö{k}" for k in range(len(poses))),
        scanner=scanner,
        points_sigma=rng.random((len(poses), 5)),
    )


def test_matrices_come_back(tmp_path, matrices):
    made = provenance(arguments={"binning": 2})
    write_matrices(tmp_path / "m.npz", matrices, provenance=made)
    again = read_matrices(tmp_path / "m.npz")
    np.testing.assert_allclose(again.P, matrices.P, rtol=3e-16)
    assert (again.n_u, again.n_v, again.p_u, again.p_v) == (1501, 1203, 0.2, 0.25)
    assert again.pose_id == matrices.pose_id
    assert again.scanner == matrices.scanner
    np.testing.assert_array_equal(again.points_sigma, matrices.points_sigma)
    assert read_matrices_provenance(tmp_path / "m.npz") == made


def test_bare_matrices_come_back(tmp_path, matrices):
    write_matrices(tmp_path / "m.npz", replace(matrices, points_sigma=None, scanner=None))
    again = read_matrices(tmp_path / "m.npz")
    assert again.points_sigma is None
    assert again.scanner is None
    assert read_matrices_provenance(tmp_path / "m.npz") is None


def test_any_program_can_read_the_matrices(tmp_path, matrices):
    write_matrices(tmp_path / "m.npz", matrices)
    with np.load(tmp_path / "m.npz", allow_pickle=False) as archive:
        assert {"schema", "P", "n_u", "n_v", "p_u", "p_v", "pose_id", "P_points_sigma_px"} <= set(archive.files)
        assert archive["P"].dtype == np.float64
        assert str(archive["schema"]) == "tomopose/matrices/1"


def change(path: Path, **changes: object) -> None:
    with np.load(path) as archive:
        content = {k: archive[k] for k in archive.files} | changes
    np.savez(path, **{k: v for k, v in content.items() if v is not ...})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"schema": "tomopose/matrices/2"}, SchemaVersionError, "tomopose/matrices/1"),
        ({"schema": ...}, SchemaVersionError, "schema is 'None'"),
        ({"colour": 1}, InputError, "unknown key 'colour'; known are: schema, P"),
        ({"p_u": ...}, InputError, "p_u missing"),
        ({"p_u": -0.1}, InputError, "a positive pitch is needed"),
        ({"P": np.zeros((2, 3))}, InputError, r"\(n, 3, 4\)"),
        ({"pose_id": np.array(["a"])}, InputError, "56 matrices but 1 pose ids"),
        ({"scanner": "{"}, FileError, "scanner is no JSON"),
        ({"scanner": "5"}, FileError, "no readable matrices.npz|damaged"),
        ({"scanner": "{}"}, InputError, "scanner: d_SD_mm, .* missing"),
        ({"n_u": np.array([1, 2])}, FileError, "damaged"),
    ],
)
def test_matrices_that_do_not_fit_are_refused(tmp_path, matrices, changes, error, message):
    path = tmp_path / "m.npz"
    write_matrices(path, matrices)
    change(path, **changes)
    with pytest.raises(error, match=message):
        read_matrices(path)


def test_files_that_are_no_matrices_are_refused(tmp_path, matrices):
    with pytest.raises(FileError, match="does not exist"):
        read_matrices(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(FileError, match=r"is no readable matrices.npz"):
        read_matrices(tmp_path / "text.npz")
    (tmp_path / "empty.npz").write_bytes(b"")
    with pytest.raises(FileError, match=r"is no readable matrices.npz"):
        read_matrices(tmp_path / "empty.npz")
    np.savez(tmp_path / "pickled.npz", P=np.array([{}], dtype=object))
    with pytest.raises(FileError, match="allow_pickle"):
        read_matrices(tmp_path / "pickled.npz")
    write_matrices(tmp_path / "m.npz", matrices)
    with pytest.raises(FileError, match="exists already"):
        write_matrices(tmp_path / "m.npz", matrices)
    whole = (tmp_path / "m.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError, match=r"is no readable matrices.npz"):
        read_matrices(tmp_path / "half.npz")
