"""Virtual experiments: a machine with known errors, radiographs of balls, and how far the scan's matrices are off."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose import BallObservations, Calibration, Frame, PoseSequence, RigidTransform, Scanner
from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.solve import calibrate
from tomopose.calibration.uncertainty.trajectory import (
    object_points,
    rms_px,
    trajectory_sigma,
)
from tomopose.geometry.object_pose import point_jacobian, without_object_pose
from tomopose.geometry.projection import eq5_matrices, project_ball
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.manipulator.real_poses import Repeatability
from tomopose.manipulator.serial import poses_from_joints
from tomopose.manipulator.virtual import Disturbance, real_motion

SCANNER = Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=1021.37, v_0=1026.81, n_u=2048, n_v=2048).exact()
"""Magnification 5.3 of the paper."""
DETECTION_PX = 0.0207
"""rms distance of detected centres from the true ones, table 1: both coordinates together."""
ROBOT_OBJECT = np.array([0.0, 0.0, 60.0])
ROBOT_BALLS = ROBOT_OBJECT + np.array([[12.0, -14.0, 10.0], [-10.0, 12.0, -15.0]])
X_WORK, R_WORK = np.array([480.0, 30.0, 300.0]), np.diag([1.0, -1.0, -1.0])
"""Where a robot holds the middle of the object, in its base, mm, flange downwards."""
Q_WORK = np.radians([5.0, 30.0, 20.0, 0.0, 40.0, 0.0])
UM_PER_PX = 200.0 / SCANNER.magnification


def paper_poses() -> PoseSequence:
    """The paper's 3 x 3 x 3 x 7 poses, table still (sec. 5)."""
    grid = np.array(np.meshgrid([-10, 0, 10], [-10, 0, 10], [-10, 0, 10], indexing="ij")).reshape(3, -1).T
    turns = 5.0 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    return PoseSequence.from_table(np.repeat(grid, 7, axis=0), np.tile(turns, (27, 1)))


def mixed_poses(rng: np.random.Generator, *, n: int = 189, balls: int = 1) -> PoseSequence:
    """Any positions and tilts within the same travel, at table angles 0, 90, 180, 270 deg; balls by turns."""
    return PoseSequence.from_table(
        rng.uniform(-10, 10, (n, 3)),
        rng.uniform(-5, 5, (n, 3)),
        alpha=np.radians(90.0 * (np.arange(n) * 4 // n)),
        ball_id=np.arange(n) % balls,
    )


def tilted_scan(T_HT: RigidTransform, *, n: int = 180, wide: bool = False) -> PoseSequence:
    """The paper's 3D scans, eq. (10): 1 deg + 4 deg sin 7 alpha; wide: the triangle wave of eq. (11), 8 deg, beyond the
    calibrated 5 deg."""
    alpha = np.arange(n) * 2 * np.pi / n
    tilt = np.radians(1 + 4 * np.sin(7 * alpha))
    if wide:
        tilt = 28 / 45 * np.abs((alpha + np.pi / 14) % (2 * np.pi / 7) - np.pi / 7) - 2 * np.pi / 45
    turn = R_z(alpha)
    R = T_HT.R.T @ np.swapaxes(turn, 1, 2) @ R_y(tilt) @ turn @ T_HT.R
    return PoseSequence(
        T_MH=RigidTransform(R=R, t=np.zeros((n, 3)), source=Frame.M, target=Frame.H),
        pose_id=tuple(str(k) for k in range(n)),
        alpha=alpha,
    )


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """What a run needs and what is true: machine as it is believed, poses, observations, scan and its true matrices.

    P_true: of the cool machine that does not scatter; P_executed: of the scan as it was run, with scatter, and
    warming up as in the calibration.
    """

    machine: Any
    poses: PoseSequence
    observations: BallObservations
    scan: PoseSequence
    P_true: Any
    P_executed: Any
    points: Any
    scanner: Scanner


def experiment(
    machine: Any,
    p: Any,
    poses: PoseSequence,
    scan: PoseSequence,
    *,
    T_HT: RigidTransform,
    balls: Any,
    rng: np.random.Generator,
    believed: Any = None,
    disturbance: Disturbance | None = None,
    scanner: Scanner = SCANNER,
    centre: Any = None,
) -> Experiment:
    """Image the balls on the real machine, which then executes the scan.

    centre: middle of the object in M, mm, where it is not what is at the W origin at home (a robot's flange).
    """
    disturbance = disturbance or Disturbance()
    real = real_motion(machine, poses, p, disturbance=disturbance, rng=rng)
    x = project_ball(
        scanner, T_HT=T_HT, T_MH=real.T_MH, t=np.asarray(balls)[np.asarray(poses.ball_id)], alpha=poses.alpha
    )
    sigma = DETECTION_PX / np.sqrt(2)
    observations = BallObservations.from_sigma(x + sigma * rng.standard_normal(x.shape), sigma, pose_id=poses.pose_id)
    # wear stays, warmth and scatter belong to the run
    still = replace(
        disturbance, growth_mm=(0.0, 0.0, 0.0), growth_rad=(0.0, 0.0, 0.0), scatter=Repeatability(t_mm=0.0, w_rad=0.0)
    )
    matrices = [
        eq5_matrices(
            scanner, T_HT=T_HT, T_MH=real_motion(machine, scan, p, disturbance=d, rng=rng).T_MH, alpha=scan.alpha
        )
        for d in (still, disturbance)
    ]
    home = scanner.T_TW(0.0) @ T_HT
    return Experiment(
        machine=machine if believed is None else believed,
        poses=poses,
        observations=observations,
        scan=scan,
        P_true=matrices[0],
        P_executed=matrices[1],
        points=object_points() if centre is None else home.apply(np.asarray(centre) + object_points()),
        scanner=scanner,
    )


def hexapod_experiment(
    machine: Any,
    kind: str,
    seed: int,
    *,
    size: float = 1.0,
    balls: int = 1,
    geometry: float = 1.0,
    disturbance: Disturbance | None = None,
    wide: bool = False,
) -> Experiment:
    """kind: "paper" or "mixed"; geometry: factor on the file's joints; size: factor on the joint errors."""
    rng = np.random.default_rng(np.random.SeedSequence([5, seed]))
    T_HT = RigidTransform.from_angles(
        np.array([0.0, 0.0, np.pi]) + 0.02 * rng.standard_normal(3),
        rng.uniform(-3, 3, 3),
        source=Frame.H,
        target=Frame.T,
    )
    exact = replace(machine, scale_sigma=0.0, geometry_sigma=0.0)  # the controller knows its own geometry
    p = size * rng.standard_normal(len(exact.names)) * exact.sigma
    poses = paper_poses() if kind == "paper" else mixed_poses(rng, balls=balls)
    centres = np.array([[12.0, -14.0, 10.0], [-10.0, 12.0, -15.0]])[:balls]
    if kind == "paper":
        centres = np.array([[3.0, -2.0, 5.0]])
    believed = replace(
        machine, base_joints=geometry * machine.base_joints, platform_joints=geometry * machine.platform_joints
    )
    return experiment(
        exact,
        p,
        poses,
        tilted_scan(T_HT, wide=wide),
        T_HT=T_HT,
        balls=centres,
        rng=rng,
        believed=believed,
        disturbance=disturbance,
    )


def robot_plan(
    robot: Any, rng: np.random.Generator, *, n: int, balls: int, spin: float, tilt: float, shift: float, table: bool
) -> PoseSequence:
    """n poses about the middle of the object: any spin and tilt (rad) and shift (mm) up to these."""
    R = R_WORK @ R_z(rng.uniform(-spin, spin, n)) @ R_y(rng.uniform(-tilt, tilt, n)) @ R_x(rng.uniform(-tilt, tilt, n))
    t = X_WORK + rng.uniform(-shift, shift, (n, 3)) - R @ ROBOT_OBJECT
    q = robot.inverse(RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H), q_start=Q_WORK)
    alpha = np.radians(90.0 * (np.arange(n) * 4 // n)) if table else np.zeros(n)
    return poses_from_joints(robot, q, ball_id=np.arange(n) % balls, alpha=alpha)


def robot_scan(robot: Any, *, n: int = 180, tilt: float = float(np.radians(8))) -> PoseSequence:
    """A turn of 332 deg by the robot itself, the table still, tilted by tilt * sin(7 angle)."""
    angle = np.linspace(-2.9, 2.9, n)
    R = R_WORK @ R_z(angle) @ R_y(tilt * np.sin(7 * angle))
    T = RigidTransform(R=R, t=X_WORK - R @ ROBOT_OBJECT, source=Frame.M, target=Frame.H)
    return poses_from_joints(robot, robot.inverse(T, q_start=Q_WORK))


def robot_experiment(
    robot: Any,
    seed: int,
    *,
    n: int = 200,
    balls: int = 1,
    table: bool = False,
    spin: float = 2.9,
    tilt_deg: float = 20.0,
    shift: float = 10.0,
) -> Experiment:
    """The object hangs on a robot's flange before the source: n poses about its middle, then a tilted turn.

    table: the robot is mounted on the rotary table, which takes four angles.
    """
    rng = np.random.default_rng(np.random.SeedSequence([6, seed]))
    p = rng.standard_normal(len(robot.names)) * robot.sigma
    # the base is behind the source; the middle of the object lies at the W origin
    T_HT = RigidTransform.from_angles([0.01, -0.02, np.pi - 0.3], np.zeros(3), source=Frame.H, target=Frame.T)
    T_HT = replace(T_HT, t=-(T_HT.R @ X_WORK))
    poses = robot_plan(
        robot, rng, n=n, balls=balls, spin=spin, tilt=float(np.radians(tilt_deg)), shift=shift, table=table
    )
    return experiment(
        robot, p, poses, robot_scan(robot), T_HT=T_HT, balls=ROBOT_BALLS[:balls], rng=rng, centre=ROBOT_OBJECT
    )


@dataclass(frozen=True, kw_only=True)
class ScanError:
    """px, rms over views and points of the distance, the object's rigid pose removed: error of the matrices (that all
    views share), what is left of it beside the scale of the object, and what is stated for it; error of the single
    views as executed and what is stated for them.
    inside: share of the single views' coordinates that 95 % of the stated uncertainty covers."""

    shared: float
    but_scale: float
    u_shared: float
    single: float
    u_single: float
    inside: float


def scan_error(calibration: Calibration, e: Experiment) -> ScanError:
    P = projection_matrices(calibration, e.scan).P
    d, d_single = (without_object_pose(P, true, e.points) for true in (e.P_true, e.P_executed))
    u, u_single = (trajectory_sigma(calibration, e.scan, e.points, scatter=s) for s in (False, True))
    grow = np.einsum("nmij,mj->nmi", point_jacobian(e.P_true, e.points), e.points - e.points.mean(axis=0))
    return ScanError(
        shared=rms_px(d),
        but_scale=rms_px(d - grow * np.sum(grow * d) / np.sum(grow**2)),
        u_shared=rms_px(u),
        single=rms_px(d_single),
        u_single=rms_px(u_single),
        inside=float(np.mean(np.abs(d_single) < 1.96 * u_single)),
    )


def run(e: Experiment, model: str) -> Calibration:
    return calibrate(e.scanner, e.poses, e.observations, manipulator=e.machine, model=model)
