"""The main job in figures: exactness, errors under noise, third-party images, times.

    python benchmarks/main_job/run.py [--shared FOLDER]

FOLDER holds data/ball-radiographs-gvxr (third-party radiographs with truth); default: shared/ beside the project.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import tomopose as tp
from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, project, project_ball
from tomopose.geometry.rotations import exp_rotation, rotation_angle_between
from tomopose.studies.demo import paper_scanner
from tomopose.trajectory.pose_grid import pose_grid
from tomopose.trajectory.scan import tilted_scan
from tomopose.trajectory.tilt import eq11_triangle

ROOT = Path(__file__).resolve().parents[2]
POINTS = np.array([[x, y, z] for x in (-15.0, 15.0) for y in (-15.0, 15.0) for z in (-30.0, 30.0)])


def row(name: str, *values: str) -> None:
    print(f"{name:<58}" + "  ".join(values), flush=True)


def random_mount(rng: np.random.Generator) -> tuple[tp.RigidTransform, np.ndarray]:
    """Any rotation (uniform), a few mm off the axis, a ball up to 15 mm off the pivot."""
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    w = 2 * np.arccos(np.clip(abs(q[0]), 0, 1)) * q[1:] * np.sign(q[0]) / np.linalg.norm(q[1:])
    T_HT = tp.RigidTransform(R=exp_rotation(w), t=rng.uniform(-8, 8, 3), source=Frame.H, target=Frame.T)
    return T_HT, rng.uniform(-15, 15, 3)


def scan_error(scanner, cal: tp.Calibration, T_HT: tp.RigidTransform, scan: tp.PoseSequence) -> np.ndarray:
    """Reprojection error (n, m, 2), px, of a scan's points, object pose as calibrated (nothing removed)."""
    truth = eq5_matrices(scanner, T_HT=T_HT, T_MH=scan.T_MH, alpha=scan.alpha)
    return project(projection_matrices(cal, scan).P, POINTS) - project(truth, POINTS)


def exact(mounts: int) -> None:
    rng = np.random.default_rng(1)
    scanner = replace(paper_scanner(), p_v=0.25, v_0=801.3, n_v=1637)
    scan = tilted_scan(12, eq11_triangle)
    worst, reached, seconds = np.zeros(4), 0, []
    for k in range(mounts):
        T_HT, t = random_mount(rng)
        poses = pose_grid(2)
        x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t)
        order = rng.permutation(len(poses))
        obs = tp.BallObservations.from_sigma(x_D[order], 0.01, pose_id=[poses.pose_id[i] for i in order])
        begin = time.perf_counter()
        try:
            cal = tp.calibrate(scanner, poses, obs, hypotheses=False)
        except tp.TomoposeError as error:
            print(f"  mount {k}: {error}")
            continue
        seconds.append(time.perf_counter() - begin)
        found = np.array(
            [
                np.abs(cal.T_HT.t - T_HT.t).max(),
                np.abs(cal.t - t).max(),
                float(rotation_angle_between(cal.T_HT.R, T_HT.R)),
                np.abs(scan_error(scanner, cal, T_HT, scan)).max(),
            ]
        )
        reached += int(found[0] < 1e-6)
        worst = np.maximum(worst, found)
    row(
        f"exact centres, rows shuffled, {mounts} random mounts",
        f"reached {reached}",
        f"t_HT {worst[0]:.1e} mm",
        f"t {worst[1]:.1e} mm",
        f"R {worst[2]:.1e} rad",
        f"scan {worst[3]:.1e} px",
        f"median {1e3 * np.median(seconds):.1f} ms",
    )


def noise(runs: int) -> None:
    for magnification in (5.3, 2.7):
        rng = np.random.default_rng(2)
        scanner = paper_scanner(magnification)
        scan, poses = tilted_scan(90, eq11_triangle), pose_grid(3)
        T_HT = tp.RigidTransform.from_angles([0.0071, 0.0048, 3.1261], [-1.9, 2.6, 1.4], source=Frame.H, target=Frame.T)
        t = np.array([-0.85, 0.55, -0.65])
        x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t)
        inside, pixels, seconds = [], [], []
        for _ in range(runs):
            noisy = x_D + rng.normal(scale=0.0207 / np.sqrt(2), size=x_D.shape)
            obs = tp.BallObservations.from_sigma(noisy, 0.0207 / np.sqrt(2), pose_id=poses.pose_id)
            begin = time.perf_counter()
            cal = tp.calibrate(scanner, poses, obs, hypotheses=False)
            seconds.append(time.perf_counter() - begin)
            values = np.concatenate([cal.T_HT.t - T_HT.t, cal.t - t])
            u = {p.name: p.u for p in cal.parameters}
            names = ["t_HT_x", "t_HT_y", "t_HT_z", "t_x", "t_y", "t_z"]
            inside.append(np.abs(values) / np.array([u[n] for n in names]))
            error = scan_error(scanner, cal, T_HT, scan)
            pixels.append(np.sqrt(np.mean(np.sum(error**2, axis=-1))))
        inside_all = np.array(inside)
        row(
            f"0.0207 px, 3x3x3x7, M {magnification}, {runs} runs",
            f"within 3 sigma {100 * (inside_all < 3).mean():.1f} %",
            f"scan rms {np.mean(pixels):.4f} px (worst {np.max(pixels):.4f})",
            f"189 poses: {1e3 * np.median(seconds):.1f} ms",
        )


def third_party(shared: Path) -> None:
    folder = shared / "data" / "ball-radiographs-gvxr"
    truth = json.loads((folder / "truth.json").read_text())
    scanner, poses = tp.read_scanner(folder / "scanner.json"), tp.read_poses(folder / "poses.csv")
    images = tp.open_images(folder / "radiographs", scanner)
    obs = tp.detect(images, scanner, ball_diameter=8.0, pose_id=poses.pose_id)
    x = np.array([[p["u_px"], p["v_px"]] for p in truth["poses"]])
    d = np.linalg.norm(obs.x_D - x, axis=1)
    row(
        "third-party images, detection",
        f"rms {np.sqrt(np.mean(d**2)):.5f} px",
        f"worst {d.max():.5f} px",
        f"stated {np.sqrt(np.mean(np.sum(obs.sigma**2, axis=1))):.5f} px",
    )
    cal = tp.calibrate(scanner, poses, obs)
    off = (cal.T_HT.t - truth["T_HT"]["t_mm"]) * 1e3
    R = tp.RigidTransform.from_angles(truth["T_HT"]["phi_rad"], [0, 0, 0], source=Frame.H, target=Frame.T).R
    turned = 1e6 * rotation_angle_between(R, cal.T_HT.R)
    row(
        "third-party images, T_HT",
        f"t_HT {off.round(2)} um",
        f"R {turned:.2f} urad",
        f"d_rms {cal.d_rms:.5f} px",
        f"chi2/dof {cal.chi2_dof:.2f}",
        cal.verdict,
    )
    words = ["--scanner", folder / "scanner.json", "--poses", folder / "poses.csv", "--images", folder / "radiographs"]
    for attempt in ("first (kernels compiled where not cached)", "second"):
        with tempfile.TemporaryDirectory() as out:
            begin = time.perf_counter()
            subprocess.run(
                [
                    sys.executable,
                    "-m",
                    "tomopose",
                    "calibrate",
                    *map(str, words),
                    "--out",
                    f"{out}/cal",
                    "--quiet",
                    "--workers",
                    "2",
                ],
                check=True,
            )
            row(f"56 frames of 701 x 701 to calibration.json, {attempt}", f"{time.perf_counter() - begin:.2f} s")


def doors() -> None:
    for name, code in (
        ("import tomopose", "import tomopose"),
        ("tomopose --help", "from tomopose.cli.main import run; run(['--help'])"),
        ("python alone", "pass"),
    ):
        seconds = []
        for _ in range(5):
            begin = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=True)
            seconds.append(time.perf_counter() - begin)
        row(name, f"{np.median(seconds):.3f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared")
    parser.add_argument("--mounts", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=100)
    given = parser.parse_args()
    exact(given.mounts)
    noise(given.runs)
    doors()
    third_party(given.shared)


if __name__ == "__main__":
    main()
