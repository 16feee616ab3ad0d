"""A scan planned from the part: candidates, choice, refinement, order, and what is to be expected of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.calibration.result import Calibration
from tomopose.errors import InputError
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.measurement.plan import MeasurementPlan
from tomopose.planning.design import nominal_mount
from tomopose.planning.part.choose import choose, dual_bound, value
from tomopose.planning.part.limits_file import ScanLimits
from tomopose.planning.part.off_grid import refine_off_grid
from tomopose.planning.part.part import Part
from tomopose.planning.part.paths import usual_paths
from tomopose.planning.part.predict import Predicted, measurand_u, predicted, shared_part, why_unseen
from tomopose.planning.part.settings import WEIGHTS, PartSettings
from tomopose.planning.part.stations import Machine, allowed, stations
from tomopose.planning.part.targets import plane_normals, targets_of, tuy_points
from tomopose.planning.part.visit import duration, travel, visiting_order
from tomopose.planning.part.worth import Goal, Views, Worth, table, worth
from tomopose.units import Array

Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A path with what it is worth on points that nothing was planned with.

    q: (n, 7) axes, mm and rad;  travel: mm + deg;  duration: s;  tau: (n,) mean transmission of each view;
    out_of_view: views in which the part leaves the panel or hits an obstacle; those are counted as if they did not.
    """

    q: Array
    worth: Worth
    features: tuple[Predicted, ...]
    lengths: Mapping[str, float]
    travel: float
    duration: float
    tau: Array
    out_of_view: int


@dataclass(frozen=True, kw_only=True, eq=False)
class PartScanPlan:
    """Views of a part.

    poses:     in the order to be taken.
    planned_J, bound: J on the points that were planned with, and what no N of the candidates can exceed there.
    candidates: how many were allowed.
    chosen:    the plan, and `paths`: circular, triangle and sine with as many views, all judged on the same points.
    unseen:    feature -> why no allowed view shows some of it, and what would.
    seen:      (m,) how many views show each judged point of the targets;  goal: those points.
    dropped:   views left out to keep the time limit, with the J that they would have added.
    """

    poses: PoseSequence
    planned_J: float
    bound: float
    candidates: int
    chosen: Judged
    paths: Mapping[str, Judged]
    unseen: Mapping[str, str]
    seen: Array
    goal: Goal
    settings: PartSettings
    machine: Machine
    dropped: tuple[int, float]

    def __len__(self) -> int:
        return len(self.poses)


def _silent(_: str) -> None:
    return None


def plan_part_scan(
    scanner: Scanner,
    part: Part,
    views: int,
    settings: PartSettings,
    *,
    features: MeasurementPlan | None = None,
    limits: ScanLimits | None = None,
    calibration: Calibration | None = None,
    progress: Progress = _silent,
) -> PartScanPlan:
    """Choose `views` views of a part within the machine's limits.

    Parameters
    ----------
    scanner, part: the part lies in W at home, mm.
    settings:      the part's attenuation and the definition of J.
    features:      a measurement plan; without it the whole surface counts, by area.
    limits:        travel, times, obstacles; without them +-10 mm, +-5 deg and a table that turns freely.
    calibration:   the mount, pivot and shared uncertainty; without it the paper's mount, R_z(180 deg).

    Raises
    ------
    OutOfReachError  no candidate keeps the whole part in view and clear;  InputError  features off the part, or fewer
    candidates than views.
    """
    limits = ScanLimits() if limits is None else limits
    machine = Machine(
        scanner=scanner,
        T_HT=nominal_mount() if calibration is None else calibration.T_HT,
        limits=limits.travel,
        obstacles=limits.obstacles,
        pivot=None if calibration is None else calibration.pivot,
    )
    goal = _goal(part, features, settings)
    progress("candidates within the limits, in view and clear")
    q_all = stations(machine, part, settings)
    if len(q_all) < views:
        raise InputError(
            f"{views} views are wanted and only {len(q_all)} candidates are allowed; widen the limits, or ask for fewer "
            "views"
        )
    progress(f"transmission of {len(q_all)} candidates at {len(goal.x) + len(goal.x_tuy)} points")
    tables = table(goal, machine.matrices(q_all))
    progress(f"choosing {views} of {len(q_all)}")
    m, w = WEIGHTS[2] * tables.M / views, goal.w
    rows = choose(tables.A, m, w, views)
    progress("moving the chosen views off the grid")
    q, fine = refine_off_grid(goal, machine, q_all[rows], tables.take(rows))
    progress("bounding what any choice could reach")
    A = np.concatenate([tables.A, fine.A])
    m = np.concatenate([m, WEIGHTS[2] * fine.M / views])
    reached = value(A, m, w, len(q_all) + np.arange(views))
    bound = dual_bound(A, m, w, views, prices=fine.A.max(axis=0), reached=reached)
    q, dropped = _within_time(machine, limits, goal, q, fine)
    progress("judging the plan and the usual paths on other points")
    judge = _Judge(
        goal=_goal(part, features, settings, judged=True),
        machine=machine,
        limits=limits,
        calibration=calibration,
        features=features,
    )
    return PartScanPlan(
        poses=machine.poses(q),
        planned_J=reached,
        bound=bound,
        candidates=len(q_all),
        chosen=judge(q),
        paths={name: judge(path) for name, path in usual_paths(machine, len(q)).items()},
        unseen=_unseen(goal, machine, q_all, tables),
        seen=(table(judge.goal, machine.matrices(q)).A[:, : len(judge.goal.x)] > 0).sum(axis=0),
        goal=judge.goal,
        settings=settings,
        machine=machine,
        dropped=dropped,
    )


def _goal(part: Part, features: MeasurementPlan | None, settings: PartSettings, *, judged: bool = False) -> Goal:
    targets = targets_of(part, features, judged=judged, seed=settings.seed)
    return Goal(part=part, targets=targets, x_tuy=tuy_points(part, targets), planes=plane_normals(), settings=settings)


def _within_time(
    machine: Machine, limits: ScanLimits, goal: Goal, q: Array, fine: Views
) -> tuple[Array, tuple[int, float]]:
    """(q in visiting order, (views left out, J that they would have added)): the greedy order's last views go first."""
    kept = len(q)
    order = visiting_order(machine, q)
    while kept > 2 and duration(machine, limits.time, q[:kept][order]) > limits.time.limit:
        kept -= max(kept // 20, 1)
        order = visiting_order(machine, q[:kept])
    if duration(machine, limits.time, q[:kept][order]) > limits.time.limit:
        raise InputError(
            f"limits: [time] limit_s = {limits.time.limit:g} s is too short for {kept} views, which take "
            f"{duration(machine, limits.time, q[:kept][order]):.3g} s"
        )
    lost = 0.0
    if kept < len(q):
        w = goal.w
        lost = float(w @ (fine.A.max(axis=0) - fine.A[:kept].max(axis=0)))
    return q[:kept][order], (len(q) - kept, lost)


def _unseen(goal: Goal, machine: Machine, q: Array, tables: Views) -> dict[str, str]:
    P = machine.matrices(q)
    out = {}
    for target in goal.targets:
        never = float((tables.A[:, goal.rows[target.name]].max(axis=0) == 0).mean())
        if never > 0:
            out[target.name] = f"{100 * never:.0f} % of it is seen by no allowed view: " + why_unseen(
                goal, P, tables, target
            )
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class _Judge:
    goal: Goal
    machine: Machine
    limits: ScanLimits
    calibration: Calibration | None
    features: MeasurementPlan | None

    def __call__(self, q: Array) -> Judged:
        P, goal = self.machine.matrices(q), self.goal
        views = table(goal, P)
        shared = None
        if self.calibration is not None:
            x = np.array([t.x.mean(axis=0) for t in goal.targets])
            sigma = projection_matrices(self.calibration, self.machine.poses(q), points=x).points_sigma_shared
            assert sigma is not None
            shared = shared_part(goal, self.machine.scanner, P, np.asarray(sigma).reshape(-1, len(x)).mean(axis=0))
        found = tuple(predicted(goal, self.machine.scanner, P, views, shared=shared))
        return Judged(
            q=q,
            worth=worth(goal, P, views),
            features=found,
            lengths={} if self.features is None else measurand_u(self.features.measurands, found),
            travel=travel(self.machine, q),
            duration=duration(self.machine, self.limits.time, q),
            tau=views.M,
            out_of_view=int((~allowed(self.machine, goal.part, q, margin=0.0)).sum()),
        )


def with_attenuation(settings: PartSettings, mu: float) -> PartSettings:
    """The settings for another attenuation coefficient, 1/mm."""
    return replace(settings, mu=mu)
