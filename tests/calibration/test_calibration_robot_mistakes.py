"""Tables of a robot's poses declared in another convention or unit than they are in: named, or nothing is advised."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tomopose.calibration.checks.conventions.diagnose import diagnose
from tomopose.calibration.checks.conventions.hypothesis import FITS_SIGMAS
from tomopose.calibration.model.problem import pair
from tomopose.calibration.model.silhouettes import chain_matrices, silhouette_outlines
from tomopose.calibration.solve import calibrate
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.rotations import CONVENTIONS, rotation_from_convention
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.io import read_observations, read_poses, read_scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

SIGMA = 0.02
SCANNER = Scanner(d_SD=1400.0, d_SR=640.0, p_u=0.2, p_v=0.25, u_0=1003.2, v_0=811.9, n_u=2049, n_v=1601)
MOUNT = RigidTransform.from_angles(
    np.radians([2.0, -1.0, 176.0]), [580.0, 25.0, -390.0], source=Frame.H, target=Frame.T
)
BALL = np.array([15.0, -22.0, 120.0])
NAMES = {
    "sxyz_as_staubli": "order ZYX",
    "rotvec_as_kuka": "rotation vector in degrees",
    "rotvec_as_yaskawa": "rotation vector in degrees",
    "rpy_as_ur": "order ZYX",
    "wxyz_as_xyzw": "quaternion w first",
    "xyzw_as_abb": "quaternion w last",
    "zyz_as_kuka": "order ZYZ",
}


def robot_poses(seed=3, n=50):
    """Rotations of tens of degrees and translations that keep the ball in the field of view: T_MH (n,)."""
    rng = np.random.default_rng(seed)
    R = (
        Rotation.from_euler("xyz", [170, -10, 30], degrees=True) * Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (n, 3)))
    ).as_matrix()
    x_T = rng.uniform(-35, 35, (n, 3))
    x_H = (x_T - MOUNT.t) @ MOUNT.R
    return R, x_H - R @ BALL


def table(convention, columns, t=None, alpha=None):
    """A table as its reader makes it: the columns under a declared convention."""
    _, own = robot_poses(n=len(columns))
    return PoseSequence.from_table(own if t is None else t, columns, convention=convention, alpha=alpha)


def centres(alpha=None):
    R, t = robot_poses()
    T = RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H)
    exact = project_ball(SCANNER, T_HT=MOUNT, T_MH=T, t=BALL, alpha=np.zeros(len(t)) if alpha is None else alpha)
    noisy = exact + np.random.default_rng(8).normal(0, SIGMA, exact.shape)
    return BallObservations.from_sigma(noisy, SIGMA, pose_id=[str(k) for k in range(len(t))])


TRUTH = Rotation.from_matrix(robot_poses()[0])
DEGREES = {"degrees": True}
WRITTEN = {
    # name of the true reading, declared convention -> the columns as written
    ("rotation vector in degrees", "pi-hexapod"): np.degrees(TRUTH.as_rotvec()),
    ("rotation vector in degrees", "fanuc"): np.degrees(TRUTH.as_rotvec()),
    ("rotation vector in degrees, columns reversed", "kuka"): np.degrees(TRUTH.as_rotvec()),
    ("rotation vector in radians", "yaskawa"): TRUTH.as_rotvec(),
    ("rotation vector in degrees", "kawasaki"): np.degrees(TRUTH.as_rotvec()),
    ("order ZYX", "rotvec"): TRUTH.as_euler("xyz"),
    ("order XYZ", "ur"): TRUTH.as_euler("XYZ"),
    ("order YXZ", "ur"): TRUTH.as_euler("YXZ")[:, [1, 0, 2]],
    ("angles are degrees", "ur"): np.degrees(TRUTH.as_rotvec()),
    ("order ZYX, columns reversed", "yaskawa"): TRUTH.as_euler("ZYX", **DEGREES),
    ("order XYZ", "kawasaki"): TRUTH.as_euler("XYZ", **DEGREES),
    ("order ZYZ", "fanuc"): TRUTH.as_euler("ZYZ", **DEGREES),
    ("order ZXZ", "staubli"): TRUTH.as_euler("ZXZ", **DEGREES),
    ("angles are radians", "fanuc"): TRUTH.as_euler("xyz"),
    ("sign of UVW", "kuka"): -TRUTH.as_euler("ZYX", **DEGREES),
    ("quaternion w first", "quaternion-xyzw"): TRUTH.as_quat(scalar_first=True),
    ("quaternion w last", "quaternion-wxyz"): TRUTH.as_quat(),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "convention"), WRITTEN, ids=[" as ".join(key) for key in WRITTEN])
def test_the_true_reading_of_the_columns_is_advised_alone(name, convention):
    found = diagnose(SCANNER, table(convention, WRITTEN[name, convention]), centres())
    assert [h.name for h in found.leading] == [name]
    assert found.leading[0].d_rms < 2 * SIGMA
    assert found.leading[0].remedy in found.advice[0]


@pytest.mark.slow
def test_a_rightly_declared_table_of_each_convention_is_left_alone():
    for name, convention in CONVENTIONS.items():
        columns = {
            "euler": lambda c=convention: TRUTH.as_euler(c.axes, degrees=True),
            "rotvec": lambda c=convention: TRUTH.as_rotvec(),
            "quaternion": lambda c=convention: TRUTH.as_quat(scalar_first=c.scalar_first),
        }[convention.kind]()
        np.testing.assert_allclose(rotation_from_convention(columns, name), TRUTH.as_matrix(), atol=1e-12)
        found = diagnose(SCANNER, table(name, columns), centres())
        assert found.as_declared, name
        assert not {h.name for h in found.same} & set(NAMES.values()), name


def test_nothing_is_advised_where_no_reading_fits():
    rng = np.random.default_rng(0)
    found = diagnose(SCANNER, table("ur", rng.uniform(-1.5, 1.5, (50, 3))), centres())
    assert found.nothing_fits
    assert found.leading == ()
    assert all(h.sigmas > FITS_SIGMAS and not h.fits for h in found.hypotheses)
    assert found.advice[0].startswith("nothing fits")
    assert "to try" not in " ".join(found.advice)


def test_columns_that_no_longer_belong_to_the_poses_are_not_read_again():
    from dataclasses import replace

    from tomopose.calibration.model.problem import pair

    poses = table("kuka", WRITTEN["sign of UVW", "kuka"])
    turned = replace(poses, T_MH=replace(poses.T_MH, R=TRUTH.as_matrix()))
    assert pair(SCANNER, poses, centres()).orientations is not None
    assert pair(SCANNER, turned, centres()).orientations is None


@pytest.mark.parametrize(("unit", "factor"), [("centimetres", 10.0), ("inches", 25.4), ("metres", 1000.0)])
@pytest.mark.parametrize("convention", ["ur", "kuka"])
def test_another_unit_of_the_positions_is_named_with_the_table_still_or_turned(unit, factor, convention):
    """With the table still every unit leaves the same centres; the ball's place on the beam shows the right one."""
    t = robot_poses()[1]
    columns = TRUTH.as_rotvec() if convention == "ur" else TRUTH.as_euler("ZYX", degrees=True)
    still = diagnose(SCANNER, table(convention, columns, t=t / factor), centres())
    assert still.other_unit is not None
    assert still.other_unit.name == f"positions in {unit}"
    assert any(unit in line for line in still.advice)
    assert not still.as_declared
    alpha = np.radians(np.tile([0.0, 90.0], 25))
    turned = diagnose(SCANNER, table(convention, columns, t=t / factor, alpha=alpha), centres(alpha))
    assert [h.name for h in turned.leading] == [f"positions in {unit}"]


def test_millimetres_that_are_confirmed_are_not_questioned():
    from dataclasses import replace

    poses = replace(table("ur", TRUTH.as_rotvec(), t=robot_poses()[1] / 10.0), units_confirmed=True)
    assert diagnose(SCANNER, poses, centres()).other_unit is None


@pytest.mark.parametrize("name", NAMES)
def test_tables_of_robots_declared_wrongly_are_named(shared_data, name):
    case = shared_data / "cases" / "rotation-vector-read-as-euler"
    assert name in json.loads((case / "expected.json").read_text())["true_reading"]
    found = diagnose(
        read_scanner(case / "scanner.json"),
        read_poses(case / f"{name}.csv"),
        read_observations(case / "observations.csv"),
    )
    assert [h.name for h in found.leading] == [NAMES[name]]
    assert found.leading[0].d_rms < 0.03


@pytest.mark.parametrize(("unit", "factor"), [("centimetres", 10.0), ("inches", 25.4)])
def test_silhouettes_name_the_unit_and_clear_millimetres_of_doubt(unit, factor):
    """With the table at one angle every scale fits; the ball's size settles it, also where the diagnosis asks."""
    x, columns = centres(), TRUTH.as_euler("xyz", degrees=True)
    poses = table("fanuc", columns)
    cal = calibrate(SCANNER, poses, x, hypotheses=False)
    P = chain_matrices(pair(SCANNER, poses, x), (cal.scanner,), cal.T_HT)
    radius = np.sqrt(silhouette_outlines(P, np.tile(cal.t, (len(poses), 1)), 8.0))
    seen = replace(x, semi_major=radius, semi_minor=radius, ball_diameter=8.0)
    assert diagnose(SCANNER, poses, seen).as_declared
    wrong = table("fanuc", columns, t=robot_poses()[1] / factor)
    found = diagnose(SCANNER, wrong, seen)
    assert found.other_unit is not None
    assert found.other_unit.name == f"positions in {unit}"
    assert not found.as_declared
    assert "silhouettes" in found.advice[0]
    thick = diagnose(SCANNER, poses, replace(seen, ball_diameter=8.3))
    assert not thick.as_declared
    assert "silhouettes" in thick.advice[0]
