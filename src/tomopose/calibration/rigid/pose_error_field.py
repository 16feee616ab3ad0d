r"""Pose errors that neighbouring poses share, beside the scatter of single poses.

A robot that is wrong by 0.3 mm is wrong by nearly the same at nearly the same pose.  Poses close to each other
then repeat an error instead of averaging it, and a covariance that takes them as independent is too small.  Here a
pose's error is a random field over the place x_k and the orientation R_k of the moving part:

    cov(k, l) = diag(translation^2, rotation^2) delta_kl
                + diag(field_translation^2, field_rotation^2) exp(-|x_k - x_l| / length - |log R_k R_l^T| / angle)

with translations along the axes of the base and rotations about the moving part's origin.  Standard deviations, length
and angle maximise the restricted likelihood (see `pose_noise`).  Balls seen in the same images share the errors of
their poses: given as one problem with several balls they determine the field far better than one ball does.  Problems
given side by side count as taken at different times, with errors of their own.  The estimate is generalised least
squares with the full covariance of the centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from tomopose.calibration.model.ball_projection import ProjectionBlocks
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.parameters import FreeParameters
from tomopose.calibration.model.problem import Problem
from tomopose.calibration.rigid.fit import Fit, blocks, jacobian
from tomopose.errors import InputError, NotConvergedError
from tomopose.geometry.rotations import exp_rotation, rotation_angle_between, skew
from tomopose.least_squares import Status, least_squares
from tomopose.units import Array

ITERATIONS = 200
STEP_TOLERANCE = 1e-8
"""Of a step, in standard deviations: the estimate then holds to more digits than anyone reads."""
EVALUATIONS = 400
BOUND = 12.0
"""Largest logarithm of a component against its unit that the search tries."""


@dataclass(frozen=True, kw_only=True)
class PoseField:
    """Standard deviations, a coordinate each: of single poses (mm, rad) and of the shared field (mm, rad), its length
    (mm) and angle (rad), and which part does not move: "H" (the ball moves with M; places are t_MH) or "M" (M is the
    base and H moves, as with a camera or source on a robot; places are those of H's origin in M)."""

    translation: float
    rotation: float
    field_translation: float
    field_rotation: float
    length: float
    angle: float = np.inf
    base: str = "H"


def _place(R_MH: Array, t_MH: Array, base: str) -> Array:
    """(n, 3) mm: where the moving part's origin is in the base."""
    if base == "H":
        return t_MH
    if base == "M":
        return -(np.swapaxes(R_MH, 1, 2) @ t_MH[:, :, None])[..., 0]
    raise InputError(f"base is {base!r}; 'H' (the ball moves) or 'M' (the ball does not move) is needed")


def lever_blocks(b: ProjectionBlocks, t_MH: Array, base: str) -> tuple[Array, Array, Array]:
    """(G, L, x): derivatives (n, 2, 3) of the centres by a pose's translation and rotation error along the base's axes,
    and the moving part's place (n, 3)."""
    place = _place(b.R_MH, t_MH, base)
    if base == "H":
        lever = (b.R_MH @ b.t[:, :, None])[..., 0]
        return b.G_H, -b.G_H @ skew(lever), place
    G = b.G_H @ b.R_MH
    return G, -G @ skew(b.t - place), place


def _closeness(problem: Problem, place: Array) -> tuple[Array, Array, Array]:
    """(n, n) each: 1 for rows of one pose; the way (mm) and the turn (rad) between poses."""
    same = (problem.run[:, None] == problem.run) & (problem.index[:, None] == problem.index)
    turn = np.array([rotation_angle_between(R, problem.R_MH) for R in problem.R_MH])
    return same.astype(np.float64), np.linalg.norm(place[:, None] - place[None], axis=2), turn


def _shares(closeness: tuple[Array, Array, Array], field: PoseField) -> tuple[Array, Array]:
    same, way, turn = closeness
    near = np.exp(-way / field.length - turn / field.angle)
    return (
        field.translation**2 * same + field.field_translation**2 * near,
        field.rotation**2 * same + field.field_rotation**2 * near,
    )


def field_shares(problem: Problem, field: PoseField) -> tuple[Array, Array]:
    """(n, n) mm^2 and (n, n) rad^2: covariance of one coordinate of the poses' errors in translation and rotation."""
    return _shares(_closeness(problem, _place(problem.R_MH, problem.t_MH, field.base)), field)


def _covariance(detection: Array, G: Array, L: Array, shares: tuple[Array, Array]) -> Array:
    V = detection.copy()
    for D, share in zip((G, L), shares, strict=True):
        rows = D.reshape(-1, 3)
        V += (rows @ rows.T) * np.repeat(np.repeat(share, 2, axis=0), 2, axis=1)
    return V


def _detection(problem: Problem) -> Array:
    n = len(problem)
    V = np.zeros((n, 2, n, 2))
    k = np.arange(n)
    V[k, :, k, :] = problem.covariance
    return V.reshape(2 * n, 2 * n)


def field_covariance(problem: Problem, free: FreeParameters, fit: Fit, field: PoseField) -> Array:
    """V (2n, 2n) px^2 of all centres together."""
    G, L, _ = lever_blocks(blocks(problem, free, fit), problem.t_MH, field.base)
    return _covariance(_detection(problem), G, L, field_shares(problem, field))


def _restricted(V: Array, J: Array, r: Array) -> float:
    """-2 log of the restricted likelihood of residuals r with Jacobian J and covariance V."""
    root = np.linalg.cholesky(V)
    W = solve_triangular(root, np.column_stack([J, r]), lower=True, check_finite=False)
    Jw, rw = W[:, :-1], W[:, -1]
    N, g = Jw.T @ Jw, Jw.T @ rw
    return float(2 * np.log(np.diag(root)).sum() + np.linalg.slogdet(N)[1] + rw @ rw - g @ np.linalg.solve(N, g))


def estimate_pose_field(
    problems: Sequence[Problem],
    free: FreeParameters,
    fits: Sequence[Fit],
    *,
    length: float | None = None,
    angle: float | None = np.inf,
    base: str = "H",
) -> PoseField:
    """The field from fits of the same machine.

    length (mm), angle (rad): over which a shared error is forgotten; None estimates it too, inf lets it not matter.
    """
    data = []
    for problem, fit in zip(problems, fits, strict=True):
        b = blocks(problem, free, fit)
        J = jacobian(problem, free, b).reshape(2 * len(problem), -1)
        G, L, place = lever_blocks(b, problem.t_MH, base)
        data.append(
            (
                J / np.linalg.norm(J, axis=0),
                (problem.x_D - b.x_D).ravel(),
                _detection(problem),
                G,
                L,
                _closeness(problem, place),
            )
        )
    squares = float(np.mean([r @ r for _, r, *_ in data]))
    # units of the search: each kind of error alone explaining the residuals; the largest way and turn of the poses
    levers = zip(*((G, L) for *_, G, L, _ in data), strict=True)
    size = [np.sqrt(squares / np.mean([(D**2).sum() for D in column])) for column in levers]
    way, turn = (max(float(near[i].max()) for *_, near in data) for i in (1, 2))

    def field(q: Array) -> PoseField:
        s, rest = np.exp(q), list(np.exp(q[4:]))
        return PoseField(
            translation=float(size[0] * s[0]),
            rotation=float(size[1] * s[1]),
            base=base,
            field_translation=float(size[0] * s[2]),
            field_rotation=float(size[1] * s[3]),
            length=float(way * rest.pop(0)) if length is None else length,
            angle=float(turn * rest.pop(0)) if angle is None else angle,
        )

    def objective(q: Array) -> float:
        if np.max(np.abs(q)) > BOUND:
            return 1e12
        at = field(q)
        return sum(_restricted(_covariance(V, G, L, _shares(near, at)), J, r) for J, r, V, G, L, near in data)

    lengths = [0.5] * ((length is None) + (angle is None))
    found = [
        minimize(
            objective,
            [*start, *lengths],
            method="Nelder-Mead",
            options={"xatol": 2e-2, "fatol": 1e-2 * len(data), "maxiter": EVALUATIONS, "adaptive": True},
        )
        for start in ([-1.0, -1.0, -0.7, -3.0], [-1.5, -0.7, -3.0, -0.7])
    ]
    return field(min(found, key=lambda result: float(result.fun)).x)


def solve_with_field(problem: Problem, free: FreeParameters, start: Fit, field: PoseField) -> tuple[Fit, Array]:
    """(fit, covariance (m, m)) by generalised least squares, damped, from a start.

    Raises NotConvergedError.
    """
    root: Array = np.asarray(np.linalg.cholesky(field_covariance(problem, free, start, field)), dtype=np.float64)
    m, n_b = 6 + start.t.size + len(free), len(start.t)
    held = np.sqrt(free.information)
    prior = np.concatenate([np.zeros((len(free), m - len(free))), np.diag(held)], axis=1)

    def rows(fit: Fit) -> tuple[Array, Array]:
        b = blocks(problem, free, fit)
        r = np.linalg.solve(root, (problem.x_D - b.x_D).ravel())
        J = np.linalg.solve(root, jacobian(problem, free, b).reshape(-1, m))
        return np.concatenate([r, -held * fit.delta]), np.concatenate([J, prior])

    def moved(fit: Fit, step: Array) -> Fit:
        return replace(
            fit,
            R_HT=exp_rotation(step[:3]) @ fit.R_HT,
            t_HT=fit.t_HT + step[3:6],
            t=fit.t + step[6 : 6 + 3 * n_b].reshape(n_b, 3),
            delta=fit.delta + step[6 + 3 * n_b :],
        )

    found = least_squares(rows, moved, start, steps=ITERATIONS, tolerance=STEP_TOLERANCE)
    if not found.status.at_rest:
        raise NotConvergedError(f"generalised least squares with a shared pose error: {found.status.value}")
    N = found.J.T @ found.J
    return replace(found.state, chi2=found.cost, status=Status.CONVERGED, N=N), inverse_information(N)
