"""One page of each kind that the package writes, from values small enough for a test."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import tomopose as tp
from tomopose.calibration.records.compare import compare
from tomopose.calibration.records.history import history_entry
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, project
from tomopose.measurement.acceptance.protocol import acceptance_protocol
from tomopose.measurement.alignment import Alignment
from tomopose.measurement.features.fits import fit_sphere
from tomopose.measurement.measure import evaluate
from tomopose.measurement.plan import plan_from
from tomopose.measurement.probing import sphere_pattern
from tomopose.measurement.results import MeasurementResults
from tomopose.report import calibration_report, comparison_report, history_report, matrices_report, observations_report
from tomopose.report.certificate.content import certificate_of
from tomopose.report.certificate.page import certificate_report
from tomopose.report.page import Figure
from tomopose.report.pages.measurement_page import measurement_report
from tomopose.report.pages.multi_sphere_page import multi_sphere_report
from tomopose.report.pages.protocol_page import protocol_report
from tomopose.report.pages.refine_page import RefinedViews, refinement_report
from tomopose.report.pages.scan_plan_page import PartSurface, scan_plan_report
from tomopose.report.pages.study_page import study_report
from tomopose.report.pages.volume_page import volume_report
from tomopose.report.style import axis, layout
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle
from tomopose.volume import Volume, VoxelGrid

Sample = Callable[..., tuple[tp.Calibration, tp.BallObservations, tp.PoseSequence]]
CENTRES = np.array([[0, 0, 0], [20.0, 0, 3], [0, 25.0, 1], [5, 5, 30.0], [12, 18, 9.0]])


def shifted(calibration: tp.Calibration, t: np.ndarray) -> tp.Calibration:
    """The same calibration with its mount moved by t, mm."""
    T = tp.RigidTransform(R=calibration.T_HT.R, t=calibration.T_HT.t + t, source=Frame.H, target=Frame.T)
    moved = [
        dataclasses.replace(p, value=p.value + t["xyz".index(p.name[-1])]) if p.name.startswith("t_HT") else p
        for p in calibration.parameters
    ]
    return dataclasses.replace(calibration, T_HT=T, parameters=tuple(moved))


def history(calibration: tp.Calibration) -> str:
    rng = np.random.default_rng(5)
    entries = []
    for k in range(12):
        entry = history_entry(shifted(calibration, 0.001 * rng.normal(size=3)), label=f"run {k}")
        entries.append({**entry, "time_utc": f"2026-01-{k + 1:02d}T08:00"})
    return history_report(entries)


def measured() -> tuple[str, str]:
    """The pages of a measurement and of its acceptance protocol."""
    content = {
        "schema": "tomopose/measurement-plan/1", "unit": "mm", "name": "standard",
        "spheres": {"centres": CENTRES.tolist(), "diameter_mm": 5.0, "u_distance_mm": 3e-4, "u_diameter_mm": 2e-4},
        "acceptance": {"u_form_mm": 1e-4, "mpe_E": {"A_um": 9, "K": 50}},
    }  # fmt: skip
    plan = plan_from(content)
    features = {
        f"sphere {k + 1:02d}": fit_sphere(sphere_pattern(c * 1.0002, 2.501, 500)[0]) for k, c in enumerate(CENTRES)
    }
    rows = tuple(replace(r, volume="scan") for r in evaluate(plan, features, Alignment.none()))
    results = MeasurementResults(plan_name="standard", results=rows, features={"scan": features})
    return measurement_report(results), protocol_report(acceptance_protocol(results, plan, "scan"))


def multi_sphere() -> str:
    names = ("d_SD", "d_SR", "p_u", "p_v", "u_0", "v_0", "eta", "theta", "phi")
    scanner = tp.Scanner(
        d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.25, u_0=1031.3, v_0=811.7, n_u=2049, n_v=1641,
        sigma=dict.fromkeys(names, 0.0),
    )  # fmt: skip
    k, n = np.arange(8), 8
    a, r = k * np.pi * (3 - np.sqrt(5)), 6 + 12 * ((3 * k) % n) / (n - 1)
    x = np.stack([r * np.cos(a), r * np.sin(a), -20 + 40 * k / (n - 1)], axis=1)
    balls = tp.SphereStandard(
        names=tuple(f"K{i + 1}" for i in k), centres=x, diameters=np.full(n, 3.0), sigma=np.full(n, 5e-4)
    )
    poses, rng = tilted_scan(10, eq11_triangle), np.random.default_rng(7)
    T_HT = tp.RigidTransform.from_angles([0.004, 0.0, np.pi + 0.01], [1.5, -2.0, 3.0], source=Frame.H, target=Frame.T)
    P = eq5_matrices(scanner, T_HT=T_HT, T_MH=poses.T_MH, alpha=poses.alpha)
    views = []
    for p in P:
        centres = project(p[None], x)[0] + 0.01 * rng.standard_normal((n, 2))
        radius = scanner.d_SD * 1.5 / (x @ p[2, :3] + p[2, 3]) / np.sqrt(scanner.p_u * scanner.p_v)
        views.append(tp.Circles(x_D=centres, covariance=np.tile(1e-4 * np.eye(2), (n, 1, 1)), radius=radius))
    return multi_sphere_report(tp.calibrate_multi_sphere(scanner, poses, views, balls))


def volume() -> Volume:
    grid = VoxelGrid(shape=(16, 20, 24), spacing=0.5)
    z, y, x = np.mgrid[:16, :20, :24]
    values = np.exp(-((z - 8) ** 2 + (y - 10) ** 2 + (x - 12) ** 2) / 30.0).astype(np.float32)
    return Volume(values=values, grid=grid)


def refinement() -> str:
    views = np.linspace(0, 1, 30)
    columns: dict[str, np.ndarray] = {"residual_before": 0.02 + 0 * views, "residual_after": 0.01 + 0.001 * views}
    for kind, unit in (("t", "mm"), ("w", "deg")):
        for c in "xyz":
            columns[f"{kind}_{c}_{unit}"] = 0.01 * np.sin(6 * views)
            columns[f"sigma_{kind}_{c}_{unit}"] = 0.002 + 0 * views
    return refinement_report(
        RefinedViews(
            columns=columns, verdict="applied", reasons=("held-out pixels fit better",), unobservable=("a shift",),
            gain=12.0, halves_px=0.02, stated_px=0.03, edge_blur_mm=(0.5, 0.3), before=volume(), after=volume(),
            provenance=None,
        )
    )  # fmt: skip


def scan_plan() -> str:
    figures = {
        "J": 0.61, "C": 0.7, "T": 0.5, "M": 0.55, "worst_transmission": 0.02, "largest_gap_deg": 31.0,
        "travel": 412.0, "duration_s": 300.0, "views_out_of_view": 0,
        "features": [{"name": "bore", "seen_share": 0.9, "u_mm": 0.001}],
        "lengths": [{"name": "width", "u_mm": None, "draws_measured": 3, "relative_u_of_u": 0.5}],
    }  # fmt: skip
    document = {
        **figures, "part": "part.stl", "views": 30, "candidates": 400, "certificate": {"ratio": 0.97},
        "paths": {"circle": {**figures, "J": 0.5}}, "unseen": [{"name": "bore", "why": "no ray runs along it"}],
        "transmission_by_view": [0.5] * 30, "limits": {"x_mm": [-10.0, 10.0]}, "assumed_limits": ["x_mm"],
        "constants": {"graze_deg": 3.0, "uncertainty": "drawn", "draws": 20}, "attenuation": "Al, 0.05 per mm",
        "joints": [{"joint": 1, "unit": "deg", "lowest": -31.0, "highest": 28.0, "limits": [-90.0, 90.0]}],
        "freedoms": [{"name": "tilt of 10 degrees", "J": 0.66, "gain": 0.05}],
    }  # fmt: skip
    corners = np.array([[x, y, z] for x in (0.0, 10.0) for y in (0.0, 10.0) for z in (0.0, 10.0)])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6]])
    surface = PartSurface(points=corners, faces=faces, views=np.array([3.0, 4.0, 5.0, 6.0]))
    turn = np.linspace(0, 2 * np.pi, 30)
    return scan_plan_report(document, surface, 280.0 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]))


def study() -> str:
    row = {
        "group": "t_HT", "quantity": "t_HT,x", "unit": "um", "source": "table 1", "printed": 3.4, "paper_method": 3.1,
        "u_paper_method": 0.2, "best": 0.2, "u": 0.05, "note": "",
    }  # fmt: skip
    figure = Figure(
        title="Errors", meaning="Error of each parameter.", look_for="Small ones.",
        data=[{"type": "bar", "name": "ours", "x": ["a", "b"], "y": [1.0, 2.0]}],
        layout=layout(xaxis=axis("parameter"), yaxis=axis("error / um")),
    )  # fmt: skip
    return study_report(
        title="Table 1", paper="Table 1", question="How exact is the mount?", rows=[row],
        checks=[{"statement": "errors are below 4 um", "found": "3.1 um", "holds": True}], figures=[figure],
        notes=["a note"], scale="small", seconds=3.0,
    )  # fmt: skip


def every_page(sample: Sample, scan: tp.ProjectionMatrices) -> dict[str, str]:
    """Name -> HTML."""
    calibration, observations, poses = sample(verdict="doubtful")
    measurement, protocol = measured()
    return {
        "calibration": calibration_report(calibration, observations=observations, poses=poses, scan=scan),
        "observations": observations_report(observations),
        "matrices": matrices_report(scan),
        "comparison": comparison_report(compare(calibration, shifted(calibration, np.array([0.05, 0, 0])))),
        "history": history(calibration),
        "certificate": certificate_report(certificate_of(calibration)),
        "measurement": measurement,
        "protocol": protocol,
        "multi-sphere": multi_sphere(),
        "volume": volume_report(volume()),
        "refinement": refinement(),
        "scan plan": scan_plan(),
        "study": study(),
    }
