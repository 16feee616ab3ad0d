"""Virtual twin robots: one carries the source, the other the detector, about a fixed ball and object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose import BallObservations, Calibration, Frame, PoseSequence, RigidTransform, Scanner
from tomopose.calibration.arrangements.twin_robots import twin_matrices
from tomopose.calibration.model.twin_projection import twin_blocks, twin_view_matrices
from tomopose.calibration.uncertainty.trajectory import object_points, rms_px
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.geometry.transforms import moved
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.serial import SerialRobot, poses_from_joints
from tomopose.manipulator.twin import TwinRobots

SCANNER = Scanner(d_SD=700.0, d_SR=320.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203).exact()
"""Non-square pixels, off-centre piercing point."""
SIGMA_PX = 0.0207 / np.sqrt(2)
BALL = np.array([6.0, -5.0, 7.0])
"""Of the ball from the middle of the object, mm, in the detector robot's base."""
WORK = np.array([0.2, 20.0, 10.0, 5.0, 55.0, 10.0]) * np.radians(1.0)


@dataclass(frozen=True, kw_only=True)
class TwinExperiment:
    """What a calibration needs and what is true.  mount, ball: starts, some mm and a degree off.  P_true (n, 3, 4):
    points of M to pixels, for the scan; middle (3,): of the object in M."""

    scanner: Scanner
    twin: TwinRobots
    poses: PoseSequence
    observations: BallObservations
    mount: RigidTransform
    ball: Any
    scan: PoseSequence
    scan_source: PoseSequence
    P_true: Any
    middle: Any


def _round(robot: SerialRobot, turn: Any, middle: Any, R: Any, x: Any, arm: Any, off: Any) -> PoseSequence:
    """The table in which the point `arm` of the flange goes round the middle by turn (k, 3, 3) from x, with the
    flange's orientation R (k, 3, 3), and strays by off (k, 6)."""
    R, x = moved(R, np.einsum("kij,j->ki", turn, x - middle) + middle, off)
    T = RigidTransform(R=R, t=x - R @ arm, source=Frame.M, target=Frame.H)
    return poses_from_joints(robot, robot.inverse(T, q_start=WORK))


def _executed(robot: SerialRobot, table: PoseSequence, p: Any, rng: np.random.Generator) -> PoseSequence:
    """Where the flange of a robot with errors p really is, with its repeatability."""
    real = robot.real_poses(table, p)
    R, t = moved(real.R, real.t, rng.standard_normal((len(table), 6)) * np.sqrt(robot.repeatability.variance))
    return replace(table, T_MH=RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H), q=None)


def twin_experiment(
    robot: SerialRobot, seed: int, *, n: int = 200, views: int = 60, size: float = 1.0
) -> TwinExperiment:
    """Two such robots with errors `size` times their standard deviations: n views in which both go round the ball by
    up to 25 deg and stray by 15 mm and 3 deg, then a scan over 50 deg in which the source stays before the panel."""
    rng = np.random.default_rng(np.random.SeedSequence([10, seed]))
    T_HT = RigidTransform.from_angles([0.1, 1.3, -0.2], [30.0, -400.0, 60.0], source=Frame.H, target=Frame.T)
    to_S = SCANNER.T_WS @ SCANNER.T_TW(0.0) @ T_HT
    at_work = robot.forward(WORK[None])[0]
    middle, spot = (at_work.apply(T.inv.apply(np.zeros((1, 3))))[0] for T in (T_HT, to_S))
    focus, R_AB = np.array([5.0, -8.0, 120.0]), R_z(2.7) @ R_x(0.03)
    base = RigidTransform(R=R_AB, t=spot - R_AB @ at_work.apply(focus[None])[0], source=Frame.H, target=Frame.H)

    def tables(turn: Any, stray: float) -> tuple[PoseSequence, PoseSequence]:
        size = np.repeat([np.radians(stray / 5), stray], 3)
        off = rng.uniform(-1.0, 1.0, (2, len(turn), 6)) * size
        panel = _round(robot, turn, middle, turn @ at_work.R, at_work.t, np.zeros(3), off[0])
        # in the base of the source's robot; its flange keeps its orientation
        here = base.inv.apply(np.stack([middle, spot]))
        still = np.tile(at_work.R, (len(turn), 1, 1))
        tube = _round(robot, R_AB.T @ turn @ R_AB, here[0], still, here[1], focus, off[1])
        return panel, tube

    poses, source = tables(R_z(rng.uniform(-0.43, 0.43, n)) @ R_y(rng.uniform(-0.15, 0.15, n)), 15.0)
    sweep = np.linspace(-0.43, 0.43, views)
    scan, scan_source = tables(R_z(sweep) @ R_y(0.1 * np.sin(14 * sweep)), 0.0)
    p, p_source = size * rng.standard_normal((2, len(robot.names))) * robot.sigma
    setup = rng.standard_normal(9) * np.repeat([0.004, 3.0, 1.0], 3)
    twin = TwinRobots(detector=robot, source=robot, source_poses=source, base=base, focus=focus)
    x = twin_blocks(
        SCANNER,
        replace(twin.trusted(), source_poses=_executed(robot, source, p_source, rng)),
        T_HT=T_HT,
        poses=inverse_poses(_executed(robot, poses, p, rng)),
        p=setup,
        t=np.tile(middle + BALL, (n, 1)),
    ).x_D
    x = x + SIGMA_PX * rng.standard_normal((n, 2))
    return TwinExperiment(
        scanner=SCANNER,
        twin=twin,
        poses=poses,
        observations=BallObservations.from_sigma(x, SIGMA_PX, pose_id=poses.pose_id),
        mount=RigidTransform.from_angles(
            T_HT.angles + 0.01 * rng.standard_normal(3),
            T_HT.t + 4 * rng.standard_normal(3),
            source=Frame.H,
            target=Frame.T,
        ),
        ball=middle + BALL + 3 * rng.standard_normal(3),
        scan=scan,
        scan_source=scan_source,
        P_true=twin_view_matrices(
            SCANNER,
            replace(twin, source_poses=scan_source),
            T_HT=T_HT,
            poses=inverse_poses(scan),
            p=np.concatenate([p, p_source, setup]),
        ),
        middle=middle,
    )


def twin_scan_error(calibration: Calibration, e: TwinExperiment) -> tuple[float, float]:
    """(error, stated), px rms, of the scan at the corners of +-15, +-15, +-30 mm, the object's rigid pose removed."""
    x_M = e.middle + object_points()
    # any rigid frame near that of the calibration serves, since the object's pose is removed
    first = e.mount @ inverse_poses(e.scan).T_MH[0]
    to_W = SCANNER.T_TW(0.0) @ first
    x_W = to_W.apply(x_M)
    found = twin_matrices(calibration, e.scan, e.scan_source, points=x_W)
    d = without_object_pose(found.P, e.P_true @ np.linalg.inv(to_W.matrix), x_W)
    assert found.points_sigma_shared is not None
    return rms_px(d), float(np.sqrt(2 * np.mean(found.points_sigma_shared**2)))
