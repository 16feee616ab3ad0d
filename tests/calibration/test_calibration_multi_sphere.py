"""A path calibrated by a standard of several balls: identification, honesty, what is left out, home, files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tomopose as tp
from tomopose.calibration.arrangements.multi_sphere.identify import identify
from tomopose.calibration.uncertainty.trajectory import object_points
from tomopose.errors import InputError, NotObservableError
from tomopose.geometry.frames import Frame
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import eq5_matrices, project
from tomopose.geometry.rotations import R_x, R_y, R_z, exp_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle

SIGMA_PX = 0.01
MOUNT = RigidTransform(R=R_z(np.pi + 0.01) @ R_x(0.004), t=[1.5, -2.0, 3.0], source=Frame.H, target=Frame.T)
ON_PLATE = RigidTransform(R=R_y(0.2), t=[0.4, -0.7, 1.0], source=Frame.M, target=Frame.M)


@pytest.fixture(scope="module")
def scanner() -> tp.Scanner:
    """Pixels that are no squares, a piercing point off the middle, odd sides; all values exact in the user's words."""
    exact = dict.fromkeys(("d_SD", "d_SR", "p_u", "p_v", "u_0", "v_0", "eta", "theta", "phi"), 0.0)
    return tp.Scanner(
        d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.25, u_0=1031.3, v_0=811.7, n_u=2049, n_v=1641, sigma=exact
    )


def standard(n: int = 10, sigma: float = 0.0005) -> tp.SphereStandard:
    """Balls of 3 mm on a spiral about an upright axis, all distances different."""
    k = np.arange(n)
    a, r = k * np.pi * (3 - np.sqrt(5)), 6 + 12 * ((3 * k) % n) / (n - 1)
    x = np.stack([r * np.cos(a), r * np.sin(a), -20 + 40 * k / (n - 1)], axis=1)
    return tp.SphereStandard(
        names=tuple(f"K{i + 1}" for i in k), centres=x, diameters=np.full(n, 3.0), sigma=np.full(n, sigma)
    )


def erring(poses: tp.PoseSequence, rng: np.random.Generator) -> RigidTransform:
    """Poses that turn about axes off by 2.6 mrad, and scatter by 2 um and 20 urad: a rigid calibration would miss."""
    C = exp_rotation(np.array([0.0, 0.0, 2.6e-3]))
    R = C @ poses.T_MH.R @ C.T
    R = np.array([exp_rotation(2e-5 * rng.standard_normal(3)) @ r for r in R])
    lever = np.array([0.0, 0.0, -150.0])
    return replace(
        poses.T_MH, R=R, t=poses.T_MH.t + (poses.T_MH.R - R) @ lever + 0.002 * rng.standard_normal((len(poses), 3))
    )


def matrices_of(scanner: tp.Scanner, poses: tp.PoseSequence, T_MH: RigidTransform) -> np.ndarray:
    return eq5_matrices(scanner, T_HT=MOUNT, T_MH=T_MH, alpha=np.asarray(poses.alpha))


def circles_of(
    scanner: tp.Scanner, P: np.ndarray, made: tp.SphereStandard, rng: np.random.Generator, sigma: float = SIGMA_PX
) -> list[tp.Circles]:
    """What detection would measure: the balls in no order, radii good to half a percent."""
    x_W = (MOUNT @ RigidTransform.identity(Frame.M, Frame.H) @ ON_PLATE).apply(made.centres)
    views = []
    for p in P:
        order = rng.permutation(len(made))
        x = project(p[None], x_W[order])[0] + sigma * rng.standard_normal((len(order), 2))
        depth = x_W[order] @ p[2, :3] + p[2, 3]
        radius = scanner.d_SD * made.diameters[order] / 2 / depth / np.sqrt(scanner.p_u * scanner.p_v)
        views.append(tp.Circles(
            x_D=x, covariance=np.tile(sigma**2 * np.eye(2), (len(order), 1, 1)),
            radius=radius * (1 + 0.005 * rng.standard_normal(len(order))),
        ))  # fmt: skip
    return views


@pytest.fixture(scope="module")
def path(scanner):
    rng = np.random.default_rng(7)
    poses = tilted_scan(40, eq11_triangle)
    P = matrices_of(scanner, poses, erring(poses, rng))
    return poses, P, circles_of(scanner, P, standard(), rng)


@pytest.mark.slow
def test_the_path_of_an_erring_manipulator_is_found_within_its_uncertainty(scanner, path):
    poses, P, circles = path
    found = tp.calibrate_multi_sphere(scanner, poses, circles, standard())
    assert found.pose_id == poses.pose_id
    assert found.verdict == "trustworthy"
    assert 0.8 < found.chi2_dof < 1.2
    m = found.matrices(points=object_points())
    d = without_object_pose(m.P, P, object_points())
    ratio = np.sqrt(np.mean(d**2)) / np.sqrt(np.mean(m.points_sigma**2))
    assert 0.5 < ratio < 1.2
    # what the manipulator does beside its table is 0.4 px rms at these points
    nominal = matrices_of(scanner, poses, poses.T_MH)
    assert np.sqrt(np.mean(without_object_pose(nominal, P, object_points()) ** 2)) > 30 * np.sqrt(np.mean(d**2))


@pytest.mark.slow
def test_home_is_that_of_eq_5(scanner, path):
    """Points of W keep their meaning: the matrices need no other grid than those of the other method."""
    poses, P, circles = path
    found = tp.calibrate_multi_sphere(scanner, poses, circles, standard())
    x = np.array([[0.0, 0.0, 0.0], [8.0, -5.0, 11.0]])
    assert np.abs(project(found.matrices().P, x) - project(P, x)).max() < 0.6  # 25 um of a plate that errs by 100 um


@pytest.mark.slow
def test_wrong_scanner_values_with_their_sigma_are_found_along_the_path(scanner, path):
    poses, P, circles = path
    off = replace(
        scanner, d_SD=scanner.d_SD + 0.6, u_0=scanner.u_0 - 0.8, sigma={**scanner.sigma, "d_SD": 0.5, "u_0": 0.7}
    )
    found = tp.calibrate_multi_sphere(off, poses, circles, standard(sigma=0.0))
    assert found.path.shared.scanner_names == ("d_SD", "u_0")
    sigma = np.sqrt(np.diag(found.path.shared.covariance))[-2:]
    for name, s in zip(("d_SD", "u_0"), sigma, strict=True):
        assert abs(getattr(found.scanner, name) - getattr(scanner, name)) < 3.5 * s
    m = found.matrices(points=object_points())
    d = without_object_pose(m.P, P, object_points())
    assert np.sqrt(np.mean(d**2)) < 1.5 * np.sqrt(np.mean(m.points_sigma**2))
    assert m.points_sigma_shared.min() > 0


@pytest.mark.slow
def test_nobody_s_silence_counts_as_exact(path, scanner):
    poses, _, circles = path
    silent = replace(scanner, sigma={})
    found = tp.calibrate_multi_sphere(silent, poses, circles, standard())
    assert {a.source for a in found.assumed} == {"default"}
    exact = tp.calibrate_multi_sphere(scanner, poses, circles, standard())
    assert np.mean(found.matrices().points_sigma_shared) > np.mean(exact.matrices().points_sigma_shared)


@pytest.mark.slow
def test_a_circle_that_is_no_ball_does_not_confuse(scanner, path):
    _, P, circles = path
    rng = np.random.default_rng(3)
    c = circles[0]
    more = tp.Circles(
        x_D=np.concatenate([c.x_D, rng.uniform(300, 1500, (3, 2))]),
        covariance=np.concatenate([c.covariance, c.covariance[:3]]),
        radius=np.concatenate([c.radius, c.radius[:3]]),
    )
    which = identify(scanner, more, standard())
    assert (which.ball[-3:] == -1).all()
    x_W = (MOUNT @ RigidTransform.identity(Frame.M, Frame.H) @ ON_PLATE).apply(standard().centres)
    np.testing.assert_allclose(more.x_D[:-3], project(P[:1], x_W)[0][which.ball[:-3]], atol=0.1)


@pytest.mark.slow
def test_a_wrong_centre_is_set_aside_and_said(scanner, path):
    poses, _, circles = path
    c = circles[5]
    x = c.x_D.copy()
    x[2] += [0.3, 0.2]
    spoilt = [*circles[:5], replace(c, x_D=x), *circles[6:]]
    found = tp.calibrate_multi_sphere(scanner, poses, spoilt, standard())
    (words,) = [w for w in found.left_out[poses.pose_id[5]] if "standard uncertainties" in w]
    off = float(words.split(" px")[0].split()[-1])  # the pose gives way to it by a third
    assert 0.2 < off < 0.4
    assert found.verdict == "trustworthy"


@pytest.mark.slow
def test_views_without_a_pose_are_named_and_have_no_matrix(scanner, path):
    poses, _, circles = path
    none = replace(
        circles[0], x_D=circles[0].x_D[:2], covariance=circles[0].covariance[:2], radius=circles[0].radius[:2]
    )
    found = tp.calibrate_multi_sphere(scanner, poses, [*circles[:9], none, *circles[10:]], standard())
    assert list(found.lost) == [poses.pose_id[9]]
    assert found.verdict == "doubtful"
    assert poses.pose_id[9] in found.reasons[0]
    assert poses.pose_id[9] not in found.matrices().pose_id


@pytest.mark.slow
def test_a_moved_ball_of_the_standard_gives_doubt(scanner, path):
    poses, _, circles = path
    made = standard()
    x = made.centres.copy()
    x[4] += [0.0, 0.01, 0.0]
    found = tp.calibrate_multi_sphere(scanner, poses, circles, replace(made, centres=x))
    assert found.verdict != "trustworthy"
    assert any("K5" in reason for reason in found.reasons)


@pytest.mark.slow
def test_balls_that_hide_one_another_are_left_out(scanner):
    """Two balls on one ray: both have no whole rim, wherever detection thought that it saw one."""
    made = standard()
    x = made.centres.copy()
    x[1] = x[0] + [6.0, 0.0, 0.3]
    made = replace(made, centres=x)
    rng = np.random.default_rng(1)
    poses = tilted_scan(40, eq11_triangle)
    P = matrices_of(scanner, poses, poses.T_MH)
    found = tp.calibrate_multi_sphere(scanner, poses, circles_of(scanner, P, made, rng), made)
    hidden = {name for name, words in found.left_out.items() if any("K1 overlaps with ball K2" in w for w in words)}
    assert 0 < len(hidden) < len(poses)
    for name, view in zip(found.pose_id, found.views, strict=True):
        assert (0 in view.ball) == (name not in hidden)


def test_a_symmetric_standard_is_refused(scanner, path):
    poses, _, circles = path
    a = 2 * np.pi * np.arange(6) / 6
    ring = np.stack([15 * np.cos(a), 15 * np.sin(a), 0 * a], axis=1)
    made = tp.SphereStandard(names=tuple("ABCDEF"), centres=ring, diameters=np.full(6, 3.0))
    with pytest.raises(InputError, match="symmetric"):
        tp.calibrate_multi_sphere(scanner, poses, circles, made)


def test_a_standard_of_another_size_is_refused(scanner, path):
    poses, _, circles = path
    made = standard()
    with pytest.raises(InputError, match="found in none of 40 views"):
        tp.calibrate_multi_sphere(scanner, poses, circles, replace(made, centres=2.5 * made.centres))


@pytest.mark.parametrize(
    ("centres", "error", "words"),
    [
        (np.zeros((3, 3)) + np.arange(3)[:, None] * 9, InputError, "at least 4"),
        (np.outer(np.arange(5.0), [9.0, 0, 0]), NotObservableError, "in a line"),
        (0.001 * standard(5).centres, InputError, "in mm"),
        (np.full((5, 3), np.nan), InputError, "finite"),
    ],
)
def test_a_standard_that_cannot_be_is_refused(centres, error, words):
    with pytest.raises(error, match=words):
        tp.SphereStandard(
            names=tuple(map(str, range(len(centres)))), centres=centres, diameters=np.full(len(centres), 3.0)
        )


def test_the_certificate_is_read_back_with_its_uncertainty(tmp_path):
    tp.write_standard(tmp_path / "standard.csv", standard())
    assert tp.read_standard(tmp_path / "standard.csv") == standard()
    (tmp_path / "one.csv").write_text(
        "# sigma_mm: 0.0004\nsphere;x_mm;y_mm;z_mm;diameter_mm\nA;0;0;0;3\nB;10;0;1;3\nC;0;11;2;3\nD;4;5;20;3\n"
    )
    read = tp.read_standard(tmp_path / "one.csv")
    assert read.names == ("A", "B", "C", "D")
    np.testing.assert_array_equal(read.sigma_mm, 0.0004)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ball,x_mm,y_mm,z_mm\nA,0,0,0\n", "diameter_mm are missing"),
        ("ball,x_mm,y_mm,z_mm,d_mm\nA,0,0,0,3\n", "'d_mm' is unknown"),
        ("ball,x_mm,y_mm,z_mm,diameter_mm\nA,0,0,zero,3\n", "row 1"),
    ],
)
def test_a_certificate_with_a_fault_names_it(tmp_path, text, words):
    (tmp_path / "standard.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        tp.read_standard(tmp_path / "standard.csv")
