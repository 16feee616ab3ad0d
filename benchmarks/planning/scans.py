"""Virtual scans along a planned path and the usual ones: noise, blur, scatter, beam hardening; SART; lengths.

Coarse on purpose: a panel read out in blocks of 2 x 2, voxels of a pixel's size at the part, few views.  In each draw
the part lies elsewhere by parts of a voxel, so that the scatter holds the sampling of panel and grid beside the noise.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from parts import Case

import tomopose as tp
from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.planning.part_scan.plan import Judged, plan_part_scan
from tomopose.planning.part_scan.setting import Setting
from tomopose.simulation.detector.detector import Detector
from tomopose.simulation.detector.scatter_glare_mtf import Scatter
from tomopose.simulation.objects.mesh import MeshSolid, TriangleMesh
from tomopose.simulation.physics.spectrum import tube_spectrum
from tomopose.simulation.run import SimulatedRun
from tomopose.uncertainty.virtual_scans import Simulated, simulated_errors

BINNING, ROOM = 2, 14
"""ROOM: voxels about the part, so that profiles along the normals stay in the grid."""
SWEEPS, SCATTER = 6, Scatter(amount=0.2, sigma=20.0)


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


def grid(case: Case, task: Setting) -> tp.VoxelGrid:
    """Voxels of a pixel's size at the rotation axis, ROOM more on each side of the part."""
    spacing = task.scanner.p_u * task.scanner.d_SR / task.scanner.d_SD
    n = np.ceil(np.ptp(case.part.mesh.points, axis=0) / spacing).astype(int) + 2 * ROOM
    return tp.VoxelGrid((int(n[2]), int(n[1]), int(n[0])), spacing, case.part.centre)


def errors(case: Case, task: Setting, path: Judged, draws: int) -> dict[str, Simulated]:
    mesh = TriangleMesh(vertices=case.part.mesh.points, faces=case.part.mesh.faces)
    poses, machine, s = task.machine.poses(path.q), task.machine, task.settings
    home = (machine.scanner.T_TW(0.0) @ machine.T_HT).inv
    run = SimulatedRun(
        scanner=task.scanner,
        poses=poses,
        T_HT=machine.T_HT,
        T_MH=poses.T_MH,
        solids=(),
        meshes=(MeshSolid(mesh=mesh.placed(R=home.R, t=home.t), material="Al", frame=Frame.M),),
        spectrum=tube_spectrum(120.0).filtered("Cu", 0.5),
        detector=Detector(snr=math.sqrt(s.quanta), blur_sigma=s.blur, scatter=SCATTER),
        seed=1,
    )
    assert case.plan is not None
    options = {"algorithm": "sart", "iterations": SWEEPS}
    return dict(simulated_errors(run, nominal(case.plan), grid(case, task), draws=draws, options=options))


def compare(case: Case, task: Setting, draws: int) -> None:
    """Errors and scatter of every length along each path, beside the prediction."""
    task = replace(task, scanner=task.scanner.binned(BINNING))
    plan = plan_part_scan(task)
    half = plan_part_scan(replace(task, views=task.views // 2))
    paths = {"plan": plan.chosen, "half as many": half.chosen, **plan.paths}
    print(f"{case.part.name}: {task.views} views, {draws} draws; mean error; scatter; predicted scatter, um")
    for name, path in paths.items():
        try:
            found = errors(case, task, path, draws)
        except InputError as error:
            print(f"  {name}: not measurable: {error}", flush=True)
            continue
        lengths = {k: s for k, s in found.items() if k in path.lengths}
        for length, s in lengths.items():
            u = path.lengths[length]
            print(f"  {name:<13}{length:<18}{1000 * s.mean:9.1f};{1000 * s.u:8.2f};{1000 * u:8.2f}", flush=True)
        rms = math.sqrt(np.mean([s.mean**2 + s.u**2 for s in lengths.values()]))
        scatter = math.sqrt(np.mean([s.u**2 for s in lengths.values()]))
        ratios = np.array([path.lengths[k] / s.u for k, s in lengths.items()])
        print(
            f"  {name}: rms error {1000 * rms:.1f} um, rms scatter {1000 * scatter:.1f} um; predicted / achieved "
            f"{ratios.min():.2f} to {ratios.max():.2f}, median {np.median(ratios):.2f}",
            flush=True,
        )
