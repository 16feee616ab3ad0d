r"""A virtual hexapod with the errors that the paper's residuals show, and what is believed about it.

Its tilts are made about axes that are turned by exp(c) against those of its translations, while its controller
compensates the lever m from its own pivot to the set one with the commanded rotation R:

    R_real = exp(c) R exp(c)^T,    t_real = t + (R - R_real) m

A ball at the set pivot, where the paper puts it, moves by (R - R_real) m: sideways for tilts about y, along the beam
for tilts about x, hardly for turns about z.  c and m are no printed numbers: they are chosen so that the rigid fit
leaves the printed residuals (table 2; sec. 5.2 by axis).  A joint model of the platform does not know this form of
error; it has to find joints that move so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.trajectory import object_points, rms_px
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.rotations import exp_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform, moved
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import Repeatability
from tomopose.manipulator.virtual import typical_hexapod
from tomopose.studies.demo import demo_setup, paper_scanner
from tomopose.studies.parts.radiographs import BallRun
from tomopose.trajectory.pose_grid import pose_grid
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle, sine_tilt
from tomopose.units import Array

TURNED_AXES = (0.0, 0.79e-3, 2.64e-3)
"""c, rad."""
LEVER_MM: Mapping[float, float] = MappingProxyType({5.3: 150.0, 2.7: 92.0})
"""Depth of the machine's own pivot below the set one: the paper used other extensions at each magnification."""
REPEATABILITY = Repeatability(t_mm=0.0006, w_rad=2e-6)
"""From the printed 0.031 px of poses without rotation (sec. 5.2) less the detection's 0.021 px at M 5.3."""
PLATFORM_BELOW_MM = 50.0
SCAN_VIEWS = 180


def real_T_MH(poses: PoseSequence, magnification: float, rng: np.random.Generator | None = None) -> RigidTransform:
    """Where the plate really is in each pose; with rng, it scatters as well."""
    R, t = poses.T_MH.R, poses.T_MH.t
    C = exp_rotation(np.array(TURNED_AXES))
    R_real = C @ R @ C.T
    t_real = t + (R - R_real) @ np.array([0.0, 0.0, -LEVER_MM[magnification]])
    if rng is not None:
        delta = rng.standard_normal((len(poses), 6)) * np.sqrt(REPEATABILITY.variance)
        R_real, t_real = moved(R_real, t_real, delta)
    return replace(poses.T_MH, R=R_real, t=t_real)


def believed_hexapod(magnification: float) -> Hexapod:
    """What the user knows: a platform of common size with joints and legs good to 0.1 mm, its pivot set where it is."""
    return typical_hexapod(pivot_height=LEVER_MM[magnification] + PLATFORM_BELOW_MM)


def ball_run(magnification: float, n: int, seed: int, *, number: int) -> BallRun:
    """Calibration run `number` of the virtual hexapod: n x n x n x 7 poses, its own scatter and noise."""
    setup, poses = demo_setup(paper=True), pose_grid(n)
    entropy = np.random.SeedSequence([seed, round(10 * magnification), n, number])
    motion, images = entropy.spawn(2)
    return BallRun(
        scanner=paper_scanner(magnification),
        T_HT=setup.T_HT,
        t=setup.t,
        poses=poses,
        T_MH=real_T_MH(poses, magnification, np.random.default_rng(motion)),
        seed=int(images.generate_state(1)[0]),
    )


def scatter_floor(run: BallRun, magnification: float) -> float:
    """px: rms shift of the ball's image by the plate's scatter alone; no calibration can foresee it."""
    calm = replace(run, T_MH=real_T_MH(run.poses, magnification))
    return rms_px(run.x_D - calm.x_D)


def scan_of(magnification: float, views: int = SCAN_VIEWS) -> PoseSequence:
    """The paper's tilted scan at that magnification (sec. 6.1): eq. (11) at M 5.3, the sine at M 2.7."""
    return tilted_scan(views, eq11_triangle if magnification > 4 else sine_tilt)


def scan_error_um(calibration: Calibration, run: BallRun, magnification: float) -> float:
    """rms error, um at the object, of the matrices of the paper's scan: corners of +-15, +-15, +-30 mm, the object's
    rigid pose removed, the plate's scatter left out."""
    scan = scan_of(magnification)
    P_true = eq5_matrices(
        run.scanner,
        T_HT=run.T_HT,
        T_MH=real_T_MH(scan, magnification),
        alpha=scan.alpha,
    )
    return matrices_error_um(projection_matrices(calibration, scan).P, P_true, run.scanner)


def matrices_error_um(P: Array, P_true: Array, scanner: Scanner) -> float:
    """rms error, um at the object, of matrices (n, 3, 4) of the unbinned scanner: corners of +-15, +-15, +-30 mm, the
    object's rigid pose removed."""
    d = without_object_pose(P, P_true, object_points())
    return rms_px(d) * float(np.sqrt(scanner.p_u * scanner.p_v)) / scanner.magnification * 1e3
