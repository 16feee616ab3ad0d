"""A scan planned from the part: candidates, choice, refinement, order, and what is to be expected of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.manipulator.poses import PoseSequence
from tomopose.planning.part.predict import Predicted, Progress, predicted, shared_part, silent, why_unseen
from tomopose.planning.part.settings import WEIGHTS, PartSettings
from tomopose.planning.part.worth import Goal, Views, Worth, table, worth
from tomopose.planning.part_scan.choose import choose, dual_bound, value
from tomopose.planning.part_scan.continuous import fine_path, of_one_turn, smooth_turn
from tomopose.planning.part_scan.limits_file import ScanLimits
from tomopose.planning.part_scan.off_grid import refine_off_grid
from tomopose.planning.part_scan.paths import usual_paths
from tomopose.planning.part_scan.setting import Setting
from tomopose.planning.part_scan.stations import Machine, allowed
from tomopose.planning.part_scan.visit import duration, travel, turn_duration, visiting_order
from tomopose.trajectory.completeness import source_path
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A path with what it is worth on points that nothing was planned with.

    q: (n, 7) axes, mm and rad;  lengths: u, mm;  measured: how many drawn scans show each, where scans were drawn;
    travel: mm + deg;  duration: s;  tau: (n,) mean transmission of each view;
    seen: (m,) how many views show each point that it was judged on;
    out_of_view: views in which the part leaves the panel or hits an obstacle; those are counted as if they did not.
    """

    q: Array
    worth: Worth
    features: tuple[Predicted, ...]
    lengths: Mapping[str, float]
    measured: Mapping[str, int]
    travel: float
    duration: float
    tau: Array
    seen: Array
    out_of_view: int


@dataclass(frozen=True, kw_only=True, eq=False)
class PartScanPlan:
    """Views of a part.

    poses:     in the order to be taken.
    planned_J, bound: J on the points that were planned with, and what no N of the candidates can exceed there.
    candidates: how many were allowed.
    chosen:    the plan, and `paths`: circular, triangle and sine with as many views, all judged on the same points.
    unseen:    feature -> why no allowed view shows some of it, and what would.
    goal:      the points that all paths were judged on.
    dropped:   views left out to keep the time limit, with the J that they would have added.
    way:       (k, 7) axes of the smooth way through the views of a continuous scan;  way_blocked: how many of those
               places leave the view, an axis' limits or the stroke, or hit an obstacle.
    """

    poses: PoseSequence
    planned_J: float
    bound: float
    candidates: int
    chosen: Judged
    paths: Mapping[str, Judged]
    unseen: Mapping[str, str]
    goal: Goal
    settings: PartSettings
    machine: Machine
    limits: ScanLimits
    dropped: tuple[int, float]
    way: Array | None = None
    way_blocked: int = 0

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def matrices(self) -> ProjectionMatrices:
        """Of the views, in their order."""
        s = self.machine.scanner
        P = self.machine.matrices(self.chosen.q)
        return ProjectionMatrices(
            P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=self.poses.pose_id, scanner=s
        )

    @property
    def source_path(self) -> Array:
        """(n, 3) where the source is in the part's coordinates, mm, in the order of the views."""
        return source_path(self.machine.matrices(self.chosen.q))


def plan_part_scan(setting: Setting, *, progress: Progress = silent) -> PartScanPlan:
    """Choose views of a part within the machine's limits.

    setting: what is wanted;  progress: is given a line before each stage.

    Raises
    ------
    OutOfReachError  no candidate keeps the whole part in view and clear;  InputError  features off the part, or fewer
    candidates than views.
    """
    machine, goal, views = setting.machine, setting.goal(), setting.views
    setting = of_one_turn(setting) if setting.continuous else setting
    progress("candidates within the limits, in view and clear, and their transmission")
    q_all, tables = setting.candidates(goal)
    if len(q_all) < views:
        raise InputError(
            f"{views} views are wanted and only {len(q_all)} candidates are allowed; widen the limits, or ask for "
            "fewer views"
        )
    progress(f"choosing {views} of {len(q_all)}")
    m = WEIGHTS[2] * tables.M / views
    if setting.continuous:
        rows = smooth_turn(setting, q_all, tables, m, goal.w)
        q, fine = q_all[rows], tables.take(rows)
    else:
        rows = choose(tables.A, m, goal.w, views)
        progress("moving the chosen views off the grid")
        q, fine = refine_off_grid(goal, machine, q_all[rows], tables.take(rows))
    progress("bounding what any choice could reach")
    reached, bound = _certificate(goal, tables, fine, views)
    if setting.continuous:
        dropped = 0, 0.0
        _require_time(turn_duration(machine, setting.limits.time, q), setting.limits, views)
    else:
        q, dropped = _within_time(machine, setting.limits, goal, q, fine)
    way = fine_path(machine, q) if setting.continuous else None
    progress("judging the plan and the usual paths on other points")
    judge = _Judge(goal=setting.goal(judged=True), machine=machine, setting=setting, progress=progress)
    return PartScanPlan(
        poses=machine.commanded(q),
        planned_J=reached,
        bound=bound,
        candidates=len(q_all),
        chosen=judge("plan", q),
        paths={name: judge(name, path) for name, path in usual_paths(machine, len(q)).items()},
        unseen=_unseen(goal, tables),
        goal=judge.goal,
        settings=setting.settings,
        machine=machine,
        limits=setting.limits,
        dropped=dropped,
        way=way,
        way_blocked=0 if way is None else int((~allowed(machine, setting.part, way, margin=0.0)).sum()),
    )


def _certificate(goal: Goal, tables: Views, fine: Views, views: int) -> tuple[float, float]:
    """(J of the chosen views, bound on J of as many of the candidates and the chosen views)."""
    A = np.concatenate([tables.A, fine.A])
    m = WEIGHTS[2] * np.concatenate([tables.M, fine.M]) / views
    reached = value(A, m, goal.w, len(tables.A) + np.arange(views))
    return reached, dual_bound(A, m, goal.w, views, prices=fine.A.max(axis=0), reached=reached)


def _require_time(seconds: float, limits: ScanLimits, views: int) -> None:
    if seconds > limits.time.limit:
        raise InputError(
            f"limits: [time] limit_s = {limits.time.limit:g} s is too short for {views} views, taking {seconds:.3g} s"
        )


def _within_time(
    machine: Machine, limits: ScanLimits, goal: Goal, q: Array, fine: Views
) -> tuple[Array, tuple[int, float]]:
    """(q in visiting order, (views left out, J that they would have added)): the greedy order's last views go first."""
    kept = len(q)
    order = visiting_order(machine, q)
    while kept > 2 and duration(machine, limits.time, q[:kept][order]) > limits.time.limit:
        kept -= max(kept // 20, 1)
        order = visiting_order(machine, q[:kept])
    _require_time(duration(machine, limits.time, q[:kept][order]), limits, kept)
    lost = 0.0
    if kept < len(q):
        w = goal.w
        lost = float(w @ (fine.A.max(axis=0) - fine.A[:kept].max(axis=0)))
    return q[:kept][order], (len(q) - kept, lost)


def _unseen(goal: Goal, tables: Views) -> dict[str, str]:
    out = {}
    for target in goal.targets:
        never = float((tables.A[:, goal.rows[target.name]].max(axis=0) == 0).mean())
        if never > 0:
            out[target.name] = f"{100 * never:.0f} % of it is seen by no allowed view: " + why_unseen(
                goal, tables, target
            )
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class _Judge:
    goal: Goal
    machine: Machine
    setting: Setting
    progress: Progress

    def __call__(self, name: str, q: Array) -> Judged:
        P, goal = self.machine.matrices(q), self.goal
        time_of = turn_duration if self.setting.continuous else duration
        views = table(goal, P)
        shared = None
        if self.setting.calibration is not None:
            x = np.array([t.x.mean(axis=0) for t in goal.targets])
            commanded = self.machine.commanded(q)
            matrices = projection_matrices(self.setting.calibration, commanded, points=x, home=self.machine.home)
            sigma = matrices.points_sigma_shared
            assert sigma is not None
            shared = shared_part(goal, self.machine.scanner, P, np.asarray(sigma).reshape(-1, len(x)).mean(axis=0))
        found = predicted(
            goal,
            self.machine.scanner,
            P,
            views,
            plan=self.setting.features,
            shared=shared,
            progress=lambda line: self.progress(f"{name}: {line}"),
        )
        return Judged(
            q=q,
            worth=worth(goal, P, views),
            features=tuple(found.features),
            lengths=found.lengths,
            measured=found.measured,
            travel=travel(self.machine, q),
            duration=time_of(self.machine, self.setting.limits.time, q),
            tau=views.M,
            seen=(views.A[:, : len(goal.x)] > 0).sum(axis=0),
            out_of_view=int((~allowed(self.machine, goal.part, q, margin=0.0)).sum()),
        )
