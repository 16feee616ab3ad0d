"""Monte Carlo propagation (JCGM 101): the calibration repeated on drawn data, by the compiled batch solver.

What is drawn: every centre from its covariance, every pose from the manipulator's scatter, and the centre of every
prior.  The truth is the calibration itself, so that the spread of the solutions about it is their uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomopose.calibration.model.ball_projection import poses_of
from tomopose.calibration.model.parameters import FreeParameters, base_name, free_parameters
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.result import Calibration
from tomopose.calibration.rigid.fit import Fit, blocks, freed_of, rows_of, tangent_names
from tomopose.calibration.rigid.kernel import CONVERGED, solve_batch
from tomopose.calibration.rigid.pose_noise import PoseNoise, total_covariance
from tomopose.errors import InputError
from tomopose.geometry.rotations import exp_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.least_squares import Status
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.units import Array
from tomopose.values import require_types, value

BATCH = 2000
ITERATIONS = 20


@value
class MonteCarlo:
    """errors (b, m): estimate minus truth in the coordinates `names` (w_HT as rotation vector);  chi2 (b,);
    converged (b,) bool;  seed."""

    names: tuple[str, ...]
    errors: Array
    chi2: Array
    converged: Array
    seed: int

    @property
    def covariance(self) -> Array:
        """(m, m) of the draws that converged."""
        return np.cov(self.errors[np.asarray(self.converged, dtype=bool)], rowvar=False)

    @property
    def u(self) -> Array:
        """(m,) standard uncertainties."""
        return np.sqrt(np.diag(self.covariance))

    def shortest_interval(self, probability: float = 0.95) -> Array:
        """(m, 2): shortest interval of each coordinate's error that holds this part of the draws.  JCGM 101, 7.7."""
        e = np.sort(self.errors[np.asarray(self.converged, dtype=bool)], axis=0)
        n = len(e)
        k = min(max(int(np.ceil(probability * n)), 1), n)
        width = e[k - 1 :] - e[: n - k + 1]
        first = width.argmin(axis=0)
        columns = np.arange(e.shape[1])
        return np.column_stack([e[first, columns], e[first + k - 1, columns]])


def draw(
    problem: Problem, free: FreeParameters, truth: Fit, draws: int, *, seed: int = 0, noise: PoseNoise | None = None
) -> MonteCarlo:
    """Solve `draws` seeded repetitions of a problem whose truth is `truth`; the problem's own centres are not used.

    With pose noise the centres are weighted by their total covariance, as `calibrate` does.
    """
    if int(draws) != draws or draws < 2:
        raise InputError(f"{draws!r} draws are asked for; a whole number from 2 is needed")
    at = blocks(problem, free, truth)
    weighted = problem if noise is None else problem.with_covariance(total_covariance(problem.covariance, at, noise))
    root = np.linalg.cholesky(problem.covariance)
    sigma = np.where(np.isfinite(free.sigma), free.sigma, 0.0)
    n, f = len(problem), len(free)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    start = np.concatenate([truth.R_HT.ravel(), truth.t_HT, truth.t.ravel(), truth.delta])
    parts = []
    for first in range(0, draws, BATCH):
        b = min(BATCH, draws - first)
        x = at.x_D + np.einsum("kij,bkj->bki", root, rng.standard_normal((b, n, 2)))
        R, t = problem.R_MH[None], problem.t_MH[None]
        if noise is not None:
            # the log holds the pose before its scatter: the plate was elsewhere than it says
            R = problem.R_MH @ exp_rotation(noise.rotation * rng.standard_normal((b, n, 3)))
            t = problem.t_MH + noise.translation * rng.standard_normal((b, n, 3))
        poses = np.array([poses_of(R_b, t_b, problem.alpha) for R_b, t_b in zip(R, t, strict=True)])
        prior = sigma * rng.standard_normal((b, f)) + truth.delta if f else np.zeros((1, 0))
        parts.append(
            solve_batch(
                np.ascontiguousarray(x),
                poses,
                rows_of(weighted),
                freed_of(problem, free),
                np.ascontiguousarray(prior),
                start,
                ITERATIONS,
            )
        )
    theta, chi2, status = (np.concatenate(column) for column in zip(*parts, strict=True))
    errors = theta - np.concatenate([np.zeros(3), truth.t_HT, truth.t.ravel(), truth.delta])
    return MonteCarlo(
        names=tangent_names(problem.ball_ids, free), errors=errors, chi2=chi2, converged=status == CONVERGED, seed=seed
    )


@require_types
def monte_carlo(
    calibration: Calibration,
    scanner: Scanner | Sequence[Scanner],
    poses: PoseSequence | Sequence[PoseSequence],
    observations: BallObservations | Sequence[BallObservations],
    *,
    draws: int = 10_000,
    seed: int = 0,
) -> MonteCarlo:
    """The uncertainty of a calibration (model "rigid") by JCGM 101, from the inputs it was made of.

    Poses that it set aside are left out; the pose noise that it found is drawn too.
    """
    if calibration.model != "rigid":
        raise InputError(f"Monte Carlo is for the rigid model; this calibration's model is {calibration.model!r}")
    problem = pair(scanner, poses, observations)
    kept = set(calibration.pose_id)
    problem = problem.select([k for k, i in enumerate(problem.pose_id) if i in kept])
    free = _free_of(calibration, problem)
    values = {p.name: p.value for p in calibration.parameters}
    truth = Fit(
        R_HT=calibration.T_HT.R,
        t_HT=calibration.T_HT.t,
        t=np.array([calibration.balls[b] for b in problem.ball_ids]),
        delta=np.array([values[name] for name in free.names]) - free.value,
        chi2=calibration.chi2,
        status=Status.CONVERGED,
        N=np.zeros((0, 0)),
    )
    found = calibration.pose_noise
    noise = None if found is None else PoseNoise(translation=found.translation_mm, rotation=found.rotation_rad)
    return draw(problem, free, truth, draws, seed=seed, noise=noise)


def _free_of(calibration: Calibration, problem: Problem) -> FreeParameters:
    """What the calibration had freed, with the same priors."""
    priors = {base_name(name): sigma for name, sigma in calibration.priors.items()}
    held = [name for name in problem.scanner.sigma if name not in priors]
    stated = {name: sigma for name, sigma in priors.items() if np.isfinite(sigma)}
    return free_parameters(problem.scanners, free=sorted(priors), fix=held, priors=stated)
