"""calibration.json and matrices.npz: bit for bit, old files, and files that were tampered with."""

from __future__ import annotations

import json
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tomopose import Calibration, PoseSequence, ProjectionMatrices
from tomopose.calibration.arrangements.twin_robots import twin_matrices
from tomopose.calibration.checks.conventions.hypothesis import Hypothesis
from tomopose.calibration.checks.stability import Effect, OutlierBlock, RepeatedPose, Stability
from tomopose.calibration.checks.verdict import Finding
from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.result import (
    Assumed,
    ModelComparison,
    ModelJudgement,
    Observability,
    Parameter,
    PoseNoiseFound,
    RotationResiduals,
    ViewDistances,
)
from tomopose.errors import FileError, InputError, SchemaVersionError
from tomopose.geometry.projection import eq5_matrices
from tomopose.io import read_calibration, read_matrices, write_calibration, write_matrices
from tomopose.io.calibration.errors_block import errors_document
from tomopose.io.matrices_npz import read_matrices_provenance
from tomopose.manipulator.error_models import EmpiricalErrors, IdentifiedErrors, PoseScatter, RigidErrors, TwinErrors
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.virtual import typical_robot
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
    "findings",
    "assumed",
    "arrangement",
}


def hypothesis(name: str, delta: float) -> Hypothesis:
    return Hypothesis(
        name=name,
        words=name,
        remedy="",
        sigmas=1.5,
        ball_mm=300.0,
        d_rms=0.1,
        chi2=9.0,
        dof=5,
        delta=delta,
        factor=1 / 3,
        outcome="same",
    )


@pytest.fixture
def cal(scanner, T_HT, rng) -> Calibration:
    n, names = 7, ("w_HT_x", "w_HT_y", "w_HT_z", "t_HT_x", "t[0]_x", "t[3]_x", "d_SR", "leg_1")
    root = rng.normal(size=(8, 8))
    covariance = root @ root.T
    covariance[7, :] = covariance[:, 7] = np.nan
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
            Parameter(name="joint_1_x", value=2 / 3, u=1e-3 / 7, unit="mm"),
            Parameter(name="leg_1", value=-0.0, u=float("nan"), unit="um"),
            Parameter(name="d_SR", value=scanner.d_SR, u=float("inf"), unit="mm"),
        ),
        observability=Observability(singular_values=np.array([3.0, 1 / 7, 0.0]), unobservable=("leg 1",), notes=("x",)),
        outliers={"p9": "ball truncated"},
        not_seen={"p10": "no ball"},
        model="kinematic",
        errors=RigidErrors(translation_scale=1.0 + 1 / 3e4, scatter=PoseScatter(t=rng.random(3), w=rng.random(3))),
        priors={"d_SR": 1 / 7, "u_0": float("inf")},
        assumed=(Assumed(name="d_SR", sigma=1 / 7, unit="mm", source="scanner.json"),),
        converged=False,
        status="stopped early",
        checks=(
            Finding(rule="a", value=1 / 3, limit=0.25, words="few poses", remedy="more", verdict="doubtful"),
            Finding(rule="b", value=float("nan"), limit=1.0, words="no table angle", verdict="doubtful"),
            Finding(rule="c", value=1.0, limit=0.5, words="worth knowing", verdict="trustworthy"),
        ),
        hypotheses=(hypothesis("as declared", 1.1), hypothesis("mirrored", 99.0)),
        stability=Stability(
            effects=(Effect(name="drift", p=1 / 7, size_px=0.1, share=0.2, words="w", at="p3"),),
            repeats=(RepeatedPose(first="p0", again="p6", distance_px=1 / 3, sigmas=2.5),),
            block=OutlierBlock(first="p1", last="p2", count=2, p=1e-3),
            held_out_rms=0.1,
            held_out_chi2=float("nan"),
            fit_rms=0.2,
        ),
        comparison=ModelComparison(
            models=(
                ModelJudgement(
                    model="rigid",
                    log_evidence=1.0,
                    log_predictive=2.0,
                    cv_rms=3.0,
                    cv_chi2=4.0,
                    d_rms=5.0,
                    chi2_dof=6.0,
                    scatter=7.0,
                    size=8.0,
                ),
            ),
            chosen="rigid",
            by_rotation=(RotationResiduals(rotation="+x", n=3, px={"rigid": 0.1}, um={"rigid": 4.0}),),
        ),
        pose_noise=PoseNoiseFound(
            translation_mm=1e-3, rotation_rad=1e-5, gain=20.0, chi2_dof_with=1.0, chi2_dof_without=3.0
        ),
        views=ViewDistances(sigma=0.5, pose_id=("p0", "p1"), d_SD=np.array([1.5, 2.5]), u=np.array([0.1, 1 / 3])),
        widening=1.5,
        expected_residual=0.02,
        magnification_at_ball=5.3,
        runs=(replace(scanner, d_SR=200.0), scanner),
        pivot=np.array([0.0, 0.1, 82.5]),
        convention="symetrie-hexapod",
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
        if f.name == "errors":
            assert errors_document(x) == errors_document(y)
        elif f.name in ("observability", "views", "stability") and x is not None:
            assert_same(x, y)
        elif f.name == "hypotheses":
            assert repr(x) == repr(y), "repr holds every digit, and NaN equals NaN there"
        elif f.name == "checks":
            np.testing.assert_array_equal([(c.value, c.limit) for c in x], [(c.value, c.limit) for c in y])
            assert [(c.rule, c.words, c.remedy, c.verdict) for c in x] == [
                (c.rule, c.words, c.remedy, c.verdict) for c in y
            ]
        elif isinstance(x, float):
            np.testing.assert_array_equal(x, y)
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
    bare = replace(
        cal,
        pivot=None,
        provenance=None,
        outliers={},
        not_seen={},
        errors=RigidErrors(),
        priors={},
        assumed=(),
        hypotheses=(),
        checks=(),
        stability=None,
        comparison=None,
        pose_noise=None,
        views=None,
        magnification_at_ball=None,
        runs=(),
    )
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
    assert document["schema"] == "tomopose/calibration/2"
    assert all(set(f) == {"rule", "value", "limit", "words", "cure", "verdict"} for f in document["findings"])
    assert all(set(a) == {"name", "sigma", "unit", "from"} for a in document["assumed"])
    first = document["parameters"][0]
    assert first["expanded_uncertainty_k2"] == 2 * first["standard_uncertainty"]


def test_a_kept_file_of_version_1_still_loads():
    cal = read_calibration(KEPT / "calibration-1.json")
    assert cal.verdict == "doubtful"
    assert cal.pose_id == tuple(f"p{k}" for k in range(7))
    assert cal.scanner.eta == 0.001
    assert cal.d_rms == json.loads((KEPT / "calibration-1.json").read_text())["d_rms_px"]


def _prior_of_version_1(document: dict) -> dict:
    return document["provenance"]["arguments"].get("priors", {})


@pytest.mark.parametrize("kind", ["rigid", "hexapod", "empirical", "robot", "moving", "twin"])
def test_files_of_version_1_of_every_arrangement_give_the_same_matrices(kind):
    """Written by the last version that wrote schema 1; so are the matrices that it made of them."""
    path = KEPT / f"calibration-1-{kind}.json"
    old = json.loads(path.read_text())
    expected = json.loads((KEPT / "calibration-1-expected.json").read_text())[kind]
    cal = read_calibration(path)
    assert (cal.verdict, list(cal.reasons)) == (expected["verdict"], expected["reasons"])
    assert cal.arrangement == {"moving": "moving-scanner", "twin": "twin"}.get(kind, "moving-object")
    of = {"rigid": RigidErrors, "moving": RigidErrors, "empirical": EmpiricalErrors, "twin": TwinErrors}
    assert type(cal.errors) is of.get(kind, IdentifiedErrors)
    scan = kept_scan(kind)
    P = twin_matrices(cal, *scan).P if kind == "twin" else projection_matrices(cal, scan).P
    np.testing.assert_allclose(P, expected["P"], rtol=1e-9, atol=1e-9 * np.abs(P).max())
    assert cal.priors == (_prior_of_version_1(old) | {"translation_scale": np.inf} if kind == "rigid" else {})
    assert (cal.errors.lag is not None) == ("lag" in old["manipulator"]) if kind == "hexapod" else True
    if kind == "moving":
        assert cal.views is not None
        assert len(cal.views.d_SD) == 40
    if kind == "rigid":
        assert [s.d_SR for s in cal.runs] == [283.5, 555.0]
        assert cal.pose_noise is not None
        assert len(cal.not_seen) == 2


@pytest.mark.parametrize("kind", ["rigid", "hexapod", "empirical", "robot", "moving", "twin"])
def test_a_file_of_version_1_is_written_as_version_2(tmp_path, kind):
    cal = read_calibration(KEPT / f"calibration-1-{kind}.json")
    write_calibration(tmp_path / "c.json", cal)
    assert_same(read_calibration(tmp_path / "c.json"), cal)


def kept_scan(kind: str):
    """The scans of which the kept files' matrices were made."""
    folder = str(Path(__file__).resolve().parents[2] / "benchmarks" / "manipulator")
    sys.path.insert(0, folder)
    try:
        from manipulator_cases import robot_experiment
        from twin_cases import twin_experiment
    finally:
        sys.path.remove(folder)
    if kind == "robot":
        return robot_experiment(typical_robot(), 0, n=60, table=True).scan.select(slice(0, 3))
    if kind == "twin":
        e = twin_experiment(typical_robot(), 1, n=60, views=6)
        return e.scan, e.scan_source
    r = np.random.default_rng(9)
    t, angles = r.uniform(-10, 10, (3, 3)), r.uniform(-6, 6, (3, 3))
    scan = PoseSequence.from_table(t, angles, alpha=np.radians(90.0 * (np.arange(3) % 4)))
    return inverse_poses(scan) if kind == "moving" else scan


def test_several_runs_with_an_identified_manipulator_are_written(tmp_path, cal, scanner):
    """They once ended in a TypeError: a Scanner is no JSON."""
    write_calibration(tmp_path / "c.json", cal)
    assert read_calibration(tmp_path / "c.json").runs[0].d_SR == 200.0


def test_a_newer_schema_is_refused(tmp_path, cal):
    write_calibration(tmp_path / "c.json", cal)
    text = (tmp_path / "c.json").read_text().replace("tomopose/calibration/2", "tomopose/calibration/3")
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
        (lambda d: d["findings"].clear(), InputError, "not that of the findings"),
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


def test_matrices_without_a_schema_count_as_the_first_version(tmp_path, matrices):
    """Scripts write such files; what they hold is checked all the same."""
    path = tmp_path / "m.npz"
    write_matrices(path, matrices)
    change(path, schema=..., content_sha256=...)
    assert np.array_equal(read_matrices(path).P, matrices.P)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"schema": "tomopose/matrices/2"}, SchemaVersionError, "tomopose/matrices/1"),
        ({"colour": 1}, InputError, "unknown key 'colour'; known are: schema, P"),
        ({"p_u": ...}, InputError, "p_u missing"),
        ({"p_u": -0.1}, InputError, "a positive pitch is needed"),
        ({"P": np.zeros((2, 3))}, InputError, r"\(n, 3, 4\)"),
        ({"pose_id": np.array(["a"])}, InputError, "56 matrices but 1 pose ids"),
        ({"scanner": "{"}, FileError, "scanner is no JSON"),
        ({"scanner": "5"}, FileError, "no readable matrices.npz|damaged"),
        ({"scanner": "{}"}, InputError, "scanner: d_SD_mm, .* missing"),
        ({"n_u": np.array([1, 2])}, InputError, "a whole number is needed"),
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
    with pytest.raises(FileError, match="Python objects"):
        read_matrices(tmp_path / "pickled.npz")
    write_matrices(tmp_path / "m.npz", matrices)
    with pytest.raises(FileError, match="exists already"):
        write_matrices(tmp_path / "m.npz", matrices)
    whole = (tmp_path / "m.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError, match=r"is no readable matrices.npz"):
        read_matrices(tmp_path / "half.npz")
