"""Verbs of the command line that write, each with two states of its result, for `kills.py`."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import tomopose as tp
from tomopose.cli.main import run
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.studies.warmup import circle
from tomopose.trajectory.pose_grid import calibration_grid

SCENE = """
schema = "tomopose/scene/1"
seed = SEED
source = { voltage_kV = 120.0 }
detector = { snr = 100 }
objects = [{ kind = "ball", diameter_mm = 4.0, t_mm = [0.3, -0.2, 0.1] }]
poses = { scan = { n = 3 } }

[scanner]
d_SD_mm = 800.0
d_SR_mm = 200.0
p_u_mm = 0.8
p_v_mm = 0.9
u_0_px = 30.0
v_0_px = 31.0
n_u_px = 61
n_v_px = 63
"""
PLAN = """
schema = "tomopose/measurement-plan/1"
unit = "mm"

[features.ball]
kind = "sphere"
point = [0.0, 0.0, 0.0]
radius_mm = 0.95

[[measurands]]
name = "size"
kind = "diameter"
of = ["ball"]
"""
TIMES = re.compile(
    rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d[^\"<\s]*|[A-Z][a-z]{2} [A-Z][a-z]{2} [ \d]\d \d\d:\d\d:\d\d \d{4}"
)
TAKEN = ("seconds", "processor_seconds", "compile_seconds")
CHANGING = ("provenance", "digest", "content_sha256", "utc", "created", "manifest", *TAKEN)


def prepare(folder: Path) -> None:
    """Inputs of the verbs, two states of each."""
    folder.mkdir(parents=True, exist_ok=True)
    scanner = tp.Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=700.4, v_0=611.7, n_u=1501, n_v=1203).exact()
    T_HT = tp.RigidTransform.from_angles([0.02, -0.03, 0.1], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T)
    tp.write_scanner(folder / "scanner.json", scanner, force=True)
    poses = calibration_grid(2)
    tp.write_poses(folder / "poses.csv", poses, force=True)
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=np.array([6.0, -4.0, 11.0]), alpha=poses.alpha)
    for state in (0, 1):
        noisy = x_D + np.random.default_rng(state).normal(0, 0.01, x_D.shape)
        observations = tp.BallObservations.from_sigma(noisy, 0.01, pose_id=poses.pose_id)
        tp.write_observations(folder / f"observations-{state}.csv", observations, force=True)
        (folder / f"scene-{state}.toml").write_text(SCENE.replace("SEED", str(state + 1)))
        words = ["calibrate", "--scanner", str(folder / "scanner.json"), "--poses", str(folder / "poses.csv")]
        words += ["--observations", str(folder / f"observations-{state}.csv"), "--force", "--quiet"]
        assert run([*words, "--out", str(folder / f"cal-{state}")]) in (0, 3)
        calibration = ["--calibration", str(folder / f"cal-{state}/calibration.json")]
        scan = ["--poses", str(folder / "scan.csv")]
        if state == 0:
            words = ["plan", "scan", "--shape", "triangle", "--views", "12", *calibration, "--out", scan[1]]
            assert run([*words, "--force", "--quiet"]) == 0
        out = str(folder / f"matrices-{state}.npz")
        assert run(["matrices", *calibration, *scan, "--out", out, "--force", "--quiet"]) == 0
        (folder / f"joints-{state}.csv").write_text(
            "X,Y,Z,A,B,C\n" + "".join(f"{k + state},1,2,3,4,{k}\n" for k in range(40))
        )
        grid = tp.VoxelGrid(shape=(32, 32, 32), spacing=0.1)
        z, y, x = np.mgrid[:32, :32, :32] - 15.5
        ball = 1 / (1 + np.exp(2.0 * (np.sqrt(x * x + y * y + z * z) - 9.3 - state)))
        tp.write_volume(folder / f"ball-{state}.h5", tp.Volume(values=ball.astype(np.float32), grid=grid), force=True)
        v, u = np.mgrid[:32, :32] - 15.5
        disc = np.where(np.hypot(u, v) < 8.0 + state, 0.5, 1.0).astype(np.float32)
        for k in range(12):
            tp.write_tiff(folder / f"scan-{state}" / f"view_{k:02d}.tif", disc, force=True)
    tp.write_matrices(folder / "circle.npz", circle(12), force=True)
    (folder / "plan.toml").write_text(PLAN)
    assert run(["simulate", str(folder / "scene-0.toml"), "--out", str(folder / "run"), "--force", "--quiet"]) == 0


def verbs(inputs: Path) -> dict[str, Callable[[Path, int], None]]:
    """By name: writes a state's result into a folder as OUT or OUT.*"""

    def cli(*words: str) -> Callable[[Path, int], None]:
        def write(folder: Path, state: int) -> None:
            said = [w.replace("IN/", f"{inputs}/").replace("STATE", str(state)) for w in words]
            code = run([w.replace("OUT", str(folder / "out")) for w in said] + ["--force", "--quiet"])
            if code in (130, 143):
                raise KeyboardInterrupt
            assert code in (0, 3), f"exit code {code}"

        return write

    return {
        "plan poses": cli("plan", "poses", "--grid", "2", "--half-range-mm", "1STATE", "--out", "OUT.csv"),
        "plan scan": cli(
            "plan", "scan", "--shape", "triangle", "--views", "1STATE", "--calibration", "IN/cal-0/calibration.json",
            "--out", "OUT.csv",
        ),
        "simulate": cli("simulate", "IN/scene-STATE.toml", "--out", "OUT"),
        "calibrate": cli(
            "calibrate", "--scanner", "IN/scanner.json", "--poses", "IN/poses.csv", "--observations",
            "IN/observations-STATE.csv", "--out", "OUT",
        ),
        "matrices": cli(
            "matrices", "--calibration", "IN/cal-STATE/calibration.json", "--poses", "IN/scan.csv", "--out", "OUT.npz"
        ),
        "export": cli("export", "--matrices", "IN/matrices-STATE.npz", "--to", "all", "--out", "OUT"),
        "report": cli("report", "IN/cal-STATE", "--out", "OUT.html"),
        "import-poses": cli(
            "import-poses", "IN/joints-STATE.csv", "--format", "csv", "--convention", "kuka", "--columns",
            "x=X,y=Y,z=Z,a=A,b=B,c=C", "--out", "OUT.csv",
        ),
        "reconstruct": cli(
            "reconstruct", "--matrices", "IN/circle.npz", "--images", "IN/scan-STATE", "--images-are",
            "transmission", "--voxel-mm", "0.3", "--size", "12", "--algorithm", "sart", "--out", "OUT.h5",
        ),
        "measure": cli("measure", "IN/plan.toml", "--volume", "IN/ball-STATE.h5", "--out", "OUT"),
        "study": cli("study", "figure9", "--seed", "STATE", "--out", "OUT"),
        "compare": cli("compare", "IN/cal-0/calibration.json", "IN/cal-STATE/calibration.json", "--out", "OUT.html"),
        "detect": cli(
            "detect", "--scanner", "IN/run/scanner.json", "--images", "IN/run/radiographs", "--ball-diameter-mm",
            "4.STATE", "--out", "OUT.csv",
        ),
    }  # fmt: skip


def essence(path: Path) -> str:
    """What a file says, without the time of its making and the digests that follow from it."""
    if path.suffix == ".json":
        return json.dumps(_still(json.loads(path.read_text("utf-8"))), sort_keys=True)
    if path.suffix == ".npz":
        with np.load(path) as content:
            return str({k: content[k].tolist() for k in sorted(content) if k not in CHANGING and k != "meta"})
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            return str({k: np.asarray(file[k]).sum() for k in sorted(file) if isinstance(file[k], h5py.Dataset)})
    if path.suffix == ".html":
        return "whole" if path.read_bytes().rstrip().endswith(b"</html>") else "cut off"
    return TIMES.sub(b"", path.read_bytes()).hex()


def _still(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _still(v) for k, v in value.items() if k not in CHANGING and "sha256" not in k}
    if isinstance(value, list):
        return [_still(v) for v in value]
    return TIMES.sub(b"", value.encode()).decode() if isinstance(value, str) else value
