"""A calibration run from simulated radiographs: the same images measured by the paper's method and by ours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.calibration.records.truth import d_rms_exact
from tomopose.calibration.result import Calibration
from tomopose.calibration.solve import calibrate
from tomopose.detection.run.detect import detect
from tomopose.errors import OutOfViewError
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.simulation.run import SimulatedRun, simulate_ball_run
from tomopose.studies.parts.ellipse_method import ellipse_method
from tomopose.studies.parts.result import Progress
from tomopose.studies.parts.steps import Steps
from tomopose.units import Array

BALL_DIAMETER = 8.0
SNR = 200.0
MARGIN_PX = 36
"""Around the silhouette: what both detectors look at."""
CHUNK = 56
"""Poses a kept step: what an interruption can cost."""


@dataclass(frozen=True, kw_only=True)
class BallRun:
    """What a run is made from: scanner, true mount and ball, poses as recorded, and the true ones."""

    scanner: Scanner
    T_HT: RigidTransform
    t: Array
    poses: PoseSequence
    T_MH: RigidTransform
    seed: int
    snr: float = SNR

    @property
    def alpha(self) -> Array:
        """Table angles (n,), rad."""
        return self.poses.alpha

    @property
    def x_D(self) -> Array:
        """True projected centres (n, 2), px."""
        return project_ball(self.scanner, T_HT=self.T_HT, T_MH=self.T_MH, t=self.t, alpha=self.alpha)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Centres of one run: by the paper's method (n, 2) px, which states no uncertainty, and ours."""

    by_ellipse: Array
    best: BallObservations


def read_out_windows(run: BallRun) -> Iterator[tuple[tuple[int, int], SimulatedRun]]:
    """(origin, run of one radiograph) for each pose: the part of the detector around the ball, at full resolution.

    Only these pixels matter to the centre, and they are the same as in the full frame (the noise is drawn anew).
    """
    scanner = run.scanner
    x_D = run.x_D
    half_u = int(scanner.magnification * BALL_DIAMETER / 2 / scanner.p_u * 1.1) + MARGIN_PX
    half_v = int(scanner.magnification * BALL_DIAMETER / 2 / scanner.p_v * 1.1) + MARGIN_PX
    seeds = np.random.SeedSequence(run.seed).generate_state(len(x_D))
    beam = None
    for k, x in enumerate(x_D):
        u, v = round(float(x[0])) - half_u, round(float(x[1])) - half_v
        if u < 0 or v < 0 or u + 2 * half_u >= scanner.n_u or v + 2 * half_v >= scanner.n_v:
            raise OutOfViewError(f"pose {run.poses.pose_id[k]}: the ball leaves the detector", indices=[k])
        window = simulate_ball_run(
            scanner.cropped(u=u, v=v, n_u=2 * half_u + 1, n_v=2 * half_v + 1),
            T_HT=run.T_HT,
            t=run.t,
            poses=run.poses.select([k]),
            T_MH=run.T_MH[[k]],
            ball_diameter=BALL_DIAMETER,
            snr=run.snr,
            seed=int(seeds[k]),
        )
        if beam is None:
            beam = window.beam
        vars(window)["beam"] = beam  # the same spectrum and solids in every window: condensed once
        yield (u, v), window


def _measure_chunk(run: BallRun, progress: Progress) -> dict[str, Any]:
    images, origins, by_ellipse = [], [], []
    for k, (origin, window) in enumerate(read_out_windows(run)):
        image = window.image(0)
        images.append(image)
        origins.append(origin)
        by_ellipse.append(ellipse_method(image, run.scanner, origin=origin))
        progress(k + 1, len(run.poses))
    best = detect(
        images,
        run.scanner,
        ball_diameter=BALL_DIAMETER,
        origin=origins,
        pose_id=run.poses.pose_id,
    )
    return {
        "by_ellipse": by_ellipse,
        "x_D": best.x_D,
        "covariance": best.covariance,
        "seen": best.seen,
        "status": best.status,
    }


def measure_run(run: BallRun, steps: Steps, name: str, progress: Progress) -> Measured:
    """Simulate the radiographs of a run and find the ball in them, both ways; progress counts images."""
    n = len(run.poses)
    parts = []
    seeds = np.random.SeedSequence(run.seed).generate_state(n // CHUNK + 1)
    for c, start in enumerate(range(0, n, CHUNK)):
        rows = np.arange(start, min(start + CHUNK, n))
        part = replace(run, poses=run.poses.select(rows), T_MH=run.T_MH[rows], seed=int(seeds[c]))

        def count(done: int, _: int, before: int = start) -> None:
            progress(before + done, n)

        parts.append(
            steps.of(
                f"{name}-{c}",
                lambda part=part, count=count: _measure_chunk(part, count),  # type: ignore[misc]
                run=part,
            )
        )
        progress(int(rows[-1]) + 1, n)

    def column(key: str) -> Array:
        return np.array([value for p in parts for value in p[key]], dtype=np.float64)

    return Measured(
        by_ellipse=column("by_ellipse"),
        best=BallObservations(
            x_D=column("x_D"),
            covariance=column("covariance"),
            pose_id=run.poses.pose_id,
            seen=column("seen").astype(bool),
            status=tuple(s for p in parts for s in p["status"]),
        ),
    )


def solve_as_paper(run: BallRun, measured: Measured) -> tuple[Calibration, BallObservations]:
    """Eq. (7) with unit weights and rigid poses, all centres kept.

    The method states no uncertainty of a centre; the size of the residuals is taken for it, as a user would.
    """
    pose_id = run.poses.pose_id

    def solved(sigma: float) -> tuple[Calibration, BallObservations]:
        observations = BallObservations.from_sigma(measured.by_ellipse, sigma, pose_id=pose_id)
        return calibrate(
            run.scanner, run.poses, observations, model="rigid", robust=False, hypotheses=False, pose_noise=None
        ), observations

    first, _ = solved(1.0)
    return solved(float(np.sqrt(first.chi2 / first.dof)))


def errors_of(calibration: Calibration, run: BallRun) -> dict[str, float]:
    """Estimate minus truth by tangent name: t in mm; w_HT, the rotation vector of R_HT R_HT,exact^T, in rad."""
    from tomopose.geometry.rotations import log_rotation

    w = log_rotation(calibration.T_HT.R @ run.T_HT.R.T)
    parts = zip(("w_HT", "t_HT", "t"), (w, calibration.T_HT.t - run.T_HT.t, calibration.t - run.t), strict=True)
    return {f"{name}_{c}": float(value) for name, values in parts for c, value in zip("xyz", values, strict=True)}


def sigmas_of(calibration: Calibration) -> dict[str, float]:
    """Stated standard uncertainties by tangent name, mm and rad."""
    return dict(zip(calibration.tangent, np.sqrt(np.diag(calibration.covariance)).tolist(), strict=True))


def exact_rms(run: BallRun, observations: BallObservations) -> float:
    """d_rms_exact, px, against the true poses.  Eq. (9)."""
    true = replace(run.poses, T_MH=run.T_MH)
    return d_rms_exact(run.scanner, true, observations, T_HT=run.T_HT, t=run.t)
