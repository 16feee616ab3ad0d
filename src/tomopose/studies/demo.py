"""The setup that `tomopose demo` runs: the paper's scanner at M 5.3, its pose grid and its tilted scan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array

SMALL_BINNING = 4
DEMO_SEED = 2023
BACKGROUND_SNR = 200.0


@dataclass(frozen=True, kw_only=True)
class DemoSetup:
    """Scanner, the truth that the calibration has to find (T_HT, t), the calibration's poses and a scan's."""

    scanner: Scanner
    T_HT: RigidTransform
    t: Array
    poses: PoseSequence
    scan: PoseSequence
    ball_diameter: float = 8.0
    snr: float = BACKGROUND_SNR
    seed: int = DEMO_SEED


def paper_scanner(magnification: float = 5.3) -> Scanner:
    """The scanner of paper sec. 5 at M 5.3 or 2.7: d_SD 1500 mm, 2048 x 2048 pixels of 0.2 mm.

    All values are exact, as in the paper's simulation.
    d_SR follows from table 3's voxel side (75.6 and 148.2 um are one 2 x 2 binned pixel at the object); the piercing
    point is ours, since the paper prints none.
    """
    voxel = {5.3: 0.0756, 2.7: 0.1482}[magnification]
    d_SD, p = 1500.0, 0.2
    return Scanner(
        d_SD=d_SD, d_SR=d_SD * voxel / (2 * p), p_u=p, p_v=p, u_0=1021.37, v_0=1026.81, n_u=2048, n_v=2048
    ).exact()


def demo_setup(*, paper: bool = False, views: int = 180, small: bool = False) -> DemoSetup:
    """57 poses at two table angles and a tilted scan by eqs. (10) and (11).

    paper: the paper's own 189 poses, table still;  small: the detector read out in 4 x 4 bins, for a quick look.
    """
    from tomopose.trajectory.pose_grid import calibration_grid, pose_grid
    from tomopose.trajectory.scan import tilted_scan
    from tomopose.trajectory.tilt import eq11_triangle

    angles, t_HT = [0.0071, 0.0048, np.pi - 0.0155], [-1.9, 2.6, 1.4]
    T_HT = RigidTransform.from_angles(angles, t_HT, source=Frame.H, target=Frame.T)
    # nobody states how well the demo's scanner is known, unless it is the paper's simulation
    scanner = paper_scanner() if paper else replace(paper_scanner(), sigma={})
    return DemoSetup(
        scanner=scanner.binned(SMALL_BINNING) if small else scanner,
        T_HT=T_HT,
        # the paper's start guess has the ball near the pivot; away from it rotations show in the images
        t=np.array([-0.85, 0.55, -0.65] if paper else [9.15, -7.45, 15.35]),
        poses=pose_grid(3) if paper else calibration_grid(2),
        scan=tilted_scan(views, eq11_triangle, R_HT=T_HT.R),
    )
