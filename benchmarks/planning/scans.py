"""Virtual scans along a planned path and the usual ones: noise and beam hardening, SART, lengths against truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from parts import Case

import tomopose as tp
from tomopose.geometry.frames import Frame
from tomopose.planning.part_scan.plan import Judged, plan_part_scan
from tomopose.planning.part_scan.setting import Setting
from tomopose.simulation.detector.detector import Detector
from tomopose.simulation.objects.mesh import MeshSolid, TriangleMesh
from tomopose.simulation.physics.spectrum import tube_spectrum
from tomopose.simulation.run import SimulatedRun
from tomopose.uncertainty.virtual_scans import Simulated, simulated_errors

DRAWS, VOXEL, SIZE = 4, 0.45, 128


def nominal(plan: tp.MeasurementPlan) -> tp.MeasurementPlan:
    """The plan with the nominal value of each length, from its own geometry."""
    rows = []
    for m in plan.measurands:
        a = plan.features[m.of[0]]
        if m.kind == "diameter":
            rows.append(m.model_copy(update={"nominal_mm": 2 * float(a.radius_mm or 0)}))
        else:
            b = plan.features[m.of[1]]
            n = np.array(b.direction) / np.linalg.norm(b.direction or (1.0,))
            rows.append(m.model_copy(update={"nominal_mm": float(abs((np.array(a.point) - b.point) @ n))}))
    return plan.model_copy(update={"measurands": tuple(rows)})


def errors(case: Case, task: Setting, path: Judged) -> dict[str, Simulated]:
    mesh = TriangleMesh(vertices=case.part.mesh.points, faces=case.part.mesh.faces)
    poses = task.machine.poses(path.q)
    run = SimulatedRun(
        scanner=task.scanner,
        poses=poses,
        T_HT=task.machine.T_HT,
        T_MH=poses.T_MH,
        solids=(),
        meshes=(MeshSolid(mesh=mesh.placed(R=task.machine.T_HT.R.T), material="Al", frame=Frame.M),),
        spectrum=tube_spectrum(120.0).filtered("Cu", 0.5),
        detector=Detector(),
        seed=1,
    )
    grid = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL)
    options = {"algorithm": "sart", "iterations": 6}
    assert case.plan is not None
    return dict(simulated_errors(run, nominal(case.plan), grid, draws=DRAWS, options=options))


def compare(case: Case, task: Setting) -> None:
    plan = plan_part_scan(task)
    halves = plan_part_scan(replace(task, views=task.views // 2))
    paths = {"plan": plan.chosen, "half as many": halves.chosen, **plan.paths}
    found = {name: errors(case, task, path) for name, path in paths.items()}
    print(f"{'length':<22}" + "".join(f"{name:>26}" for name in found) + "   mean error; scatter (predicted), um")
    for length in found["plan"]:
        cells = []
        for name, path in paths.items():
            s, u = found[name][length], path.lengths.get(length, float("nan"))
            cells.append(f"{1000 * s.mean:9.1f}; {1000 * s.u:6.2f} ({1000 * u:5.2f})")
        print(f"{length:<22}" + "".join(f"{c:>26}" for c in cells))
