"""The two methods on the same scan, and the arrangement with a moving scanner.

Usage: python benchmarks/manipulator/methods.py [--seeds 6]

1.  A worn hexapod (joint errors 0.1 mm, backlash, drift, repeatability) executes the paper's tilted scan.  Its matrices
    come from one ball (189 mixed poses before the scan; rigid and kinematic) or, as in paper ref. [8], from an object
    of six calibrated balls imaged in every view of the scan itself.
2.  A C-arm: a hexapod of the same errors carries source and detector about a fixed ball (150 poses), then scans.
3.  Twin robots (6R, 0.2 mm, 0.02 deg): one carries the source, the other the detector (200 views), then they scan.
"""

from __future__ import annotations

import argparse

import numpy as np
from manipulator_cases import DETECTION_PX, SCANNER, UM_PER_PX, hexapod_experiment, scan_error
from run import HEXAPOD, ROBOT, WORN
from twin_cases import twin_experiment, twin_scan_error

from tomopose import BallObservations, Frame, PoseSequence, RigidTransform
from tomopose.calibration.arrangements.moving_scanner import calibrate_inverse
from tomopose.calibration.arrangements.multi_sphere.view_pose import poses_of_views
from tomopose.calibration.arrangements.twin_robots import calibrate_twin
from tomopose.calibration.identified.calibrate import calibrate_kinematic
from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.solve import calibrate
from tomopose.calibration.uncertainty.trajectory import object_points, rms_px
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import eq5_matrices, project, project_ball
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.virtual import Disturbance, real_motion

SIGMA = DETECTION_PX / np.sqrt(2)
BALLS = np.array([[0, 0, -28], [13, 0, -12], [-8, 11, 0], [-9, -10, 9], [7, 9, 20], [10, -8, 28.0]])
"""Six balls within the object of the studies, mm."""


def one_scan(seed: int) -> tuple[float, float, float]:
    """rms error, px, of the scan as executed: rigid, kinematic, six balls in every view."""
    rng = np.random.default_rng(np.random.SeedSequence([7, seed]))
    e = hexapod_experiment(HEXAPOD, "mixed", seed, disturbance=WORN)
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
    found = calibrate_kinematic(e.scanner, e.poses, e.observations, rigid=rigid, manipulator=e.machine, model="auto")
    views = project(e.P_true, BALLS)
    views = views + SIGMA * rng.standard_normal(views.shape)
    weight = [np.tile(np.eye(2) * SIGMA**2, (len(BALLS), 1, 1))] * len(views)
    poses = poses_of_views(SCANNER, list(views), BALLS, covariance=weight)
    P = np.array([SCANNER.P_S @ SCANNER.T_WS.matrix @ pose.T_MW.matrix for pose in poses])
    balls = rms_px(without_object_pose(P, e.P_true, e.points))
    return scan_error(rigid, e).shared, scan_error(found, e).shared, balls


def moving_scanner(seed: int) -> tuple[float, float]:
    """rms error, px, of a tilting scan: rigid, auto."""
    rng = np.random.default_rng(np.random.SeedSequence([8, seed]))
    n, true = 150, RigidTransform.from_angles([0.02, -0.01, 0.03], [3.0, 1.0, -2.0], source=Frame.H, target=Frame.T)
    poses = PoseSequence.from_table(rng.uniform(-12, 12, (n, 3)), rng.uniform(-6, 6, (n, 3)))
    p = np.zeros(len(HEXAPOD.names))
    p[:42] = rng.standard_normal(42) * HEXAPOD.sigma[:42]
    real = inverse_poses(real_motion(HEXAPOD, poses, p, disturbance=Disturbance(), rng=rng))
    x = project_ball(SCANNER, T_HT=true, T_MH=real.T_MH, t=[4.0, -6.0, 5.0])
    observations = BallObservations.from_sigma(x + SIGMA * rng.standard_normal(x.shape), SIGMA, pose_id=poses.pose_id)
    angle = np.linspace(0, 2 * np.pi, 90)
    scan = PoseSequence.from_table(
        np.zeros((90, 3)), np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), np.zeros(90)])
    )
    P_true = eq5_matrices(SCANNER, T_HT=true, T_MH=inverse_poses(real_motion(HEXAPOD, scan, p)).T_MH)
    errors = []
    for model, machine in (("rigid", None), ("auto", HEXAPOD)):
        cal = calibrate_inverse(SCANNER, poses, observations, manipulator=machine, model=model)
        P = projection_matrices(cal, inverse_poses(scan)).P
        errors.append(rms_px(without_object_pose(P, P_true, object_points())))
    return errors[0], errors[1]


def twin_robots(seed: int) -> tuple[float, float, float]:
    """rms error, px, of their scan: rigid, auto; what is stated for auto."""
    e = twin_experiment(ROBOT, seed)
    errors = []
    for model in ("rigid", "auto"):
        cal = calibrate_twin(
            e.scanner, e.poses, e.observations, twin=e.twin, mount=e.mount, balls={0: e.ball}, model=model
        )
        errors.append(twin_scan_error(cal, e))
    return errors[0][0], errors[1][0], errors[1][1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    seeds = range(parser.parse_args().seeds)
    for title, names, rows in (
        ("same scan, worn hexapod", ("rigid", "kinematic, one ball", "six balls a view"), [one_scan(s) for s in seeds]),
        ("moving scanner", ("rigid", "auto"), [moving_scanner(s) for s in seeds]),
        ("twin robots", ("rigid", "auto", "stated"), [twin_robots(s) for s in seeds]),
    ):
        rms = np.sqrt(np.mean(np.square(rows), axis=0))
        told = [f"{n} {r:.4f} px ({r * UM_PER_PX:.2f} um)" for n, r in zip(names, rms, strict=True)]
        print(f"{title}: {', '.join(told)}")


if __name__ == "__main__":
    main()
