"""The whole job by files and command line on a hexapod whose forward kinematics is written apart from the library's.

Usage: python benchmarks/manipulator/independent.py [--seeds 4] [--kinds paper mixed none]

A Stewart platform with joints and legs 0.1 mm off (SciPy solves its pose), the paper's 189 poses or 189 mixed ones of
+-8 deg at four table angles, 0.0207 px of detection error, repeatability 0.5 um and 12 urad; then the scan of eq. (11).
Printed is the rms error of the scan at the corners of +-15, +-15, +-30 mm, the object's rigid pose removed: of the scan
as executed, with its own repeatability, and of the machine's poses without it.  "none": a machine without errors.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tomopose.cli.main import run

SIGMA_JOINT, SIGMA_W, SIGMA_T, SIGMA_PX = 0.1, 12e-6, 0.5e-3, 0.0207 / np.sqrt(2)
D_SD, D_SR, PITCH, U_0, V_0 = 1500.0, 283.5, 0.2, 1021.37, 1026.81
R_WS = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
R_HT = Rotation.from_euler("XYZ", [0.0071, 0.0048, np.pi - 0.0155]).as_matrix()
T_HT = np.array([-1.9, 2.6, 1.4])
CORNERS = np.array([[x, y, z] for x in (-15, 15) for y in (-15, 15) for z in (-30, 30)], dtype=float)
COLUMNS = "pose_id,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg,alpha_deg"
VIEWS = 90


def plate(radius: float, half: float, z: float) -> Any:
    """(6, 3): joints in three groups at +-half about 0, 120 and 240 deg."""
    angle = np.concatenate([[c - half, c + half] for c in np.radians([0.0, 120.0, 240.0])])
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(6, z)])


class Platform:
    """Nominal and true joints, and a generator that scatters its poses."""

    def __init__(self, rng: np.random.Generator, size: float) -> None:
        self.rng = rng
        self.platform, self.base = plate(90.0, np.radians(50.0), -200.0), plate(160.0, np.radians(12.0), 0.0)
        apart = np.sum((self.platform - self.base)[:, :2] ** 2, axis=1)
        self.base[:, 2] = -200.0 - np.sqrt(250.0**2 - apart[0])
        self.true_base = self.base + size * rng.normal(0, SIGMA_JOINT, (6, 3))
        self.true_platform = self.platform + size * rng.normal(0, SIGMA_JOINT, (6, 3))
        self.offset = size * rng.normal(0, SIGMA_JOINT, 6)

    def reached(self, t: Any, angles: Any, scatter: bool) -> tuple[Any, Any]:
        """Where the real plate is for a commanded pose (t mm, angles deg)."""
        R = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
        legs = np.linalg.norm(self.platform @ R.T + t - self.base, axis=1) + self.offset

        def miss(x: Any) -> Any:
            turned = Rotation.from_rotvec(x[:3]).as_matrix() @ R
            return np.linalg.norm(self.true_platform @ turned.T + t + x[3:] - self.true_base, axis=1) - legs

        x = least_squares(miss, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=[0.01] * 3 + [1.0] * 3).x
        w, s = (self.rng.normal(0, SIGMA_W, 3), self.rng.normal(0, SIGMA_T, 3)) if scatter else (np.zeros(3),) * 2
        return Rotation.from_rotvec(w).as_matrix() @ Rotation.from_rotvec(x[:3]).as_matrix() @ R, t + x[3:] + s

    def image(self, t: Any, angles: Any, alpha: float, points: Any, scatter: bool = True) -> Any:
        """(k, 2) px of points (k, 3) of the plate."""
        R, shift = self.reached(t, angles, scatter)
        x = (points @ R.T + shift) @ R_HT.T + T_HT
        y = x @ Rotation.from_euler("z", alpha, degrees=True).as_matrix().T @ R_WS.T + [0.0, 0.0, D_SR]
        return np.column_stack([U_0 - D_SD / PITCH * y[:, 0] / y[:, 2], V_0 + D_SD / PITCH * y[:, 1] / y[:, 2]])


def plan(kind: str, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Positions, angles (n, 3) and table angles (n,) of 189 poses."""
    if kind == "mixed":
        turns = np.array([0.0, 90.0, 180.0, 270.0])[np.arange(189) % 4]
        return rng.uniform(-10, 10, (189, 3)), rng.uniform(-8, 8, (189, 3)), turns
    grid = np.array(np.meshgrid([-10, 0, 10], [-10, 0, 10], [-10, 0, 10], indexing="ij"), float).reshape(3, -1).T
    turns = 5.0 * np.concatenate([np.zeros((1, 3)), np.kron(np.eye(3), [[1.0], [-1.0]])])
    return np.repeat(grid, 7, axis=0), np.tile(turns, (27, 1)), np.zeros(189)


def scan_angles() -> tuple[Any, Any]:
    """Plate angles (VIEWS, 3) and table angles, deg, of eqs. (10) and (11)."""
    alpha = np.arange(VIEWS) * 2 * np.pi / VIEWS
    tilt = 28 / 45 * np.abs((alpha + np.pi / 14) % (2 * np.pi / 7) - np.pi / 7) - 2 * np.pi / 45
    angles = []
    for a, b in zip(alpha, tilt, strict=True):
        turn = Rotation.from_euler("z", a).as_matrix()
        R = R_HT.T @ turn.T @ Rotation.from_euler("y", b).as_matrix() @ turn @ R_HT
        angles.append(Rotation.from_matrix(R).as_euler("XYZ", degrees=True))
    return np.array(angles), np.degrees(alpha)


def table(path: Path, head: str, rows: Any) -> None:
    lines = [",".join([str(k), *map(repr, np.asarray(row).tolist())]) for k, row in enumerate(rows)]
    path.write_text("\n".join([head, *lines]) + "\n")


def left(P: Any, true: Any) -> float:
    """rms px of the corners, the object's rigid pose removed."""

    def miss(x: Any) -> Any:
        X = CORNERS @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:]
        h = np.einsum("nij,mj->nmi", P[..., :3], X) + P[:, None, :, 3]
        return (h[..., :2] / h[..., 2:] - true).ravel()

    found = least_squares(miss, np.zeros(6), x_scale=[1e-3] * 3 + [1e-2] * 3)
    return float(np.sqrt(np.mean(np.sum(found.fun.reshape(-1, 2) ** 2, axis=1))))


def case(kind: str, seed: int, folder: Path) -> tuple[str, list[float]]:
    """(model of auto, errors rigid and auto, each of the scan as executed and without its scatter)."""
    rng = np.random.default_rng(np.random.SeedSequence([11, seed]))
    machine = Platform(rng, 0.0 if kind == "none" else 1.0)
    ball = np.array([[10.0, -8.0, 16.0]] if kind == "mixed" else [[-0.85, 0.55, -0.65]])
    t, angles, alpha = plan(kind, rng)
    uv = np.array([machine.image(*pose, ball)[0] for pose in zip(t, angles, alpha, strict=True)])
    uv += rng.normal(0, SIGMA_PX, uv.shape)
    scan, turn = scan_angles()
    x_M = (CORNERS - T_HT) @ R_HT
    executed, exact = (
        np.array([machine.image(np.zeros(3), a, b, x_M, scatter) for a, b in zip(scan, turn, strict=True)])
        for scatter in (True, False)
    )
    (folder / "scanner.json").write_text(
        json.dumps(
            {
                "schema": "tomopose/scanner/1",
                "d_SD_mm": D_SD,
                "d_SR_mm": D_SR,
                "p_u_mm": PITCH,
                "p_v_mm": PITCH,
                "u_0_px": U_0,
                "v_0_px": V_0,
                "n_u_px": 2048,
                "n_v_px": 2048,
            }
        )
    )
    (folder / "hexapod.json").write_text(
        json.dumps(
            {
                "schema": "tomopose/hexapod/1",
                "base_joints_mm": machine.base.tolist(),
                "platform_joints_mm": machine.platform.tolist(),
                "joint_sigma_mm": SIGMA_JOINT,
                "leg_sigma_mm": SIGMA_JOINT,
            }
        )
    )
    table(folder / "poses.csv", COLUMNS, np.column_stack([t, angles, alpha]))
    table(folder / "scan.csv", COLUMNS, np.column_stack([np.zeros((VIEWS, 3)), scan, turn]))
    centres = np.column_stack([uv, np.full(uv.shape, SIGMA_PX)])
    table(folder / "o.csv", "pose_id,u_px,v_px,sigma_u_px,sigma_v_px", centres)
    errors, model = [], ""
    for name in ("rigid", "auto"):
        calibration = folder / name / "calibration.json"
        calibrate = [
            "--scanner",
            folder / "scanner.json",
            "--poses",
            folder / "poses.csv",
            "--observations",
            folder / "o.csv",
            "--manipulator",
            folder / "hexapod.json",
            "--model",
            name,
            "--out",
            folder / name,
        ]
        matrices = ["--calibration", calibration, "--poses", folder / "scan.csv", "--out", folder / f"{name}.npz"]
        for verb, words in (("calibrate", calibrate), ("matrices", matrices)):
            run([verb, *map(str, words), "--quiet"])
        with np.load(folder / f"{name}.npz") as archive:
            P = archive["P"]
        errors += [left(P, executed), left(P, exact)]
        model = json.loads(calibration.read_text())["model"]
    return model, errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--kinds", nargs="*", default=["paper", "mixed", "none"])
    given = parser.parse_args()
    for kind in given.kinds:
        rows, models = [], []
        for seed in range(given.seeds):
            with tempfile.TemporaryDirectory() as folder:
                model, errors = case(kind, seed, Path(folder))
            rows.append(errors)
            models.append(model)
        rms = np.sqrt(np.mean(np.square(rows), axis=0))
        print(
            f"{kind}: rigid {rms[0]:.4f} px, auto {rms[2]:.4f} px as executed, {rms[3]:.4f} px without the scan's own "
            f"scatter (worst {np.max(rows, axis=0)[3]:.4f}); {', '.join(sorted(set(models)))}",
            flush=True,
        )


if __name__ == "__main__":
    main()
