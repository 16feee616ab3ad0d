"""Would these poses show a wrong convention?  Every rival is fitted to the exact centres of the planned poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.calibration.estimate import best_fit
from tomopose.calibration.hypotheses import BETTER, Diagnosis, Hypothesis, ranked
from tomopose.calibration.parameters import UNITS, free_parameters
from tomopose.calibration.problem import pair
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Resolvability:
    """diagnosis: all rivals;  unresolved: those whose chi2 would not rise by 25 (5 sigma), true symmetries apart;
    symmetric: the true symmetries among them;  score: part of the other rivals that would be told apart."""

    diagnosis: Diagnosis
    unresolved: tuple[Hypothesis, ...]
    symmetric: tuple[Hypothesis, ...]
    score: float


def resolvability(
    scanner: Scanner, poses: PoseSequence, *, T_HT: RigidTransform, t: Array, sigma: float
) -> Resolvability:
    """Of poses with a nominal mount, ball and standard uncertainty of a centre's coordinate, px."""
    x = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t,
                     alpha=np.zeros(len(poses)) if poses.alpha is None else poses.alpha)
    problem = pair(scanner, poses, BallObservations.from_sigma(x, sigma, pose_id=poses.pose_id))
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    diagnosis = ranked(problem, held, best_fit(problem, held))
    rivals = [h for h in diagnosis.hypotheses if h.outcome != "declared"]
    close = [h for h in rivals if h.delta < BETTER]
    plain = [h for h in rivals if not h.symmetry]
    unresolved = tuple(h for h in close if not h.symmetry)
    return Resolvability(
        diagnosis=diagnosis, unresolved=unresolved, symmetric=tuple(h for h in close if h.symmetry),
        score=1.0 - len(unresolved) / max(len(plain), 1),
    )
