"""Could the data have been written in another convention?  Every rival is fitted and ranked; none is ever applied.

The measure is delta = (chi2_rival - chi2_declared) / max(1, min of both / dof), both for the same number of equations.
A rival that fits better and still leaves a drift or a step in time is compared again with both free to follow it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.calibration.checks.conventions import RIVALS, Rival
from tomopose.calibration.checks.stability import SIGNIFICANT, chi2_with_movements, movements
from tomopose.calibration.model.parameters import UNITS, FreeParameters, free_parameters
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.rigid.estimate import best_fit
from tomopose.calibration.rigid.fit import Fit, minimise, residuals
from tomopose.calibration.rigid.start import Rays, closed_form, other_starts, ray_equations, turned_about_beam
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array

SAME, BETTER = 9.0, 25.0
"""delta below SAME (3 sigma): cannot be told apart.  delta below -BETTER (5 sigma): the rival fits better."""

GOOD_CHI2, CLEARLY = 4.0, 1.5
"""Where the rival, too, leaves chi2/dof above GOOD_CHI2, poses or sigmas are wrong in ways of their own, and delta has
no such meaning: the rival must lower chi2 by the factor CLEARLY to count as better."""

RIVAL_ITERATIONS = 20
"""A rival that is right needs fewer; one that is wrong is not worth more."""

MUCH_BETTER = 2.0
"""A rival that fits better and lowers chi2 (floored at dof) by this factor makes a calibration untrustworthy."""

WORDS = {
    "declared": "as declared",
    "better": "fits significantly better than what was declared",
    "same": "cannot be told apart with these poses",
    "worse": "excluded",
}


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """A rival reading of the data, fitted.

    d_rms: px, eq. (8);  chi2, dof: of its fit;  delta: see above, 0 for the declared reading;
    factor: chi2 of the declared reading over the rival's, both floored at dof;
    outcome: declared | better | same | worse;  symmetry: no plan could tell it apart.
    """

    name: str
    words: str
    cure: str
    d_rms: float
    chi2: float
    dof: int
    delta: float
    factor: float
    outcome: str
    symmetry: bool = False

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "words": self.words,
            "cure": self.cure,
            "d_rms_px": self.d_rms,
            "chi2": self.chi2,
            "dof": self.dof,
            "delta_chi2": self.delta,
            "factor": self.factor,
            "outcome": self.outcome,
            "verdict": WORDS[self.outcome],
            "symmetry": self.symmetry,
        }


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Hypotheses ranked by fit, best first; the declared reading is among them.

    better: rivals that fit significantly better;  same: rivals that these poses cannot tell from the declared reading.
    """

    hypotheses: tuple[Hypothesis, ...]

    def named(self, outcome: str) -> tuple[Hypothesis, ...]:
        return tuple(h for h in self.hypotheses if h.outcome == outcome)

    @property
    def better(self) -> tuple[Hypothesis, ...]:
        return self.named("better")

    @property
    def same(self) -> tuple[Hypothesis, ...]:
        return self.named("same")

    @property
    def leading(self) -> tuple[Hypothesis, ...]:
        """The rival that fits best of those that fit better, and those that these poses cannot tell from it."""
        if not self.better:
            return ()
        unit = {h.name: h.chi2 * self.better[0].dof / max(h.dof, 1) for h in self.better}
        least = min(unit.values())
        noise = max(1.0, least / max(self.better[0].dof, 1))
        return tuple(h for h in self.better if unit[h.name] - least < SAME * noise)

    @property
    def advice(self) -> tuple[str, ...]:
        """Sentences: what to change, what cannot be told.  Nothing is changed by itself."""
        lines = [f"{h.words}: fits better (delta chi2 {h.delta:.3g}); to try: {h.cure}" for h in self.leading]
        if len(lines) > 1:
            lines.append("these readings fit equally well; these poses cannot tell them apart from one another")
        told = [] if lines else [h.name for h in self.same if not h.symmetry]
        if told:
            lines.append(f"cannot be told apart with these poses: {', '.join(told)}")
        kept = [h.name for h in self.same if h.symmetry]
        if kept:
            lines.append(f"true symmetries, which no poses can tell apart: {', '.join(kept)}")
        return tuple(lines)


def _rms(problem: Problem, fit: Fit, free: FreeParameters) -> float:
    r = residuals(problem, free, fit)
    return float(np.sqrt((r**2).sum(axis=1).mean()))


def _fit_rival(problem: Problem, rays: Rays, free: FreeParameters, held: FreeParameters, starts: int) -> Fit:
    start = closed_form(problem, rays)
    fit = minimise(problem, held, start, iterations=RIVAL_ITERATIONS)
    if not np.isfinite(fit.chi2):
        fit = minimise(problem, held, turned_about_beam(problem, start[0], rays), iterations=RIVAL_ITERATIONS)
    if not np.isfinite(fit.chi2):
        # mirrored data have no closed form in front of the source; the residual they leave is still worth knowing
        others = (
            minimise(problem, held, start, iterations=RIVAL_ITERATIONS)
            for start in itertools.islice(other_starts(problem, rays), starts)
        )
        fit = minimise(problem, held, min((fit, *others), key=lambda one: one.chi2))
    return minimise(problem, free, fit, iterations=RIVAL_ITERATIONS) if len(free) else fit


def ranked(
    problem: Problem, free: FreeParameters, fit: Fit, rivals: Iterable[Rival] = RIVALS, *, starts: int = 24
) -> Diagnosis:
    """The declared reading, fitted by `fit`, against rivals.

    starts: how many rotations are tried for a rival whose closed form leads nowhere.  Such a rival is not the truth (of
    that the closed form finds the optimum); with 0 it is left out.
    """
    held = free_parameters(problem.scanners, fix=tuple(UNITS))
    rays = ray_equations(problem)
    m = fit.N.shape[0]
    n_prior = int((free.information > 0).sum())
    dof = 2 * len(problem) + n_prior - m
    found = [
        Hypothesis(
            name="declared",
            words="the data as declared",
            cure="",
            d_rms=_rms(problem, fit, free),
            chi2=fit.chi2,
            dof=dof,
            delta=0.0,
            factor=1.0,
            outcome="declared",
        )
    ]
    for rival in rivals:
        changed = rival.change(problem)
        if changed is None:
            continue
        dof_r = 2 * len(changed) + n_prior - m
        if dof_r <= 0:
            continue
        same_rays = changed.x_D is problem.x_D and changed.alpha is problem.alpha
        other = _fit_rival(changed, rays if same_rays else ray_equations(changed), free, held, starts)
        if not np.isfinite(other.chi2):
            continue
        judged = _judged(rival, changed, other, free, fit.chi2, dof, dof_r)
        if judged.outcome == "better":
            moved = [e for e in movements(changed, free, other) if e.p < SIGNIFICANT]
            if moved:
                # under the rival, too, something moved: let both follow it, or a drift would pass for a convention
                still = _judged(
                    rival,
                    changed,
                    replace(other, chi2=chi2_with_movements(changed, free, other, moved)),
                    free,
                    chi2_with_movements(problem, free, fit, moved),
                    dof,
                    dof_r,
                )
                judged = judged if still.outcome == "better" else replace(still, chi2=other.chi2)
        found.append(judged)
    return Diagnosis(hypotheses=tuple(sorted(found, key=_rank)))


def _rank(h: Hypothesis) -> tuple[int, float]:
    """Better ones first, then the declared reading, then the others by their fit."""
    return {"better": 0, "declared": 1}.get(h.outcome, 2), h.delta


def _judged(
    rival: Rival, changed: Problem, other: Fit, free: FreeParameters, chi2: float, dof: int, dof_r: int
) -> Hypothesis:
    chi2_r = other.chi2 * dof / dof_r
    delta = (chi2_r - chi2) / max(1.0, min(chi2, chi2_r) / dof)
    factor = max(chi2, dof) / max(chi2_r, dof)
    believable = chi2_r < GOOD_CHI2 * dof or factor > CLEARLY
    outcome = "better" if delta < -BETTER and believable else "same" if delta < SAME else "worse"
    return Hypothesis(
        name=rival.name,
        words=rival.words,
        cure=rival.cure,
        d_rms=_rms(changed, other, free),
        chi2=other.chi2,
        dof=dof_r,
        delta=float(delta),
        factor=float(factor),
        outcome=outcome,
        symmetry=rival.symmetry,
    )


def set_pose_rival(problem: Problem, poses: PoseSequence | Iterable[PoseSequence]) -> Rival | None:
    """The rival "the other of set and encoder poses", where the table holds both."""
    runs = [poses] if isinstance(poses, PoseSequence) else list(poses)
    if any(p.T_MH_set is None for p in runs):
        return None
    commanded: list[RigidTransform] = [p.T_MH_set for p in runs if p.T_MH_set is not None]

    def change(p: Problem) -> Problem:
        R: Array = np.array([commanded[r].R[i] for r, i in zip(p.run, p.index, strict=True)])
        t: Array = np.array([commanded[r].t[i] for r, i in zip(p.run, p.index, strict=True)])
        return replace(p, R_MH=R, t_MH=t)

    return Rival(
        name="set poses",
        words="the images were taken at the set poses, not at the encoder's",
        cure="poses.csv: # source: set",
        change=change,
        quick=True,
    )


def diagnose(
    scanner: Scanner | Iterable[Scanner],
    poses: PoseSequence | Iterable[PoseSequence],
    observations: BallObservations | Iterable[BallObservations],
) -> Diagnosis:
    """Rank some 40 rival conventions against the declared one.  It never changes an input.

    Raises InputError where observations and poses do not pair.
    """
    given = (
        value if isinstance(value, (Scanner, PoseSequence, BallObservations)) else list(value)
        for value in (scanner, poses, observations)
    )
    scanner_, poses_, observations_ = given
    problem = pair(scanner_, poses_, observations_)  # type: ignore[arg-type]
    free = free_parameters(problem.scanners)
    fit = best_fit(problem, free)
    extra = set_pose_rival(problem, poses_)  # type: ignore[arg-type]
    return ranked(problem, free, fit, [*RIVALS, *([extra] if extra else [])])
