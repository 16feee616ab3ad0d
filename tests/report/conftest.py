"""A calibration that is known in every number, so that a report of it can be checked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tomopose import BallObservations, Calibration, PoseSequence, ProjectionMatrices, RigidTransform, Scanner
from tomopose.calibration.checks.conventions.hypothesis import Hypothesis
from tomopose.calibration.checks.verdict import Finding
from tomopose.calibration.result import Observability, Parameter
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, project_ball
from tomopose.geometry.rotations import exp_rotation
from tomopose.provenance import provenance

T_BALL = np.array([3.0, -2.0, 21.0])
NOISE_PX = 0.02


def grid_poses(turns_of_table: tuple[float, ...] = (0.0,)) -> PoseSequence:
    """A 3 x 3 x 3 grid of positions with the paper's seven rotations, at each table angle."""
    steps = (-10.0, 0.0, 10.0)
    rotations = [np.zeros(3)] + [s * 5.0 * np.eye(3)[k] for k in range(3) for s in (1, -1)]
    rows = [((x, y, z), r, a) for a in turns_of_table for x in steps for y in steps for z in steps for r in rotations]
    return PoseSequence.from_table(
        [p for p, _, _ in rows],
        np.array([r for _, r, _ in rows]),
        alpha=np.array([a for _, _, a in rows]),
        pose_id=[f"p{k:03d}" for k in range(len(rows))],
    )


def predicted(scanner: Scanner, T_HT: RigidTransform, poses: PoseSequence, delta: np.ndarray) -> np.ndarray:
    moved = RigidTransform(R=exp_rotation(delta[:3]) @ T_HT.R, t=T_HT.t + delta[3:6], source=Frame.H, target=Frame.T)
    return project_ball(scanner, T_HT=moved, T_MH=poses.T_MH, t=T_BALL + delta[6:], alpha=poses.alpha)


def hypothesis(name: str, words: str, cure: str, d_rms: float, delta: float, outcome: str) -> Hypothesis:
    return Hypothesis(
        name=name,
        words=words,
        remedy=cure,
        sigmas=1.2,
        d_rms=d_rms,
        chi2=100.0,
        dof=90,
        delta=delta,
        factor=1.0,
        outcome=outcome,
    )


@pytest.fixture(scope="module")
def sample() -> Callable[..., tuple[Calibration, BallObservations, PoseSequence]]:
    """Makes a calibration at the truth with white noise as its residuals, and what it came from."""

    def make(
        *, turns: tuple[float, ...] = (0.0, np.pi / 2), verdict: str = "trustworthy", outliers: int = 2
    ) -> tuple[Calibration, BallObservations, PoseSequence]:
        scanner = Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.21, u_0=1021.4, v_0=980.8, n_u=2049, n_v=1953).exact()
        T_HT = RigidTransform.from_angles([0.02, -0.03, 3.05], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T)
        poses = grid_poses(turns)
        exact = predicted(scanner, T_HT, poses, np.zeros(9))
        noise = np.random.default_rng(20231028).normal(scale=NOISE_PX, size=exact.shape)
        seen = np.ones(len(poses), dtype=bool)
        seen[-outliers:] = outliers == 0
        observations = BallObservations.from_sigma(
            exact + noise,
            NOISE_PX,
            pose_id=poses.pose_id,
            seen=seen,
            status=["ok" if s else "ball truncated by the image border" for s in seen],
            snr=np.full(len(poses), 180.0),
            semi_major=np.full(len(poses), 108.0),
            semi_minor=np.full(len(poses), 105.5),
            angle=np.zeros(len(poses)),
            x_ellipse=exact + noise + 0.05,
        )
        step = 1e-5
        J = np.stack(
            [(predicted(scanner, T_HT, poses, step * e) - exact)[seen].ravel() / step for e in np.eye(9)], axis=1
        )
        covariance = np.linalg.inv(J.T @ J) * NOISE_PX**2
        u = np.sqrt(np.diag(covariance))
        names = ("phi_HT_x", "phi_HT_y", "phi_HT_z", "t_HT_x", "t_HT_y", "t_HT_z", "t_x", "t_y", "t_z")
        values = (*T_HT.angles, *T_HT.t, *T_BALL)
        calibration = Calibration(
            scanner=scanner,
            T_HT=T_HT,
            balls={0: T_BALL},
            tangent=("w_HT_x", "w_HT_y", "w_HT_z", *names[3:]),
            covariance=covariance,
            pose_id=tuple(p for p, s in zip(poses.pose_id, seen, strict=True) if s),
            x_D=(exact + noise)[seen],
            residuals=noise[seen],
            chi2=float((noise[seen] ** 2).sum() / NOISE_PX**2),
            dof=2 * int(seen.sum()) - 9,
            parameters=tuple(
                Parameter(name=n, value=float(v), u=float(s), unit="rad" if n.startswith("phi") else "mm")
                for n, v, s in zip(names, values, u, strict=True)
            ),
            observability=Observability(
                singular_values=np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False),
                unobservable=() if len(turns) > 1 else ("t_HT,x and d_SR are exactly degenerate",),
                notes=() if len(turns) > 1 else ("add poses at another table angle",),
            ),
            outliers={
                p: "residual beyond what a clean run allows: 41.2 standard deviations"
                for p, s in zip(poses.pose_id, seen, strict=True)
                if not s
            },
            status="optimum reached",
            checks=tuple(
                Finding(rule=f"rule {k}", value=float(k), limit=1.0, words=words, verdict=verdict)
                for k, words in enumerate(
                    ("the residuals are explained by the stated detection noise", "a closing pose would help")
                )
            ),
            hypotheses=(
                hypothesis("declared", "the data as declared", "", 0.0283, 0.0, "declared"),
                hypothesis("zyx", "order R_z R_y R_x", "# convention: symetrie-hexapod", 0.0283, 0.4, "same"),
                hypothesis("rows", "image rows flipped", "image_rows: bottom-first", 4.61, 9.1e6, "worse"),
            ),
            pivot=np.array([0.0, 0.0, 200.0]),
            provenance=provenance(arguments={"model": "rigid"}, seed=20231028),
        )
        return calibration, observations, poses

    return make


@pytest.fixture(scope="module")
def scan(sample: Callable[..., tuple[Calibration, BallObservations, PoseSequence]]) -> ProjectionMatrices:
    """A tilted scan of 90 views, with predicted uncertainties of five points."""
    calibration, _, _ = sample()
    alpha = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    angles = np.column_stack([4.0 * np.cos(7 * alpha), 4.0 * np.sin(7 * alpha), np.zeros(90)])
    poses = PoseSequence.from_table(np.zeros((90, 3)), angles, alpha=alpha)
    P = eq5_matrices(calibration.scanner, T_HT=calibration.T_HT, T_MH=poses.T_MH, alpha=alpha)
    s = calibration.scanner
    sigma = 0.002 + 0.001 * np.abs(np.sin(alpha))[:, None] * np.linspace(0.2, 1.0, 5)
    return ProjectionMatrices(
        P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=poses.pose_id, points_sigma=sigma, scanner=s
    )
