"""Calibration runs of the virtual hexapod, solved by the paper's method and with its errors identified."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import calibrate
from tomopose.studies.parts.radiographs import BallRun, exact_rms, measure_run, solve_as_paper
from tomopose.studies.parts.result import Progress
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.virtual_hexapod import ball_run, believed_hexapod, scatter_floor


@dataclass(frozen=True, kw_only=True)
class SolvedRun:
    """A run, its rigid calibration from edge pixels, its kinematic one from ours, and the floor of d_rms for it, px:
    the plate's scatter and the detection's own error."""

    run: BallRun
    paper_method: Calibration
    best: Calibration
    floor: float


def solve_run(magnification: float, n: int, seed: int, number: int, steps: Steps, progress: Progress) -> SolvedRun:
    """Run `number` at that magnification, from radiographs to both calibrations."""
    run = ball_run(magnification, n, seed, number=number)
    measured = measure_run(run, steps, f"centres-M{magnification}-{n}-run{number}", progress)
    theirs, _ = solve_as_paper(run, measured)
    ours = calibrate(
        run.scanner,
        run.poses,
        measured.best,
        manipulator=believed_hexapod(magnification),
        model="kinematic",
        hypotheses=False,
    )
    floor = float(np.hypot(scatter_floor(run, magnification), exact_rms(run, measured.best)))
    return SolvedRun(run=run, paper_method=theirs, best=ours, floor=floor)
