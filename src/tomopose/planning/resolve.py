"""Would these poses show a wrong convention?  Every alternative is fitted to the exact centres of the planned poses.

Where one would pass, the poses that show it best are those at which its best fit to the plan is farthest from the truth
(T-optimality: Atkinson and Fedorov, Biometrika 62 (1975) 57); the plan is made again with such poses in it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tomopose.calibration.checks.conventions.alternatives import ALTERNATIVES
from tomopose.calibration.checks.conventions.diagnose import ranked
from tomopose.calibration.checks.conventions.hypothesis import BETTER, Diagnosis, Hypothesis
from tomopose.calibration.model.parameters import UNITS, free_parameters
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.rigid.estimate import best_fit
from tomopose.calibration.rigid.fit import residuals, whitened2
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True)
class Resolvability:
    """diagnosis: all alternatives;  unresolved: those whose chi2 would not rise by 25 (5 sigma), true symmetries apart;
    symmetric: the true symmetries among them;  score: part of the other alternatives that would be distinguished;
    still: the table keeps one angle."""

    diagnosis: Diagnosis
    unresolved: tuple[Hypothesis, ...]
    symmetric: tuple[Hypothesis, ...]
    score: float
    still: bool = False

    @property
    def words(self) -> tuple[str, ...]:
        """What these poses would not show, and what would; what no poses show."""
        lines = []
        if self.unresolved:
            remedy = (
                "another table angle, a quarter turn away, would show it"
                if self.still
                else ("other table angles, more images or longer travel would show it")
            )
            names = ", ".join(f"{h.name} (delta chi2 {h.delta:.2g} of {BETTER:g})" for h in self.unresolved)
            lines.append(f"these poses would not show: {names}; {remedy}")
        else:
            lines.append(
                f"all of {sum(not h.symmetry for h in self.diagnosis.hypotheses) - 1} alternative conventions would "
                f"show by 5 sigma or more"
            )
        if self.symmetric:
            lines.append(f"true symmetries, which no poses show: {', '.join(h.name for h in self.symmetric)}")
        return tuple(lines)


def exact_problem(scanner: Scanner, poses: PoseSequence, *, T_HT: RigidTransform, t: Array, sigma: float) -> Problem:
    """The centres that these poses would show, without noise; sigma: standard uncertainty of a coordinate, px."""
    x = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t, alpha=poses.alpha)
    return pair(scanner, poses, BallObservations.from_sigma(x, sigma, pose_id=poses.pose_id))


def resolvability(
    scanner: Scanner, poses: PoseSequence, *, T_HT: RigidTransform, t: Array, sigma: float
) -> Resolvability:
    """Of poses with a nominal mount, ball and standard uncertainty of a centre's coordinate, px."""
    problem = exact_problem(scanner, poses, T_HT=T_HT, t=t, sigma=sigma)
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    diagnosis = ranked(problem, held, best_fit(problem, held))
    alternatives = [h for h in diagnosis.hypotheses if h.outcome != "declared"]
    close = [h for h in alternatives if h.delta < BETTER]
    plain = [h for h in alternatives if not h.symmetry]
    unresolved = tuple(h for h in close if not h.symmetry)
    return Resolvability(
        diagnosis=diagnosis,
        unresolved=unresolved,
        symmetric=tuple(h for h in close if h.symmetry),
        score=1.0 - len(unresolved) / max(len(plain), 1),
        still=float(np.ptp(problem.alpha)) == 0.0,
    )


def telling(everything: Problem, index: object, unresolved: Iterable[Hypothesis], n: int) -> list[int]:
    """Candidates at which alternatives that fit the rows `index` of `everything` are farthest from the truth, n for
    each.

    Alternatives that no candidate would show by half of what is wanted, even in n images, are passed over.
    """
    held = free_parameters(everything.scanners, fix=tuple(UNITS))
    part = everything.select(index)
    by_name = {r.name: r for r in ALTERNATIVES}
    found: list[int] = []
    for h in unresolved:
        changed, all_changed = (by_name[h.name].change(p) for p in (part, everything))
        if changed is None or all_changed is None or len(all_changed) != len(everything):
            continue
        d2 = whitened2(all_changed, residuals(all_changed, held, best_fit(changed, held)))
        best = np.argsort(-d2, kind="stable")[:n]
        if d2[best].sum() > BETTER / 2:
            found += [int(i) for i in best]
    # alternatives that are each other's opposite ask for the same poses
    return list(dict.fromkeys(found))
