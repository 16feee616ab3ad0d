r"""Pose errors that neighbouring poses share, beside the scatter of single poses.

A robot that is wrong by 0.3 mm is wrong by nearly the same where it stands nearly the same.  Poses close to each other
then repeat an error instead of averaging it, and a covariance that takes them as independent is too small.  Here a
pose's error is a random field over the place x_k of the manipulator:

    cov(k, l) = diag(translation^2, rotation^2) delta_kl
                + diag(field_translation^2, field_rotation^2) exp(-|x_k - x_l| / length)

with translations along the axes of the base and rotations about the moving part's origin.  The four standard deviations
maximise the restricted likelihood (see `pose_noise`), pooled over all data of the same machine that are given together:
one ball alone hardly determines them.  The estimate is generalised least squares with the full covariance of the
centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from tomopose.calibration.fit import Fit, blocks, jacobian
from tomopose.calibration.parameters import FreeParameters
from tomopose.calibration.problem import Problem
from tomopose.calibration.residuals import ProjectionBlocks
from tomopose.calibration.uncertainty import inverse_information
from tomopose.errors import InputError, NotConvergedError
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.units import Array

ITERATIONS = 60
EVALUATIONS = 300


@dataclass(frozen=True, kw_only=True)
class PoseField:
    """Standard deviations, a coordinate each: of single poses (mm, rad) and of the shared field (mm, rad), its length
    (mm), and which part stands still: "H" (the ball moves with M; places are t_MH) or "M" (M is the base and H moves,
    as with a camera or source on a robot; places are those of H's origin in M)."""

    translation: float
    rotation: float
    field_translation: float
    field_rotation: float
    length: float
    base: str = "H"


def _lever_blocks(b: ProjectionBlocks, t_MH: Array, base: str) -> tuple[Array, Array, Array]:
    """(G, L, x): derivatives (n, 2, 3) of the centres by a pose's translation and rotation error along the base's axes,
    and the moving part's place (n, 3)."""
    if base == "H":
        lever = (b.R_MH @ b.t[:, :, None])[..., 0]
        return b.G_H, -b.G_H @ skew(lever), t_MH
    if base == "M":
        place = -(np.swapaxes(b.R_MH, 1, 2) @ t_MH[:, :, None])[..., 0]
        G = b.G_H @ b.R_MH
        return G, -G @ skew(b.t - place), place
    raise InputError(f"base is {base!r}; 'H' (the ball moves) or 'M' (the ball stands still) is needed")


def _components(problem: Problem, b: ProjectionBlocks, base: str, length: float) -> list[Array]:
    """The four (2n, 2n) matrices that the four variances multiply."""
    G, L, x = _lever_blocks(b, problem.t_MH, base)
    n = len(problem)
    distance = np.linalg.norm(x[:, None] - x[None], axis=2)
    parts = []
    for share in (np.eye(n), np.exp(-distance / length)):
        parts += [
            (np.einsum("kia,lja->kilj", D, D) * share[:, None, :, None]).reshape(2 * n, 2 * n) for D in (G, L)
        ]
    return parts


def _detection(problem: Problem) -> Array:
    n = len(problem)
    V = np.zeros((n, 2, n, 2))
    k = np.arange(n)
    V[k, :, k, :] = problem.covariance
    return V.reshape(2 * n, 2 * n)


def field_covariance(problem: Problem, free: FreeParameters, fit: Fit, field: PoseField) -> Array:
    """V (2n, 2n) px^2 of all centres together."""
    parts = _components(problem, blocks(problem, free, fit), field.base, field.length)
    sigma = (field.translation, field.rotation, field.field_translation, field.field_rotation)
    return _detection(problem) + sum((s**2 * part for s, part in zip(sigma, parts, strict=True)), np.zeros(1))


def estimate_pose_field(
    problems: Sequence[Problem], free: FreeParameters, fits: Sequence[Fit], *, length: float, base: str = "H"
) -> PoseField:
    """The four standard deviations from several fits of the same machine, one ball each, at a given length (mm)."""
    data = []
    for problem, fit in zip(problems, fits, strict=True):
        b = blocks(problem, free, fit)
        J = jacobian(problem, free, b).reshape(2 * len(problem), -1)
        r = (problem.x_D - b.x_D).ravel()
        data.append((J / np.linalg.norm(J, axis=0), r, _detection(problem), _components(problem, b, base, length)))
    # starts: each kind of error alone explaining the residuals
    size = np.array([
        np.sqrt(np.mean([(r @ r) / np.trace(parts[i]) for _, r, _, parts in data])) for i in range(4)
    ])

    def objective(q: Array) -> float:
        if np.max(np.abs(q)) > 9.0:
            return 1e12
        total = 0.0
        variance = (size * np.exp(q)) ** 2
        for J, r, V_0, parts in data:
            V = V_0 + sum((v * part for v, part in zip(variance, parts, strict=True)), np.zeros(1))
            root = np.linalg.cholesky(V)
            Jw, rw = np.linalg.solve(root, J), np.linalg.solve(root, r)
            N, g = Jw.T @ Jw, Jw.T @ rw
            total += 2 * np.log(np.diag(root)).sum() + np.linalg.slogdet(N)[1] + rw @ rw - g @ np.linalg.solve(N, g)
        return float(total)

    found = [
        minimize(objective, start, method="Nelder-Mead",
                 options={"xatol": 2e-2, "fatol": 1e-2 * len(data), "maxiter": EVALUATIONS, "adaptive": True})
        for start in ([-1.0, -1.0, -0.7, -3.0], [-1.5, -0.7, -3.0, -0.7])
    ]
    s = size * np.exp(min(found, key=lambda result: float(result.fun)).x)
    return PoseField(
        translation=float(s[0]), rotation=float(s[1]), field_translation=float(s[2]), field_rotation=float(s[3]),
        length=length, base=base,
    )


def solve_with_field(problem: Problem, free: FreeParameters, start: Fit, field: PoseField) -> tuple[Fit, Array]:
    """(fit, covariance (m, m)) by generalised least squares, damped, from a start.

    Raises NotConvergedError.
    """
    root: Array = np.asarray(np.linalg.cholesky(field_covariance(problem, free, start, field)), dtype=np.float64)
    m, n_b = 6 + start.t.size + len(free), len(start.t)
    prior = np.zeros((m, m))
    prior[m - len(free):, m - len(free):] = np.diag(free.information)
    fit, damping = start, 1e-3
    b, rw, chi2 = _whitened(problem, free, fit, root)
    for _ in range(ITERATIONS):
        J = np.linalg.solve(root, jacobian(problem, free, b).reshape(-1, m))
        N = J.T @ J + prior
        g = J.T @ rw
        g[m - len(free):] -= free.information * fit.delta
        step = np.asarray(np.linalg.solve(N + damping * np.diag(np.diag(N)), g), dtype=np.float64)
        trial = replace(
            fit, R_HT=exp_rotation(step[:3]) @ fit.R_HT, t_HT=fit.t_HT + step[3:6],
            t=fit.t + step[6:6 + 3 * n_b].reshape(n_b, 3), delta=fit.delta + step[6 + 3 * n_b:],
        )
        b_new, r_new, chi2_new = _whitened(problem, free, trial, root)
        if chi2_new <= chi2:
            small = step @ N @ step < 1e-12
            fit, b, rw, chi2, damping = trial, b_new, r_new, chi2_new, max(damping / 10, 1e-12)
            if small:
                return replace(fit, chi2=chi2, converged=True, N=N), inverse_information(N)
        else:
            damping *= 10
            if damping > 1e12:
                return replace(fit, chi2=chi2, converged=True, N=N), inverse_information(N)
    raise NotConvergedError("generalised least squares with a shared pose error found no optimum")


def _whitened(problem: Problem, free: FreeParameters, fit: Fit, root: Array) -> tuple[ProjectionBlocks, Array, float]:
    b = blocks(problem, free, fit)
    rw = np.asarray(np.linalg.solve(root, (problem.x_D - b.x_D).ravel()), dtype=np.float64)
    return b, rw, float(rw @ rw + (free.information * fit.delta**2).sum())
