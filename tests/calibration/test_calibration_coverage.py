"""Stated regions hold the truth as often as they say: 1,000 seeded runs for parameters, pixels and lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration_cases import BALL, MOUNT, SCANNER, mixed_poses, observe, paper_poses
from scipy.special import chdtri

from tomopose import RigidTransform
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import pair
from tomopose.calibration.rigid.fit import Fit, blocks, minimise
from tomopose.calibration.rigid.pose_noise import PoseNoise, total_covariance
from tomopose.calibration.solve import calibrate
from tomopose.calibration.uncertainty.monte_carlo import draw, monte_carlo
from tomopose.calibration.uncertainty.propagation import length_sigma, matrix_point_jacobian, object_sigma
from tomopose.geometry.projection import eq5_matrices, project
from tomopose.geometry.rotations import exp_rotation
from tomopose.least_squares import Status

RUNS = 1000
LOW, HIGH = 0.93, 0.97
NOISE = PoseNoise(translation=5e-4, rotation=12e-6)


def truth_of(free):
    return Fit(
        R_HT=MOUNT.R,
        t_HT=MOUNT.t,
        t=BALL[None],
        delta=np.zeros(len(free)),
        chi2=0.0,
        status=Status.CONVERGED,
        N=np.zeros((0, 0)),
    )


def region_share(errors, C):
    q = np.einsum("bi,ij,bj->b", errors, np.linalg.inv(C), errors)
    return np.mean(q < chdtri(C.shape[0], 0.05))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("poses", "priors", "noise"),
    [
        (paper_poses(2), {}, None),
        (mixed_poses(n=40), {}, None),
        (mixed_poses(n=40), {"d_SR": 0.05, "u_0": 0.5, "eta": 1e-3, "pitch_ratio": 1e-3}, None),
        (paper_poses(2), {"d_SR": 0.05, "v_0": 0.5}, None),
        (mixed_poses(n=40), {}, NOISE),
    ],
    ids=["paper", "mixed", "mixed-free", "paper-prior", "pose-noise"],
)
def test_parameters(poses, priors, noise):
    problem = pair(SCANNER, poses, observe(poses, seed=None))
    free = free_parameters((SCANNER,), priors=priors)
    truth = truth_of(free)
    mc = draw(problem, free, truth, RUNS, seed=3, noise=noise)
    assert mc.converged.all()
    at = blocks(problem, free, truth)
    weighted = problem if noise is None else problem.with_covariance(total_covariance(problem.covariance, at, noise))
    C = inverse_information(minimise(weighted, free, truth).N)
    assert LOW <= region_share(mc.errors, C) <= HIGH
    inside = np.abs(mc.errors) < 1.96 * np.sqrt(np.diag(C))
    assert LOW - 0.01 <= inside.mean() <= HIGH + 0.01
    interval = mc.shortest_interval(0.95)
    np.testing.assert_allclose(interval[:, 1] - interval[:, 0], 3.92 * np.sqrt(np.diag(C)), rtol=0.15)


@pytest.mark.slow
def test_pixels_and_lengths():
    poses = paper_poses(2)
    cal = calibrate(SCANNER, poses, observe(poses), hypotheses=False)
    mc = monte_carlo(cal, SCANNER, poses, observe(poses), draws=RUNS, seed=8)
    scan = mixed_poses(seed=4, n=12)
    x = np.array([[15.0, -12, 20], [-14.0, 10, -25], [3.0, 8, 2], [-9.0, -15, 11]])
    J = matrix_point_jacobian(cal, scan, x)
    sigma = np.sqrt(np.einsum("nmic,cd,nmid->nmi", J, cal.covariance, J))
    P_0 = eq5_matrices(SCANNER, T_HT=cal.T_HT, T_MH=scan.T_MH, alpha=scan.alpha)
    at = project(P_0, x)
    h = np.einsum("nij,mj->nmi", P_0[:, :, :3], x) + P_0[:, None, :, 3]
    G = (P_0[:, None, :2, :3] - (h[..., :2] / h[..., 2:])[..., None] * P_0[:, None, 2:, :3]) / h[..., 2:, None]
    N = np.einsum("nmia,nmib->mab", G, G)
    along = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
    pixels, lengths, points = [], [], []
    for e in mc.errors:
        moved = RigidTransform(
            R=exp_rotation(e[:3]) @ cal.T_HT.R, t=cal.T_HT.t + e[3:6], source=cal.T_HT.source, target=cal.T_HT.target
        )
        d = project(eq5_matrices(SCANNER, T_HT=moved, T_MH=scan.T_MH, alpha=scan.alpha), x) - at
        pixels.append(np.abs(d) < 1.96 * sigma)
        # where the points are reconstructed with the wrong matrices
        dx = -np.linalg.solve(N, np.einsum("nmia,nmi->ma", G, d)[:, :, None])[..., 0]
        points.append(dx)
        lengths.append((dx[1] - dx[0]) @ along)
    share = np.mean(pixels, axis=0)
    assert LOW <= share.mean() <= HIGH
    assert share.min() > LOW - 0.01
    # the draws know nothing of what no ball shows, which lengths carry too
    u_length = length_sigma(replace(cal, unseen=None), scan, x[:1], x[1:2])[0]
    assert length_sigma(cal, scan, x[:1], x[1:2])[0] > u_length
    assert LOW <= np.mean(np.abs(lengths) < 1.96 * u_length) <= HIGH
    np.testing.assert_allclose(np.std(points, axis=0), object_sigma(cal, scan, x), rtol=0.1)


@pytest.mark.slow
def test_widening_keeps_coverage_when_sigmas_are_too_small():
    """Stated sigmas of half the truth: chi2/dof is 4, and the widened region still holds."""
    poses = paper_poses(2)
    inside = []
    for seed in range(150):
        cal = calibrate(SCANNER, poses, _understated(poses, seed), hypotheses=False, robust=False, pose_noise=None)
        e = np.concatenate([MOUNT.t - cal.T_HT.t, BALL - cal.t])
        C = cal.covariance[3:, 3:]
        inside.append(e @ np.linalg.solve(C, e) < chdtri(6, 0.05))
    assert 0.89 <= np.mean(inside) <= 0.99  # 150 runs: 95 % +- 3.5 standard deviations


def _understated(poses, seed):
    from tomopose.observations import BallObservations

    observed = observe(poses, sigma=0.03, seed=seed)
    return BallObservations.from_sigma(observed.x_D, 0.015, pose_id=poses.pose_id)


@pytest.mark.slow
def test_draws_repeat_and_do_not_depend_on_threads():
    import numba

    poses = mixed_poses(n=30)
    problem = pair(SCANNER, poses, observe(poses))
    free = free_parameters((SCANNER,))
    first = draw(problem, free, truth_of(free), 50, seed=2)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        second = draw(problem, free, truth_of(free), 50, seed=2)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(first.errors, second.errors)
