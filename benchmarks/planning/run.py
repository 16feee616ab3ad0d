"""How good planned scans are: certificates, the worth beside other paths, time, and lengths from virtual scans.

    python benchmarks/planning/run.py                   certificates and worth of five parts, time of a large one
    python benchmarks/planning/run.py --images --views 24 --draws 16    virtual scans: lengths and their uncertainty
    python benchmarks/planning/run.py --images --parts plate bracket    of some parts only
    python benchmarks/planning/run.py --images --views 24 --draws 0 --paths plan circular   the predictions alone

Random paths are N of the candidates: the gain is over the best of ten draws, "over one" over their mean.  Judged on
points that nothing was planned with, counting what leaves the view as if it did not: that favours the usual paths.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from parts import CASES, Case
from scans import PATHS, WAYS, Wanted, compare_all

import tomopose as tp
from tomopose.planning.part.settings import PartSettings
from tomopose.planning.part.worth import worth
from tomopose.planning.part_scan.limits_file import ScanLimits, default_travel
from tomopose.planning.part_scan.plan import PartScanPlan, plan_part_scan
from tomopose.planning.part_scan.setting import Setting
from tomopose.planning.part_scan.stations import allowed
from tomopose.trajectory.feasibility import TravelLimits, beyond_travel

DRAWS = 10
SCANNER = tp.Scanner(d_SD=1000.0, d_SR=400.0, p_u=0.8, p_v=0.75, u_0=127.3, v_0=130.1, n_u=257, n_v=261)


def limits(tilt_deg: float) -> ScanLimits:
    travel = default_travel()
    low, high = travel.low.copy(), travel.high.copy()
    low[3:5], high[3:5] = -math.radians(tilt_deg), math.radians(tilt_deg)
    return ScanLimits(travel=TravelLimits(low=low, high=high))


def setting(case: Case, views: int) -> Setting:
    return Setting(
        scanner=replace(SCANNER, d_SR=case.d_SR),
        part=case.part,
        views=views,
        settings=PartSettings(mu=case.mu),
        features=case.plan,
        limits=limits(case.tilt),
    )


def random_J(task: Setting, plan: PartScanPlan) -> list[float]:
    """Of ten random draws of the candidates."""
    rng, machine = np.random.default_rng(0), task.machine
    q, _ = task.candidates(plan.goal)
    draws = (q[rng.choice(len(q), len(plan), replace=False)] for _ in range(DRAWS))
    return [worth(plan.goal, machine.matrices(rows)).J for rows in draws]


def within(task: Setting, plan: PartScanPlan) -> bool:
    """An independent look at every pose: travel by the table of axes, view by projecting every vertex."""
    reach = not (beyond_travel(plan.poses, task.limits.travel)[:, :6] > 1e-9).any()
    x = tp.geometry.projection.project(
        tp.geometry.projection.eq5_matrices(
            task.scanner, T_HT=task.machine.T_HT, T_MH=plan.poses.T_MH, alpha=plan.poses.alpha
        ),
        task.part.mesh.points,
    )
    inside = (x > -0.5).all() and (x < np.array([task.scanner.n_u, task.scanner.n_v]) - 0.5).all()
    return bool(reach and inside and allowed(task.machine, task.part, plan.chosen.q, margin=0.0).all())


def worth_table(views: int, parts: list[str]) -> None:
    print(f"{views} views; J on points that nothing was planned with")
    print(
        f"{'part':<10}{'certificate':>12}{'plan':>8}{'circular':>10}{'triangle':>10}{'sine':>8}{'of ten':>8}"
        f"{'over ten':>10}{'gain':>10}"
        f"{'allowed':>9}{'worst tau / circular':>22}{'s CPU':>7}"
    )
    for name in parts:
        task, start = setting(CASES[name](), views), time.process_time()
        plan = plan_part_scan(task)
        seconds = time.process_time() - start
        drawn = random_J(task, plan)
        others = {k: j.worth.J for k, j in plan.paths.items()} | {"random": max(drawn)}
        gain = plan.chosen.worth.J / max(*(j.worth.J for j in plan.paths.values()), float(np.mean(drawn))) - 1
        over_ten = plan.chosen.worth.J / max(others.values()) - 1
        tau = plan.chosen.tau.min() / plan.paths["circular"].tau.min()
        print(
            f"{name:<10}{plan.planned_J / plan.bound:12.4f}{plan.chosen.worth.J:8.3f}{others['circular']:10.3f}"
            f"{others['triangle']:10.3f}{others['sine']:8.3f}{others['random']:8.3f}{100 * over_ten:8.1f} %"
            f"{100 * gain:8.1f} %{'all' if within(task, plan) else 'NO':>9}{tau:22.2f}{seconds:7.0f}",
            flush=True,
        )


def large() -> None:
    """300 candidates chosen to 100 views on 100,000 triangles."""
    from tomopose.measurement.mesh.mesh import Mesh
    from tomopose.planning.part.part import Part
    from tomopose.simulation.objects.mesh import TriangleMesh

    case = CASES["specimen"]()
    mesh = TriangleMesh(vertices=case.part.mesh.points, faces=case.part.mesh.faces)
    while len(mesh.faces) < 100_000:
        mesh = mesh.refined()
    part = Part(mesh=Mesh(points=mesh.vertices, faces=np.asarray(mesh.faces)), name="fine specimen")
    task = setting(replace(case, part=part), 100)
    coarse = replace(task, settings=replace(task.settings, alpha_step=math.radians(8), tilt_step=math.radians(8)))
    start, wall = time.process_time(), time.perf_counter()
    plan = plan_part_scan(coarse)
    print(
        f"{len(mesh.faces)} triangles, {plan.candidates} candidates, 100 views: {time.process_time() - start:.0f} s "
        f"CPU, {time.perf_counter() - wall:.0f} s by the clock; certificate {plan.planned_J / plan.bound:.4f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--images", action="store_true", help="virtual scans only")
    parser.add_argument("--parts", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--draws", type=int, default=16, help="virtual scans of each path")
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=PATHS, help="of the virtual scans")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS, help="of predicting lengths")
    parser.add_argument("--kept", type=Path, help="folder that keeps what the virtual scans measured")
    given = parser.parse_args()
    if given.images:
        cases = {name: CASES[name]() for name in given.parts}
        compare_all(
            {name: (case, setting(case, given.views)) for name, case in cases.items()},
            Wanted(draws=given.draws, paths=given.paths, ways=given.ways, kept=given.kept),
        )
    else:
        worth_table(given.views, given.parts)
        if given.parts == list(CASES):
            large()


if __name__ == "__main__":
    main()
