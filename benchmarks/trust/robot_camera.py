"""A real robot with a camera in hand: do mounts found from different corners agree within their stated uncertainty?

Data: shared/data/robot-camera-kuka (Ali et al., Sensors 19 (2019) 2837): 28 images of a board of 408 corners.  One
corner over the 28 poses is this package's problem: the corner is the ball, fixed in the base M; H is the flange.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.rigid.estimate import best_fit
from tomopose.calibration.rigid.fit import Fit, blocks, jacobian
from tomopose.calibration.rigid.pose_error_field import (
    PoseField,
    estimate_pose_field,
    field_covariance,
    field_shares,
    lever_blocks,
    solve_with_field,
)
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations

CORNER_SIGMA_PX = 0.1
"""The camera calibration's own residual (camera_calib_rms_px in the file)."""

D_SD_MM = 1000.0
UNDISTORTIONS = 50
QUANTILES = (0.025, 0.5, 0.975)
TOGETHER = 12
"""Corners, evenly spread, from which the robot's errors are estimated; more do not change them and take long."""


def undistorted(uv: Any, K: Any, k: Any) -> np.ndarray:
    """Pixels without the lens's distortion (k1, k2, p1, p2, k3 of the Brown model), by fixed-point iteration."""
    k1, k2, p1, p2, k3 = k
    seen = (uv - [K[0, 2], K[1, 2]]) / [K[0, 0], K[1, 1]]
    x = seen.copy()
    for _ in range(UNDISTORTIONS):
        r2, xy = (x**2).sum(-1, keepdims=True), x[..., :1] * x[..., 1:]
        tangential = np.concatenate(
            [2 * p1 * xy + p2 * (r2 + 2 * x[..., :1] ** 2), p1 * (r2 + 2 * x[..., 1:] ** 2) + 2 * p2 * xy], axis=-1
        )
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
        d_SD=D_SD_MM,
        d_SR=500.0,
        p_u=D_SD_MM / K[0, 0],
        p_v=D_SD_MM / K[1, 1],
        u_0=n_u - 1 - K[0, 2],
        v_0=K[1, 2],
        n_u=n_u,
        n_v=n_v,
    )
    uv = undistorted(np.array([data["corners_px"][n] for n in names]), K, data["dist_k1k2p1p2k3"])
    x = np.stack([n_u - 1 - uv[..., 0], uv[..., 1]], axis=-1)
    return [pair(camera, poses, BallObservations.from_sigma(x[:, c], CORNER_SIGMA_PX, pose_id=names)) for c in corners]


def _normalised(d: np.ndarray, C: np.ndarray) -> np.ndarray:
    """(n,) squared distances of d (n, c) in units of the covariances C (n, c, c)."""
    return np.asarray(np.einsum("ni,ni->n", d, np.linalg.solve(C, d[:, :, None])[..., 0]))


def birge_ratio(R: np.ndarray, t: np.ndarray, C: np.ndarray, c: int) -> float:
    """Root of chi2 over its degrees of freedom for n mounts about their weighted mean, of the first c of (rotation,
    translation): the Birge ratio (R. T. Birge, Phys. Rev. 40 (1932) 207), 1 where independent mounts scatter as stated.
    """
    W = np.linalg.inv(C[:, :c, :c])
    U, _, V = np.linalg.svd(R.mean(axis=0))
    R_mean, t_mean = U @ V, t.mean(axis=0)
    for _ in range(20):
        e = np.concatenate([log_rotation(R @ R_mean.T), t - t_mean], axis=1)[:, :c]
        step = np.concatenate([np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, e)), np.zeros(6 - c)])
        R_mean, t_mean = exp_rotation(step[:3]) @ R_mean, t_mean + step[3:]
    return float(np.sqrt(_normalised(e, C[:, :c, :c]).sum() / (c * (len(t) - 1))))


def _median_ratio(d: np.ndarray, C: np.ndarray) -> float:
    """Median of the normalised distances of d (n, c) over that of chi2 with c degrees of freedom, as a root."""
    return float(np.sqrt(np.median(_normalised(d, C)) / chdtri(d.shape[1], 0.5)))


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Spread of mounts over their stated uncertainty, for the rotation alone and for all six coordinates.

    rotation, mount: Birge ratios, about the weighted mean; median_rotation, median_mount: of medians, about the median,
    which single corners do not move.
    """

    rotation: float
    mount: float
    median_rotation: float
    median_mount: float


def normalised_spread(fits: list[Fit], covariances: list[np.ndarray]) -> Spread:
    R, t, C = np.array([f.R_HT for f in fits]), np.array([f.t_HT for f in fits]), np.array(covariances)
    U, _, V = np.linalg.svd(R.mean(axis=0))
    centre = U @ V
    for _ in range(10):
        centre = exp_rotation(np.median(log_rotation(R @ centre.T), axis=0)) @ centre
    e = np.concatenate([log_rotation(R @ centre.T), t - np.median(t, axis=0)], axis=1)
    return Spread(
        rotation=birge_ratio(R, t, C, 3),
        mount=birge_ratio(R, t, C, 6),
        median_rotation=_median_ratio(e[:, :3], C[:, :3, :3]),
        median_mount=_median_ratio(e, C[:, :6, :6]),
    )


def together(problems: list[Problem]) -> Problem:
    """The corners as balls of one calibration, seen in the same images."""
    rows = {
        name: np.concatenate([getattr(p, name) for p in problems])
        for name in ("R_MH", "t_MH", "alpha", "run", "index", "x_D", "covariance", "W")
    }
    return replace(
        problems[0],
        **rows,
        ball=np.repeat(np.arange(len(problems)), [len(p) for p in problems]),
        ball_ids=tuple(range(len(problems))),
        pose_id=tuple(f"{i}/{c}" for c, p in enumerate(problems) for i in p.pose_id),
    )


def by_chance(problems: list[Problem], free: Any, fits: list[Fit], field: PoseField, draws: int = 400) -> np.ndarray:
    """(draws, 2): the two Birge ratios where the model is the truth, to first order: every draw has one error a pose,
    which all corners share."""
    n, rng = len(problems[0]), np.random.default_rng(0)
    shares = field_shares(problems[0], field)
    roots = [np.linalg.cholesky(share + 1e-12 * np.trace(share) * np.eye(n)) for share in shares]
    parts, covariances = [], []
    for p, f in zip(problems, fits, strict=True):
        b = blocks(p, free, f)
        G, L, _ = lever_blocks(b, p.t_MH, field.base)
        J = jacobian(p, free, b).reshape(2 * n, -1)
        Vi = np.linalg.inv(field_covariance(p, free, f, field))
        C = inverse_information(J.T @ Vi @ J)
        parts.append((G, L, (C @ J.T @ Vi)[:6]))
        covariances.append(C[:6, :6])
    C6 = np.array(covariances)
    weights = {c: np.linalg.inv(C6[:, :c, :c]) for c in (3, 6)}
    spreads = []
    for _ in range(draws):
        e_t, e_w = (root @ rng.standard_normal((n, 3)) for root in roots)
        e = np.array(
            [
                A
                @ (
                    np.einsum("kij,kj->ki", G, e_t)
                    + np.einsum("kij,kj->ki", L, e_w)
                    + rng.normal(0, CORNER_SIGMA_PX, (n, 2))
                ).ravel()
                for G, L, A in parts
            ]
        )
        row = []
        for c, W in weights.items():
            mean = np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, e[:, :c]))
            chi2 = _normalised(e[:, :c] - mean, C6[:, :c, :c]).sum()
            row.append(float(np.sqrt(chi2 / (c * (len(e) - 1)))))
        spreads.append(row)
    return np.array(spreads)


def study(folder: Path, corners: Any = range(408), *, joined: int = TOGETHER, chance: bool = True) -> dict[str, Any]:
    """Normalised spread with J^T J (scaled to the residuals), and with the robot's errors modelled."""
    problems = corner_problems(folder, corners)
    free = free_parameters(problems[0].scanners)
    fits = [best_fit(p, free) for p in problems]
    dof = 2 * len(problems[0]) - 9
    plain = [inverse_information(f.N) * f.chi2 / dof for f in fits]
    residual = [
        float(np.sqrt(((p.x_D - blocks(p, free, f).x_D) ** 2).sum(axis=1).mean()))
        for p, f in zip(problems, fits, strict=True)
    ]
    run = together([problems[int(k)] for k in (np.arange(joined) + 0.5) * len(problems) / joined])
    field = estimate_pose_field([run], free, [best_fit(run, free)], length=None, angle=None, base="M")
    found = [solve_with_field(p, free, f, field) for p, f in zip(problems, fits, strict=True)]
    solved = [f for f, _ in found]
    return {
        "corners": len(problems),
        "residual_px": float(np.median(residual)),
        "field": field,
        "plain": normalised_spread(fits, plain),
        "modelled": normalised_spread(solved, [C for _, C in found]),
        "chance": np.quantile(by_chance(problems, free, solved, field), QUANTILES, axis=0) if chance else None,
    }


def described(field: PoseField) -> str:
    """The field by what it makes of a way of 100 mm and a turn of 20 degrees: the standard deviation of the change."""
    way, turn = (np.sqrt(2 * (1 - np.exp(-x))) for x in (100.0 / field.length, np.radians(20.0) / field.angle))
    parts = {
        "single poses": (field.translation, field.rotation),
        "change over 100 mm": (way * field.field_translation, way * field.field_rotation),
        "change over 20 degrees": (turn * field.field_translation, turn * field.field_rotation),
    }
    return "; ".join(f"{words} {1e3 * t:.0f} um and {1e6 * w:.0f} urad" for words, (t, w) in parts.items())
