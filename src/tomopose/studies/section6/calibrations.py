"""The calibration runs of sec. 6, before and after a scan: the paper's poses and method, and ours.

By our best the same number of images is taken at mixed poses and four table angles, as study improvements does: on the
paper's poses, which turn about one axis at a time, mount and machine errors share directions that a scan notices.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import calibrate
from tomopose.observations import BallObservations
from tomopose.studies.improvements import DETECTION_PX, mixed_poses
from tomopose.studies.parts.radiographs import BallRun, measure_run, solve_as_paper
from tomopose.studies.parts.result import Progress
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.virtual_hexapod import ball_run, believed_hexapod, real_T_MH

Method = Literal["paper", "best"]
GRID = 3
"""3 x 3 x 3 x 7 poses, as in table 2."""


def planned_run(magnification: float, seed: int, number: int, n: int | None = None) -> BallRun:
    """Run `number` at our n poses, which are the same in each run; by default as many as the paper's."""
    base = ball_run(magnification, GRID, seed, number=number)
    poses = mixed_poses(np.random.default_rng(np.random.SeedSequence([seed, 62])), n=n or len(base.poses))
    motion, images = np.random.SeedSequence([seed, 63, round(10 * magnification), number]).spawn(2)
    return replace(
        base,
        poses=poses,
        T_MH=real_T_MH(poses, magnification, np.random.default_rng(motion)),
        seed=int(images.generate_state(1)[0]),
    )


def rigid(run: BallRun, observations: BallObservations) -> Calibration:
    """Eq. (7) with all centres and equal weights, as the paper."""
    return calibrate(
        run.scanner, run.poses, observations, model="rigid", robust=False, hypotheses=False, pose_noise=None
    )


def kinematic(run: BallRun, observations: BallObservations, magnification: float) -> Calibration:
    """With the manipulator's errors identified; it does not know their form."""
    return calibrate(
        run.scanner,
        run.poses,
        observations,
        manipulator=believed_hexapod(magnification),
        model="kinematic",
        hypotheses=False,
    )


def projected(run: BallRun, rng: np.random.Generator) -> BallObservations:
    """Centres of a run with the paper's detection error (table 1), in place of radiographs."""
    sigma = DETECTION_PX / np.sqrt(2)
    x = run.x_D + sigma * rng.standard_normal(run.x_D.shape)
    return BallObservations.from_sigma(x, sigma, pose_id=run.poses.pose_id)


def calibrations(
    magnification: float, number: int, *, radiographs: bool, seed: int, steps: Steps, progress: Progress
) -> dict[Method, Calibration]:
    """Calibration run `number` by both methods, from simulated radiographs or from projected centres."""
    theirs, ours = ball_run(magnification, GRID, seed, number=number), planned_run(magnification, seed, number)
    if not radiographs:
        rng = np.random.default_rng(np.random.SeedSequence([seed, 61, round(10 * magnification), number]))
        return {
            "paper": rigid(theirs, projected(theirs, rng)),
            "best": kinematic(ours, projected(ours, rng), magnification),
        }
    n = len(theirs.poses)
    name = f"centres-M{magnification}-{GRID}-run{number}"
    by_ellipse = measure_run(theirs, steps, name, lambda done, _: progress(done, 2 * n))
    best = measure_run(ours, steps, f"{name}-planned", lambda done, _: progress(n + done, 2 * n)).best
    return {"paper": solve_as_paper(theirs, by_ellipse)[0], "best": kinematic(ours, best, magnification)}
