"""Could the data have been written in another convention?  Every alternative is fitted and ranked, none is applied.

An alternative that fits better and still leaves a drift or a step in time is compared again with both free to follow
it; how two readings compare, and what is advised, is in `hypothesis`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.checks.conventions.alternative import Alternative
from tomopose.calibration.checks.conventions.alternatives import ALTERNATIVES, ALTERNATIVES_OF_MOVING_SCANNER
from tomopose.calibration.checks.conventions.fits import (
    HOPELESS,
    Fitted,
    Reading,
    fitted,
)
from tomopose.calibration.checks.conventions.hypothesis import (
    BETTER,
    FITS_SIGMAS,
    Diagnosis,
    Hypothesis,
    compared,
    rank,
)
from tomopose.calibration.checks.conventions.remainder import Remainder, remainders
from tomopose.calibration.checks.placement import better_placed
from tomopose.calibration.checks.stability import SIGNIFICANT, Effect, chi2_with_movements, movements
from tomopose.calibration.model.parameters import UNITS, FreeParameters, free_parameters
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.model.silhouettes import Cameras
from tomopose.calibration.rigid.estimate import best_fit
from tomopose.calibration.rigid.fit import Fit
from tomopose.calibration.rigid.start import ray_equations
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.inverse import inverse_poses
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array
from tomopose.values import require_types

ROWS_AT_ONCE = 1 << 17
"""Rows that the alternatives held together have: some 40 MB of poses and rays."""


@dataclass(frozen=True, kw_only=True)
class _Declared:
    """The declared reading that alternatives are judged against."""

    problem: Problem
    free: FreeParameters
    fit: Fit
    left: Remainder

    @functools.cached_property
    def n_prior(self) -> int:
        return int((self.free.information > 0).sum())

    def hypothesis(self, chi2: float) -> Hypothesis:
        """The declared reading with another chi2: where movements are followed."""
        return self.own if chi2 == self.own.chi2 else replace(self.own, chi2=chi2)

    def dof(self, problem: Problem) -> int:
        result: int = 2 * len(problem) + self.n_prior - self.fit.N.shape[0]
        return result

    def sigmas(self, found: float) -> float:
        """What the declared reading leaves (`found`), beside what moved where that is much."""
        moved = _moved(self.problem, self.free, self.fit) if found > FITS_SIGMAS else []
        if not moved:
            return found
        chi2 = chi2_with_movements(self.problem, self.free, self.fit, moved)
        return min(found, float(np.sqrt(chi2 / self.dof(self.problem))))

    @functools.cached_property
    def own(self) -> Hypothesis:
        left = self.left
        return Hypothesis(
            name="declared",
            words="the data as declared",
            remedy="",
            d_rms=left.d_rms,
            chi2=self.fit.chi2,
            dof=self.dof(self.problem),
            sigmas=self.sigmas(left.sigmas),
            delta=0.0,
            factor=1.0,
            outcome="declared",
            ball_mm=left.placed.median,
            d_SR=left.placed.d_SR,
            possible=left.placed.possible,
            share=left.share,
            size_ratio=left.size_ratio,
        )


def ranked(
    problem: Problem,
    free: FreeParameters,
    fit: Fit,
    alternatives: Iterable[Alternative] = ALTERNATIVES,
    *,
    starts: int = 24,
) -> Diagnosis:
    """The declared reading, fitted by `fit`, against alternatives.

    starts: how many rotations are tried for an alternative whose closed form leads nowhere.  Such a one is not the
    truth (of that the closed form finds the optimum); with 0 it is left out.
    """
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    cameras = Cameras.of(problem)
    rays = ray_equations(problem, cameras)
    declared = _Declared(problem=problem, free=free, fit=fit, left=remainders([problem], [cameras], [fit], free)[0])
    hopeless = HOPELESS * max(fit.chi2, float(declared.own.dof))

    def readings() -> Iterator[tuple[Alternative, Reading]]:
        for alternative in alternatives:
            changed = alternative.change(problem)
            if changed is None or declared.dof(changed) <= 0:
                continue
            same_table = changed.alpha is problem.alpha
            seen_by = cameras if same_table else Cameras.of(changed)
            of_changed = rays if same_table and changed.x_D is problem.x_D else ray_equations(changed, seen_by)
            yield alternative, Reading.of(changed, seen_by, of_changed, thoroughly=starts > 0)

    found, left = [declared.own], readings()
    while tried := list(itertools.islice(left, max(1, ROWS_AT_ONCE // len(problem)))):
        others = fitted([one for _, one in tried], free, held, starts=starts, hopeless=hopeless)
        for (alternative, one), other in zip(tried, others, strict=True):
            if not np.isfinite(other.fit.chi2):
                continue
            judged = _judged_beside_movements(declared, alternative, one.problem, other)
            if judged is not None:
                found.append(judged)
    return Diagnosis(hypotheses=rank(found))


def _judged_beside_movements(
    declared: _Declared, alternative: Alternative, changed: Problem, other: Fitted
) -> Hypothesis | None:
    """The judgement; where the alternative fits better and something still moved under it, with both free to move."""
    free, fit = declared.free, other.fit
    judged = _judged(declared, alternative, changed, other, declared.fit.chi2)
    if judged is None or judged.delta > -BETTER:
        return judged
    moved = _moved(changed, free, fit)
    if not moved:
        return judged
    following = replace(other, fit=replace(fit, chi2=chi2_with_movements(changed, free, fit, moved)))
    chi2 = chi2_with_movements(declared.problem, free, declared.fit, moved)
    still = _judged(declared, alternative, changed, following, chi2)
    if still is not None and still.outcome == "better":
        return replace(judged, outcome="better", sigmas=still.sigmas)
    return judged if still is None or judged.outcome != "better" else replace(still, chi2=fit.chi2)


def _moved(problem: Problem, free: FreeParameters, fit: Fit) -> list[Effect]:
    return [e for e in movements(problem, free, fit) if e.p < SIGNIFICANT]


def _judged(
    declared: _Declared, alternative: Alternative, changed: Problem, other: Fitted, chi2: float
) -> Hypothesis | None:
    """The comparison of one alternative; None where it puts a ball where none can be, or only renames the unit."""
    fit, left, placed, dof = other.fit, other.left, other.left.placed, declared.dof(changed)
    judged = compared(
        declared.hypothesis(chi2),
        Hypothesis(
            name=alternative.name,
            words=alternative.words,
            remedy=alternative.remedy,
            d_rms=left.d_rms,
            chi2=fit.chi2,
            dof=dof,
            # a chi2 that follows a movement says what the reading leaves beside it
            sigmas=min(left.sigmas, float(np.sqrt(fit.chi2 / dof))),
            delta=0.0,
            factor=1.0,
            outcome="worse",
            symmetry=alternative.symmetry,
            length_factor=alternative.length_factor,
            ball_mm=placed.median,
            d_SR=placed.d_SR,
            possible=placed.possible,
            share=left.share,
            size_ratio=left.size_ratio,
        ),
    )
    likelier = better_placed(placed, declared.left.placed) and not changed.units_confirmed
    better = judged.outcome == "better" or (judged.outcome == "unfit" and judged.delta < -BETTER)
    if alternative.length_factor != 1.0 and not likelier and not (better and placed.possible):
        # centres alone cannot show the unit while the table keeps one angle; the ball's place on the beam can
        return None
    return judged


def set_pose_alternative(problem: Problem, poses: PoseSequence | Iterable[PoseSequence]) -> Alternative | None:
    """The alternative "the other of set and encoder poses", where the table holds both."""
    runs = [poses] if isinstance(poses, PoseSequence) else list(poses)
    commanded: list[RigidTransform] = [p.T_MH_set for p in runs if p.T_MH_set is not None]
    if len(commanded) < len(runs):
        return None

    def change(p: Problem) -> Problem:
        R: Array = np.array([commanded[r].R[i] for r, i in zip(p.run, p.index, strict=True)])
        t: Array = np.array([commanded[r].t[i] for r, i in zip(p.run, p.index, strict=True)])
        return replace(p, R_MH=R, t_MH=t)

    return Alternative(
        name="set poses",
        words="the images were taken at the set poses, not at the encoder's",
        remedy="poses.csv: # source: set",
        change=change,
        quick=True,
    )


@require_types
def diagnose(
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    priors: Mapping[str, float] | None = None,
    moving_scanner: bool = False,
) -> Diagnosis:
    """Rank some 65 alternative conventions against the declared one.  It never changes an input.

    scanner, poses, observations, free, fix, priors: as in `calibrate`, several runs included.
    moving_scanner: source and detector move and the ball does not move, as in `calibrate_inverse`.

    Raises InputError where observations and poses do not pair.
    """
    runs = [poses] if isinstance(poses, PoseSequence) else list(poses)
    if moving_scanner:
        runs = [inverse_poses(p) for p in runs]
    problem = pair(scanner, runs, observations if not isinstance(observations, BallObservations) else [observations])
    freed = free_parameters(problem.scanners, free=free, fix=fix, priors=priors)
    fit = best_fit(problem, freed)
    other = set_pose_alternative(problem, runs)
    known = ALTERNATIVES_OF_MOVING_SCANNER if moving_scanner else ALTERNATIVES
    return ranked(problem, freed, fit, [*known, *([other] if other else [])])
