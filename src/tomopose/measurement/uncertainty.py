"""Uncertainty beyond the scatter of one surface: the calibration's share, and simulation after JCGM 101.

A wrong projection matrix moves what is reconstructed: a point x is projected by the matrices as they were, and found
again where the matrices as they are believed see it, by least squares over all views.  Matrices drawn from a
calibration's covariance so become a covariance of points, without reconstructing anything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.units import Array

GAUSS_NEWTON = 4


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """Result of a simulation: mean, u, shortest 95 % interval, number of runs, whether the tolerance was met, seed.

    u_fit, dof_fit: what the virtual measurements' own fits state, rms, and its degrees of freedom; nan and 0 where they
    state nothing;  with_calibration: whether calibrations were drawn too.
    """

    mean: float
    u: float
    low: float
    high: float
    runs: int
    stable: bool
    seed: int
    u_fit: float = math.nan
    dof_fit: float = 0.0
    with_calibration: bool = False


def displaced(P_used: Array, P_true: Array, points: Array) -> Array:
    """Where points (m, 3), mm, are reconstructed, (m, 3): seen by P_true (n, 3, 4), placed by P_used (n, 3, 4).

    Least squares of pixels over all views, all pixels weighing alike.  ShapeError for arrays that do not fit,
    InputError where the views do not fix a point.
    """
    x = np.asarray(points, dtype=np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or P_used.shape != P_true.shape or P_used.shape[1:] != (3, 4):
        raise ShapeError(
            f"points (m, 3) and two sets of (n, 3, 4) matrices; got {x.shape}, {P_used.shape}, {P_true.shape}"
        )
    seen = _pixels(P_true, x)[0]
    found = x.copy()
    for _ in range(GAUSS_NEWTON):
        shown, J = _pixels(P_used, found)
        gram = np.einsum("nmci,nmcj->mij", J, J)
        if float(np.max(np.linalg.cond(gram))) > 1e10:
            raise InputError(f"{len(P_used)} views do not fix a point in space; give views from more directions")
        found = found + np.linalg.solve(gram, np.einsum("nmci,nmc->mi", J, seen - shown)[..., None])[..., 0]
    return found


def _pixels(P: Array, x: Array) -> tuple[Array, Array]:
    """Pixels (n, m, 2) and their derivatives (n, m, 2, 3) of points (m, 3) in n views."""
    h = np.einsum("nij,mj->nmi", P[:, :, :3], x) + P[:, None, :, 3]
    uv = h[..., :2] / h[..., 2:]
    J = (P[:, None, :2, :3] - uv[..., None] * P[:, None, 2:, :3]) / h[..., 2, None, None]
    return uv, J


def points_covariance(P_used: Array, P_samples: Iterable[Array], points: Array) -> Array:
    """Covariance (3 m, 3 m), mm^2, of reconstructed points (m, 3) from matrices drawn from a calibration's covariance.

    P_samples: (n, 3, 4) each, at least ten.
    """
    moved = np.array([(displaced(P_used, P, points) - points).ravel() for P in P_samples])
    if len(moved) < 10:
        raise InputError(f"{len(moved)} samples of the matrices; at least 10 are needed for a covariance")
    return np.atleast_2d(np.cov(moved, rowvar=False))


def distance_uncertainty(covariance: Array, points: Array, i: int, j: int) -> float:
    """Standard uncertainty, mm, of the distance of points i and j, from their joint covariance (3 m, 3 m)."""
    d = points[j] - points[i]
    g = np.zeros(3 * len(points))
    g[3 * j : 3 * j + 3] = d / np.linalg.norm(d)
    g[3 * i : 3 * i + 3] = -d / np.linalg.norm(d)
    return float(np.sqrt(max(float(g @ covariance @ g), 0.0)))


def shortest_interval(values: Array, share: float = 0.95) -> tuple[float, float]:
    """The shortest interval that holds `share` of the values (JCGM 101:2008, 5.3.4)."""
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    inside = max(int(np.ceil(share * len(ordered))), 1)
    width = ordered[inside - 1 :] - ordered[: len(ordered) - inside + 1]
    k = int(np.argmin(width))
    return float(ordered[k]), float(ordered[k + inside - 1])


def simulate(
    model: Callable[[np.random.Generator], float],
    *,
    tolerance: float,
    seed: int = 0,
    block: int = 100,
    most: int = 10_000,
    progress: Callable[[int, int], None] | None = None,
) -> Simulated:
    """Adaptive simulation (JCGM 101:2008, 7.9): blocks of runs until mean, u and both ends of the interval are stable.

    model: one virtual measurement with the given random numbers; run k always gets the same ones.
    tolerance: twice the standard error of each of the four over the blocks stays below it, in the model's unit.
    """
    if not tolerance > 0 or block < 20 or most < 2 * block:
        raise InputError(
            f"tolerance {tolerance}, block {block}, most {most}: a positive tolerance and two blocks of 20 are needed"
        )
    values: list[float] = []
    facts: list[tuple[float, float, float, float]] = []
    stable = False
    while len(values) + block <= most and not stable:
        seeds = [np.random.SeedSequence([seed, len(values) + k]) for k in range(block)]
        new = [float(model(np.random.default_rng(s))) for s in seeds]
        if not np.isfinite(new).all():
            raise InputError("a virtual measurement gave no finite value")
        values += new
        facts.append((float(np.mean(new)), float(np.std(new, ddof=1)), *shortest_interval(np.array(new))))
        if progress is not None:
            progress(len(values), most)
        if len(facts) >= 2:
            stable = bool((2 * np.std(facts, axis=0, ddof=1) / np.sqrt(len(facts)) < tolerance).all())
    low, high = shortest_interval(np.array(values))
    return Simulated(
        mean=float(np.mean(values)),
        u=float(np.std(values, ddof=1)),
        low=low,
        high=high,
        runs=len(values),
        stable=stable,
        seed=seed,
    )
