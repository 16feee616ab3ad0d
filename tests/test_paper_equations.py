"""Each numbered equation of the paper, typed again from the paper without the code's help."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tomopose import BallObservations, PoseSequence, RigidTransform, Scanner, calibrate
from tomopose.calibration.records.truth import d_rms_exact
from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, project_ball
from tomopose.geometry.rotations import R_x, R_y, R_z, angles_from_rotation, rotation_from_angles

PIXEL = 1e-9


def homogeneous(R, t):
    return np.block([[np.asarray(R), np.reshape(t, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


def basic_rotations(a, b, c):
    R1 = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    R2 = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    R3 = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return R1, R2, R3


def printed_T_WS(d_SR):
    return np.array([[0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, d_SR], [0, 0, 0, 1.0]])


def printed_P_S(s):
    return np.array([[-s.d_SD / s.p_u, 0, s.u_0, 0], [0, s.d_SD / s.p_v, s.v_0, 0], [0, 0, 1, 0]])


def random_poses(rng, n=7):
    return rng.uniform(-9, 9, (n, 3)), rng.uniform(-8, 8, (n, 3))


def test_eq_1_transform_and_its_inverse(rng):
    angles, t, x = rng.uniform(-1, 1, 3), rng.normal(size=3), rng.normal(size=3)
    T = RigidTransform.from_angles(angles, t, source=Frame.M, target=Frame.H)
    R1, R2, R3 = basic_rotations(*angles)
    assert_allclose(T.matrix, homogeneous(R1 @ R2 @ R3, t), atol=1e-15)
    assert_allclose(np.append(T.apply(x), 1), homogeneous(R1 @ R2 @ R3, t) @ np.append(x, 1), atol=1e-14)
    assert_allclose(T.inv.matrix, homogeneous(T.R.T, -T.R.T @ t), atol=1e-15)


def test_eq_2_intrinsic_projection(scanner):
    assert_allclose(scanner.P_S, printed_P_S(scanner), rtol=1e-15)
    assert_allclose(scanner.K, printed_P_S(scanner)[:, :3], rtol=1e-15)


def test_eq_3_chain_from_moved_plate_to_detector(scanner, T_HT, rng):
    positions, angles = random_poses(rng)
    alpha = rng.uniform(-np.pi, np.pi, len(positions))
    poses = PoseSequence.from_table(positions, angles, alpha=alpha)
    x_M = rng.uniform(-12, 12, 3)
    measured = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=x_M, alpha=alpha)
    for k in range(len(positions)):
        R1, R2, R3 = basic_rotations(*np.radians(angles[k]))
        T_MH = homogeneous(R1 @ R2 @ R3, positions[k])
        T_TW = homogeneous(basic_rotations(0, 0, alpha[k])[2], np.zeros(3))
        h = printed_P_S(scanner) @ printed_T_WS(scanner.d_SR) @ T_TW @ T_HT.matrix @ T_MH @ np.append(x_M, 1)
        assert_allclose(measured[k], h[:2] / h[2], atol=PIXEL)


def test_eq_4_world_to_source(scanner):
    assert_allclose(scanner.T_WS.matrix, printed_T_WS(scanner.d_SR), atol=0)


def test_eq_5_projection_matrices_of_a_scan(scanner, T_HT, rng):
    positions, angles = random_poses(rng)
    alpha = rng.uniform(-np.pi, np.pi, len(positions))
    poses = PoseSequence.from_table(positions, angles, alpha=alpha)
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=alpha)
    for j in range(len(positions)):
        R1, R2, R3 = basic_rotations(*np.radians(angles[j]))
        T_TW = homogeneous(basic_rotations(0, 0, alpha[j])[2], np.zeros(3))
        printed = (
            printed_P_S(scanner)
            @ printed_T_WS(scanner.d_SR)
            @ T_TW
            @ T_HT.matrix
            @ homogeneous(R1 @ R2 @ R3, positions[j])
            @ np.linalg.inv(T_HT.matrix)
        )
        assert_allclose(P[j], printed, atol=1e-9)
    assert_allclose(np.linalg.norm(P[:, 2, :3], axis=1), 1, atol=1e-14)
    assert (P[:, 2, 3] > 0).all()
    assert (np.linalg.det(P[:, :, :3]) < 0).all()


def test_eq_6_is_eq_3_with_the_table_at_zero(scanner, T_HT, rng):
    positions, angles = random_poses(rng)
    poses = PoseSequence.from_table(positions, angles)
    t = rng.uniform(-10, 10, 3)
    calculated = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t)
    for k in range(len(positions)):
        R1, R2, R3 = basic_rotations(*np.radians(angles[k]))
        h = (
            printed_P_S(scanner)
            @ printed_T_WS(scanner.d_SR)
            @ T_HT.matrix
            @ homogeneous(R1 @ R2 @ R3, positions[k])
            @ np.append(t, 1)
        )
        assert_allclose(calculated[k], h[:2] / h[2], atol=PIXEL)


def test_eq_5_sees_the_ball_where_eq_6_sees_it(scanner, T_HT, rng):
    positions, angles = random_poses(rng)
    poses = PoseSequence.from_table(positions, angles)
    t = rng.uniform(-10, 10, 3)
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH)
    h = P @ np.append(T_HT.apply(t), 1)
    assert_allclose(h[:, :2] / h[:, 2:], project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t), atol=PIXEL)


def test_eq_8_divides_by_the_number_of_poses(scanner, T_HT, rng):
    positions, angles = random_poses(rng, 20)
    poses = PoseSequence.from_table(positions, angles)
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=[3.0, -2.0, 8.0]) + rng.normal(scale=0.02, size=(20, 2))
    calibration = calibrate(scanner, poses, BallObservations.from_sigma(x_D, 0.02), hypotheses=False)
    calculated = project_ball(calibration.scanner, T_HT=calibration.T_HT, T_MH=poses.T_MH, t=calibration.t)
    d = np.sqrt(((x_D - calculated) ** 2).sum(axis=1))
    assert_allclose(calibration.d, d, atol=1e-9)
    assert_allclose(calibration.d_rms, np.sqrt((d**2).sum() / 20), rtol=1e-9)


def test_eq_9_uses_the_exact_parameters(scanner, T_HT, rng):
    positions, angles = random_poses(rng, 20)
    poses = PoseSequence.from_table(positions, angles)
    t = np.array([3.0, -2.0, 8.0])
    error = rng.normal(scale=0.02, size=(20, 2))
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t) + error
    order = rng.permutation(20)
    observations = BallObservations.from_sigma(x_D[order], 0.02, pose_id=order)
    expected = np.sqrt((error**2).sum() / 20)
    assert_allclose(d_rms_exact(scanner, poses, observations, T_HT=T_HT, t=t), expected, rtol=1e-9)
    assert_allclose(d_rms_exact(scanner, poses, observations, T_HT=T_HT, t={0: t}), expected, rtol=1e-9)
    with pytest.raises(InputError, match="ball 0"):
        d_rms_exact(scanner, poses, observations, T_HT=T_HT, t={1: t})


def test_appendix_product_and_angle_extraction(rng):
    for a, b, c in rng.uniform(-1.5, 1.5, (50, 3)):
        R1, R2, R3 = basic_rotations(a, b, c)
        assert_allclose(R_x(a), R1, atol=0)
        assert_allclose(R_y(b), R2, atol=0)
        assert_allclose(R_z(c), R3, atol=0)
        R = rotation_from_angles(np.array([a, b, c]))
        s_a, c_a, s_b, c_b, s_c, c_c = np.sin(a), np.cos(a), np.sin(b), np.cos(b), np.sin(c), np.cos(c)
        printed = np.array(
            [
                [c_b * c_c, -c_b * s_c, s_b],
                [c_a * s_c + s_a * s_b * c_c, c_a * c_c - s_a * s_b * s_c, -s_a * c_b],
                [s_a * s_c - c_a * s_b * c_c, c_a * s_b * s_c + s_a * c_c, c_a * c_b],
            ]
        )
        assert_allclose(R, printed, atol=1e-15)
        beta = np.arcsin(R[0, 2])
        gamma = np.arctan2(-R[0, 1] / np.cos(beta), R[0, 0] / np.cos(beta))
        alpha = np.arctan2(-R[1, 2] / np.cos(beta), R[2, 2] / np.cos(beta))
        assert_allclose(angles_from_rotation(R), [alpha, beta, gamma], atol=1e-12)


def test_magnification_of_the_papers_setup():
    s = Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=1021.37, v_0=1026.81, n_u=2048, n_v=2048)
    assert_allclose(s.magnification, 1500.0 / 283.5)
    # Table 3: 75.6 um voxels at M 5.3 with 2 x 2 binning are one binned pixel at the object.
    assert_allclose(s.binned(2).p_u / s.magnification * 1000, 75.6, rtol=1e-12)
