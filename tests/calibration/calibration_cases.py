"""Pose plans and simulated centres that the calibration tests share."""

from __future__ import annotations

import numpy as np

from tomopose import RigidTransform, Scanner
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

SIGMA = 0.0146
"""px a coordinate: 0.0207 px of d_rms."""

BALL = np.array([8.0, -6.0, 17.0])
MOUNT = RigidTransform.from_angles([0.007, -0.005, 3.126], [2.0, -1.5, 1.0], source=Frame.H, target=Frame.T)
SCANNER = Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.21, u_0=1021.37, v_0=996.81, n_u=2048, n_v=1999).exact()
SINGLE_AXIS = np.array([[0, 0, 0], [5, 0, 0], [-5, 0, 0], [0, 5, 0], [0, -5, 0], [0, 0, 5], [0, 0, -5.0]])


def paper_poses(n: int = 3, **columns: object) -> PoseSequence:
    """The paper's grid: single-axis rotations, table still."""
    g = np.linspace(-10, 10, n)
    positions = np.stack(np.meshgrid(g, g, g, indexing="ij"), axis=-1).reshape(-1, 3)
    return PoseSequence.from_table(
        np.repeat(positions, 7, axis=0), np.tile(SINGLE_AXIS, (len(positions), 1)), **columns
    )


def mixed_poses(
    seed: int = 1, n: int = 60, alphas: tuple[float, ...] = (0, 90, 180, 270), **columns: object
) -> PoseSequence:
    """Compound rotations and table angles."""
    rng = np.random.default_rng(seed)
    return PoseSequence.from_table(
        rng.uniform(-10, 10, (n, 3)), rng.uniform(-5, 5, (n, 3)), alpha=np.radians(rng.choice(alphas, n)), **columns
    )


def observe(
    poses: PoseSequence,
    *,
    scanner: Scanner = SCANNER,
    T_HT: RigidTransform = MOUNT,
    t: object = BALL,
    sigma: float = SIGMA,
    seed: int | None = 5,
) -> BallObservations:
    """Centres with white noise; exact where the seed is None."""
    x = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t, alpha=poses.alpha)
    if seed is not None:
        x = x + np.random.default_rng(seed).normal(0, sigma, x.shape)
    return BallObservations.from_sigma(x, sigma, pose_id=poses.pose_id)
