"""What a set of views is worth: J = 0.5 C + 0.3 T + 0.2 M.

C, coverage: mean over the features of the share of points that a view sees, that is: the ray lies within `tangent` of
the surface's tangent plane and is transmitted by at least `least_transmission`.  An edge is localised by the rays that
graze it.
T, soft completeness: mean over points and planes of max_j exp(-beta^2 / (2 width^2)) min(1, tau / least_transmission),
beta the angle between the ray and the plane (Tuy's condition, graded).
M, transmission: mean of tau over views and all those points.
C and T are of the form sum_e w_e max_j a_je, and M is a sum over views: J is monotone and submodular.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tomopose.planning.part.material_paths import material_paths
from tomopose.planning.part.part import Part
from tomopose.planning.part.settings import LIFT_MM, WEIGHTS, PartSettings
from tomopose.planning.part.targets import Target
from tomopose.trajectory.completeness import source_path
from tomopose.units import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Goal:
    """What views are judged by.

    targets, x_tuy (k, 3) mm, planes (q, 3);  w (E,): weight in J of each point seen and of each plane at each point,
    the points of all targets first.
    """

    part: Part
    targets: tuple[Target, ...]
    x_tuy: Array
    planes: Array
    settings: PartSettings

    @cached_property
    def x(self) -> Array:
        """(m, 3) points of all targets, mm."""
        return np.concatenate([t.x for t in self.targets])

    @cached_property
    def n(self) -> Array:
        """(m, 3) their normals."""
        return np.concatenate([t.n for t in self.targets])

    @property
    def rows(self) -> dict[str, slice]:
        """Which of the points belong to each target."""
        ends = np.cumsum([0, *(len(t.x) for t in self.targets)])
        return {t.name: slice(int(a), int(b)) for t, a, b in zip(self.targets, ends[:-1], ends[1:], strict=True)}

    @cached_property
    def w(self) -> Array:
        seen = [np.full(len(t.x), WEIGHTS[0] / len(self.targets) / len(t.x)) for t in self.targets]
        elements = len(self.x_tuy) * len(self.planes)
        return np.concatenate([*seen, np.full(elements, WEIGHTS[1] / elements)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """Tables of n views for one goal.

    P (n, 3, 4): their matrices, part at home to pixels.
    A (n, E) float32: what each view gives to each element, 0 to 1;  tau (n, m + k) float32: transmission at the points
    of the targets and of Tuy's condition;  incidence (n, m) float32: |n . d| of the points of the targets.
    """

    P: Array
    A: np.ndarray
    tau: np.ndarray
    incidence: np.ndarray

    @property
    def M(self) -> Array:
        """(n,) mean transmission of each view."""
        return np.asarray(self.tau.mean(axis=1), dtype=np.float64)

    def take(self, rows: np.ndarray) -> Views:
        return Views(P=self.P[rows], A=self.A[rows], tau=self.tau[rows], incidence=self.incidence[rows])


@dataclass(frozen=True, kw_only=True)
class Worth:
    """Of a set of views: J, C, T, M; the worst transmission that the used rays keep; seen: share by target.

    worst_point: mm in W, the point of Tuy's condition with the most incomplete planes;  gap: rad, the largest angle
    between a plane at a point and the nearest ray.
    """

    J: float
    C: float
    T: float
    M: float
    worst_transmission: float
    worst_point: tuple[float, float, float]
    gap: float
    seen: dict[str, float]


def table(goal: Goal, P: Array) -> Views:
    """The tables of views with matrices P (n, 3, 4), points of the part at home to pixels."""
    s, settings = source_path(P), goal.settings
    x, n, k = goal.x, goal.n, len(goal.x_tuy)
    lifted = np.concatenate([x + LIFT_MM * n, goal.x_tuy])
    L, _ = material_paths(P, goal.part.mesh.points, goal.part.mesh.faces, lifted)
    tau = np.exp(-settings.mu * np.maximum(L, 0.0)).astype(np.float32)
    d = x[None] - s[:, None]
    incidence = np.abs(np.einsum("jmc,mc->jm", d, n)) / np.linalg.norm(d, axis=2)
    A = np.empty((len(P), len(x) + k * len(goal.planes)), dtype=np.float32)
    A[:, : len(x)] = (incidence <= np.sin(settings.tangent)) & (tau[:, : len(x)] >= settings.least_transmission)
    A[:, len(x) :] = _tuy(goal, s, tau[:, len(x) :]).reshape(len(P), -1)
    return Views(P=P, A=A, tau=tau, incidence=incidence.astype(np.float32))


def _beta(goal: Goal, s: Array) -> Array:
    """(n, k, q) rad: angle between the ray through each point and each plane."""
    d = goal.x_tuy[None] - s[:, None]
    d /= np.linalg.norm(d, axis=2)[..., None]
    beta: Array = np.arcsin(np.clip(np.abs(d.astype(np.float32) @ goal.planes.T.astype(np.float32)), 0, 1))
    return beta


def _tuy(goal: Goal, s: Array, tau: np.ndarray) -> np.ndarray:
    enough = np.minimum(1.0, tau / goal.settings.least_transmission)
    out = np.empty((len(s), len(goal.x_tuy), len(goal.planes)), dtype=np.float32)
    for j in range(0, len(s), 256):  # in blocks: the angles of all views at once would need gigabytes
        beta = _beta(goal, s[j : j + 256])
        out[j : j + 256] = np.exp(-0.5 * (beta / goal.settings.tuy_width) ** 2) * enough[j : j + 256, :, None]
    return out


def worth(goal: Goal, P: Array, views: Views | None = None) -> Worth:
    """What the views with matrices P (n, 3, 4) are worth together."""
    v = table(goal, P) if views is None else views
    best, m = v.A.max(axis=0).astype(np.float64), len(goal.x)
    shares = {name: float(best[rows].mean()) for name, rows in goal.rows.items()}
    by_point = best[m:].reshape(len(goal.x_tuy), -1)
    C, T, M = float(np.mean(list(shares.values()))), float(by_point.mean()), float(v.M.mean())
    nearest = np.full((len(goal.x_tuy), len(goal.planes)), np.inf)
    s = source_path(P)
    for j in range(0, len(s), 256):
        nearest = np.minimum(nearest, _beta(goal, s[j : j + 256]).min(axis=0))
    worst = goal.x_tuy[int(by_point.mean(axis=1).argmin())]
    return Worth(
        J=WEIGHTS[0] * C + WEIGHTS[1] * T + WEIGHTS[2] * M,
        C=C,
        T=T,
        M=M,
        worst_transmission=float(v.tau.min()),
        worst_point=(float(worst[0]), float(worst[1]), float(worst[2])),
        gap=float(nearest.max()),
        seen=shares,
    )
