"""A real robot with a camera in hand: do mounts found from different corners agree within their stated uncertainty?

Data: shared/data/robot-camera-kuka (Ali et al., Sensors 19 (2019) 2837): 28 images of a board of 408 corners.  One
corner over the 28 poses is this package's problem: the corner is the ball, standing in the base M; H is the flange.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tomopose.calibration.estimate import best_fit
from tomopose.calibration.fit import Fit, blocks
from tomopose.calibration.parameters import free_parameters
from tomopose.calibration.pose_field import PoseField, estimate_pose_field, solve_with_field
from tomopose.calibration.problem import Problem, pair
from tomopose.calibration.uncertainty import inverse_information
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

CORNER_SIGMA_PX = 0.1
"""The camera calibration's own residual (camera_calib_rms_px in the file)."""

INTRINSIC_SIGMA_PX = 1.0
"""How well focal length and piercing point of the camera are taken to be known; the file does not say."""

D_SD_MM = 1000.0
FIELD_LENGTH_MM = 200.0
UNDISTORTIONS = 50


def undistorted(uv: Any, K: Any, k: Any) -> np.ndarray:
    """Pixels without the lens's distortion (k1, k2, p1, p2, k3 of the Brown model), by fixed-point iteration."""
    k1, k2, p1, p2, k3 = k
    seen = (uv - [K[0, 2], K[1, 2]]) / [K[0, 0], K[1, 1]]
    x = seen.copy()
    for _ in range(UNDISTORTIONS):
        r2, xy = (x**2).sum(-1, keepdims=True), x[..., :1] * x[..., 1:]
        tangential = np.concatenate([
            2 * p1 * xy + p2 * (r2 + 2 * x[..., :1] ** 2), p1 * (r2 + 2 * x[..., 1:] ** 2) + 2 * p2 * xy
        ], axis=-1)
        x = (seen - tangential) / (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3)
    return x * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]


def corner_problems(folder: Path, corners: Any) -> list[Problem]:
    """One problem per corner."""
    data = json.loads((folder / "kuka_2.json").read_text(encoding="utf-8"))
    names = sorted(data["robot_pose_4x4"])
    T = np.array([data["robot_pose_4x4"][n] for n in names])
    U, _, V = np.linalg.svd(T[:, :3, :3])
    R, t = U @ V, 1000.0 * T[:, :3, 3]
    # flange in base, inverted: M is the base, H the flange
    T_MH = RigidTransform(
        R=np.swapaxes(R, 1, 2), t=-(np.swapaxes(R, 1, 2) @ t[:, :, None])[..., 0], source=Frame.M, target=Frame.H
    )
    poses = PoseSequence(T_MH=T_MH, pose_id=tuple(names))
    K, (n_u, n_v) = np.array(data["K"]), data["image_size_wh"]
    # u of D runs against x_S, v along y_S: image columns are mirrored, rows (which run down) are not
    camera = Scanner(
        d_SD=D_SD_MM, d_SR=500.0, p_u=D_SD_MM / K[0, 0], p_v=D_SD_MM / K[1, 1], u_0=n_u - 1 - K[0, 2], v_0=K[1, 2],
        n_u=n_u, n_v=n_v,
    )
    uv = undistorted(np.array([data["corners_px"][n] for n in names]), K, data["dist_k1k2p1p2k3"])
    x = np.stack([n_u - 1 - uv[..., 0], uv[..., 1]], axis=-1)
    return [
        pair(camera, poses, BallObservations.from_sigma(x[:, c], CORNER_SIGMA_PX, pose_id=names)) for c in corners
    ]


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Robust normalised spread of mounts about their median: 1 where the stated covariances are right."""

    rotation: float
    mount: float
    rotation_rms_urad: float


def normalised_spread(fits: list[Fit], covariances: list[np.ndarray]) -> Spread:
    R, t, C = np.array([f.R_HT for f in fits]), np.array([f.t_HT for f in fits]), np.array(covariances)
    U, _, V = np.linalg.svd(R.mean(axis=0))
    centre = U @ V
    for _ in range(10):
        centre = exp_rotation(np.median(log_rotation(R @ centre.T), axis=0)) @ centre
    w = log_rotation(R @ centre.T)
    e = np.concatenate([w, t - np.median(t, axis=0)], axis=1)

    def median_of(d: np.ndarray, C: np.ndarray, chi2_median: float) -> float:
        q = np.einsum("ni,ni->n", d, np.linalg.solve(C, d[:, :, None])[..., 0])
        return float(np.sqrt(np.median(q) / chi2_median))

    return Spread(
        rotation=median_of(w, C[:, :3, :3], 2.366), mount=median_of(e, C[:, :6, :6], 5.348),
        rotation_rms_urad=float(1e6 * np.sqrt((w**2).sum(axis=1).mean())),
    )


def study(folder: Path, corners: Any = range(3, 408, 17)) -> dict[str, Any]:
    """Normalised spread with J^T J (scaled to the residuals), and with pose noise modelled."""
    problems = corner_problems(folder, corners)
    free = free_parameters(problems[0].scanners)
    fits = [best_fit(p, free) for p in problems]
    dof = 2 * len(problems[0]) - 9
    plain = [inverse_information(f.N) * f.chi2 / dof for f in fits]
    residual = [float(np.sqrt(((p.x_D - blocks(p, free, f).x_D) ** 2).sum(axis=1).mean()))
                for p, f in zip(problems, fits, strict=True)]
    field = estimate_pose_field(problems, free, fits, length=FIELD_LENGTH_MM, base="M")
    camera = problems[0].scanner
    priors = {"d_SD": INTRINSIC_SIGMA_PX * camera.p_u, "u_0": INTRINSIC_SIGMA_PX, "v_0": INTRINSIC_SIGMA_PX}
    modelled = {}
    for name, freed in (("poses", free), ("poses and camera", free_parameters((camera,), priors=priors))):
        solved = [
            solve_with_field(p, freed, replace(f, delta=np.zeros(len(freed))), field)
            for p, f in zip(problems, fits, strict=True)
        ]
        modelled[name] = normalised_spread([f for f, _ in solved], [C for _, C in solved])
    return {
        "corners": len(problems),
        "residual_px": float(np.median(residual)),
        "field": field,
        "plain": normalised_spread(fits, plain),
        "modelled": modelled,
    }


def described(field: PoseField) -> str:
    return (
        f"single poses {1e3 * field.translation:.0f} um and {1e6 * field.rotation:.0f} urad; shared over "
        f"{field.length:.0f} mm {1e3 * field.field_translation:.0f} um and {1e6 * field.field_rotation:.0f} urad"
    )
