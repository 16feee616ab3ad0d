"""Alternative conventions of twin robots: either robot's table under another reading, or the images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tomopose.calibration.arrangements.twin_robots import trusted_problem
from tomopose.calibration.checks.conventions.alternative import Alternative
from tomopose.calibration.checks.conventions.alternatives import ALTERNATIVES
from tomopose.calibration.checks.conventions.hypothesis import Diagnosis, compared, rank
from tomopose.calibration.identified.hypothesis import hypothesis_of
from tomopose.calibration.identified.map_estimate import STEPS, MapEstimate, solve_map
from tomopose.calibration.model.problem import Problem, pair
from tomopose.errors import TomoposeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.twin import TwinRobots
from tomopose.observations import BallObservations
from tomopose.values import require_types

OF_TABLES = ("table sign", "table zero", "image turned by 180 degrees and table sign")
"""Readings of a rotary table, which twin robots do not have."""

FEW_STEPS = 25
"""Steps after which a reading that has found no optimum is given up; the right one takes less than ten."""


@require_types
def diagnose_twin(
    scanner: Scanner,
    poses: PoseSequence,
    observations: BallObservations,
    *,
    twin: TwinRobots,
    mount: RigidTransform,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
) -> Diagnosis:
    """Rank alternative conventions of both robots' tables and of the images; arguments as of `calibrate_twin`.

    Of the list in `conventions` the quick ones are tried, each by a fit of both robots as trusted ones (model "rigid").
    The declared reading is compared where its fit has come to, even if that is no optimum: a wrong one seldom has any.
    Raises InputError as `calibrate_twin`, and NotConvergedError where a ball of the start lies behind the source.
    """

    def fitted(
        own: PoseSequence, seen: BallObservations, robots: TwinRobots, *, steps: int, unfinished: bool = False
    ) -> MapEstimate:
        problem, start, _ = trusted_problem(scanner, own, seen, twin=robots, mount=mount, free=free, fix=fix)
        return solve_map(problem, start, steps=steps, unfinished=unfinished)

    declared = hypothesis_of(
        fitted(poses, observations, twin, steps=STEPS, unfinished=True),
        name="declared",
        words="the data as declared",
        remedy="",
        outcome="declared",
    )
    found = [declared]
    for alternative, of_poses, seen, robots in _readings(scanner, poses, observations, twin):
        try:
            other = fitted(of_poses, seen, robots, steps=FEW_STEPS)
        except (TomoposeError, np.linalg.LinAlgError):
            # a wrong reading may lead anywhere; one that cannot be fitted is not the right one
            continue
        if np.isfinite(other.chi2) and other.dof > 0:
            one = hypothesis_of(
                other,
                name=alternative.name,
                words=alternative.words,
                remedy=alternative.remedy,
                outcome="worse",
            )
            found.append(compared(declared, one))
    return Diagnosis(hypotheses=rank(found))


def _readings(
    scanner: Scanner, poses: PoseSequence, observations: BallObservations, twin: TwinRobots
) -> Iterator[tuple[Alternative, PoseSequence, BallObservations, TwinRobots]]:
    """Every alternative with the tables and centres that it would have."""
    seen = observations.used
    source = twin.source_poses.select(twin.source_poses.index_of(seen.pose_id))
    for whose, table in (("detector", poses.select(poses.index_of(seen.pose_id))), ("source", source)):
        problem = pair(scanner, table, seen)
        for alternative in ALTERNATIVES:
            tried = alternative.quick and alternative.name not in OF_TABLES
            changed = alternative.change(problem) if tried else None
            if changed is None:
                continue
            of_images = changed.x_D is not problem.x_D
            if of_images and whose == "detector":
                yield alternative, poses, _centres(changed), twin
            elif not of_images:
                named = replace(
                    alternative,
                    name=f"{whose}: {alternative.name}",
                    words=f"{whose}'s robot: {alternative.words}",
                    remedy=f"{whose}'s robot: {alternative.remedy}",
                )
                other = _table(table, changed)
                if whose == "detector":
                    yield named, other, seen, twin
                else:
                    yield named, poses, seen, replace(twin, source_poses=other)


def _centres(changed: Problem) -> BallObservations:
    return BallObservations(x_D=changed.x_D, covariance=changed.covariance, pose_id=changed.pose_id)


def _table(poses: PoseSequence, changed: Problem) -> PoseSequence:
    rows = poses.select(poses.index_of(changed.pose_id))
    T_MH = RigidTransform(R=changed.R_MH, t=changed.t_MH, source=Frame.M, target=Frame.H)
    return replace(rows, T_MH=T_MH, orientations=None)
