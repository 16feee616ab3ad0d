"""The standard uncertainty of each feature that a set of views lets expect.

A ray that grazes the surface at x_i with incidence g_ij = |n . d| sees a shift delta along the normal as a change
mu delta / g_ij of the line integral, whose variance is

    var_ij = 1 / (N_0 tau_ij) + (r / (N_0 tau_ij))^2

with N_0 quanta of an open pixel and readout noise r.  g is at least s_0 = max(sqrt(w / 2 R), w / l): the ray has a
width w at the object, the surface a radius R or a length l.  A patch of area a is crossed by a g / w^2 independent
rays, so that the information on the position of the surface there, and that on the feature's parameters, are

    I_i = sum_j (a g_ij / w^2) (mu / g_ij)^2 / var_ij        A = sum_i I_i J_i J_i^T

This is a Cramer-Rao bound with all else known, therefore optimistic; ratios between sets of views are what it is good
for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tomopose.geometry.scanner import Scanner
from tomopose.measurement.plan import MeasurandPlan
from tomopose.planning.part.targets import Target
from tomopose.planning.part.worth import Goal, Views
from tomopose.trajectory.completeness import source_path
from tomopose.units import Array

SINGULAR = 1e-12


@dataclass(frozen=True, kw_only=True)
class Predicted:
    """u: mm, of the feature's position along its normal (the largest over the directions that it has);
    u_size: mm, of its radius, nan where it has none;  views: how many see it at a point, the median;
    without_best: seen share if the view that shows most of it were lost."""

    name: str
    seen_share: float
    u: float
    u_size: float
    views: float
    without_best: float


def ray_width(scanner: Scanner, blur: float, depth: Array) -> Array:
    """mm at the object: pixel and unsharpness (px), scaled to the depth."""
    width: Array = np.hypot(1.0, 2 * blur) * scanner.p_u * depth / scanner.d_SD
    return width


def information(goal: Goal, scanner: Scanner, P: Array, views: Views, target: Target) -> Array:
    """(m,) of the target's points, 1/mm^2."""
    rows, s = goal.rows[target.name], goal.settings
    tau = np.maximum(views.tau[:, rows].astype(np.float64), 1e-12)
    depth = np.einsum("jc,mc->jm", P[:, 2, :3], target.x) + P[:, 2, 3:]
    w = ray_width(scanner, s.blur, depth)
    least = np.maximum(np.sqrt(w / (2 * target.radius)), w / target.length)
    g = np.maximum(np.maximum(views.incidence[:, rows].astype(np.float64), least), 1e-4)
    count = s.quanta * tau
    var = 1 / count + (s.readout / count) ** 2
    useful = tau >= s.least_transmission
    return np.asarray((useful * target.area * s.mu**2 / (g * w**2 * var)).sum(axis=0))


def predicted(goal: Goal, scanner: Scanner, P: Array, views: Views, *, shared: Array | None = None) -> list[Predicted]:
    """Of each target.  shared: (targets,) mm, what the calibration adds to each, in quadrature."""
    out = []
    for k, target in enumerate(goal.targets):
        seen = views.A[:, goal.rows[target.name]] > 0
        times = seen.sum(axis=0)
        u, u_size = _of_parameters(target, information(goal, scanner, P, views, target))
        own = 0.0 if shared is None else float(shared[k])
        lonely = seen & (times == 1)
        out.append(
            Predicted(
                name=target.name,
                seen_share=float((times > 0).mean()),
                u=float(np.hypot(u, own)),
                u_size=u_size,
                views=float(np.median(times)),
                without_best=float((times > 0).mean() - lonely.mean(axis=1).max(initial=0.0)),
            )
        )
    return out


def _of_parameters(target: Target, I: Array) -> tuple[float, float]:
    """(u of the position, u of the radius), mm."""
    J = target.derivatives()
    if target.shape is None and target.kind not in ("plane", "line"):
        mean = float(I.mean())
        return (float(1 / np.sqrt(mean)) if mean > 0 else float("inf")), float("nan")
    N = np.einsum("m,mp,mq->pq", I, J, J)
    size = np.sqrt(np.maximum(np.diag(N), 1e-300))
    value, vector = np.linalg.eigh(N / np.outer(size, size))
    if value[0] <= SINGULAR * max(value[-1], 1e-300):
        return float("inf"), float("inf") if target.shape is not None else float("nan")
    C = (vector / value) @ vector.T / np.outer(size, size)
    if target.shape is None:
        return float(np.sqrt(C[0, 0])), float("nan")
    axes = {"sphere": (3, 3), "circle": (2, 2), "cylinder": (2, 4), "cone": (2, 4)}[target.shape.kind]
    u = float(np.sqrt(np.linalg.eigvalsh(C[: axes[0], : axes[0]])[-1]))
    return u, float(np.sqrt(C[axes[1], axes[1]]))


def shared_part(goal: Goal, scanner: Scanner, P: Array, sigma_px: Array) -> Array:
    """(targets,) mm: the calibration's shared standard uncertainty in px at points, (targets,), at the object."""
    depth = np.array([np.mean(P[:, 2, :3] @ t.x.mean(axis=0) + P[:, 2, 3]) for t in goal.targets])
    return np.asarray(sigma_px * scanner.p_u * depth / scanner.d_SD)


def measurand_u(measurands: Sequence[MeasurandPlan], found: Sequence[Predicted]) -> dict[str, float]:
    """Standard uncertainty, mm, of the diameters and distances of a plan; other kinds are not predicted."""
    by = {p.name: p for p in found}
    out = {}
    for m in measurands:
        if m.kind == "diameter" and m.of[0] in by:
            out[m.name] = 2 * by[m.of[0]].u_size
        elif m.kind == "distance" and all(f in by for f in m.of):
            out[m.name] = float(np.hypot(by[m.of[0]].u, by[m.of[1]].u))
    return out


def why_unseen(goal: Goal, P: Array, views: Views, target: Target) -> str:
    """In words, why no candidate sees some of a target's points, and which further tilt would."""
    rows, s = goal.rows[target.name], goal.settings
    hidden = np.flatnonzero(views.A[:, rows].max(axis=0) == 0)
    angle = np.degrees(np.arcsin(np.clip(views.incidence[:, rows][:, hidden], 0, 1)))
    least = angle.min(axis=0)
    grazed = least <= np.degrees(s.tangent)
    if grazed.mean() > 0.5:
        tau = np.where(angle <= np.degrees(s.tangent), views.tau[:, rows][:, hidden], 0.0).max(axis=0)
        L = -np.log(np.maximum(np.median(tau[grazed]), 1e-300)) / s.mu
        return (
            f"the rays along it pass through {L:.3g} mm of material (transmission {np.median(tau[grazed]):.2g}, "
            f"{s.least_transmission:g} is needed): a higher voltage, or another placing of the part"
        )
    k = int(hidden[int(least.argmax())])
    d = target.x[k] - source_path(P)[int(views.incidence[:, rows][:, k].argmin())]
    d /= np.linalg.norm(d)
    turn = np.cross(d, target.n[k])
    turn /= max(float(np.linalg.norm(turn)), 1e-12)
    return (
        f"no ray comes nearer to its tangent plane than {least.max():.3g} deg: tilt the fixture by "
        f"{max(least.max() - np.degrees(s.tangent), 0.0):.3g} deg about ({turn[0]:.2f}, {turn[1]:.2f}, {turn[2]:.2f}), "
        "or allow more tilt"
    )
