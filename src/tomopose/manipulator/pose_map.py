r"""A smooth map of pose errors for manipulators whose kinematics nobody knows.

The real plate is off its commanded pose (R, t) by a turn w and a shift s in H that are polynomials of low order in
the six pose coordinates x = (t / t_scale, log R / w_scale):

    (w, s) = sum_j c_j phi_j(x),   phi = x_i (order 1), and x_i x_j (order 2).

A constant belongs to T_HT and is left out.  Every coefficient has the prior standard deviation w_sigma or t_sigma over
the root of the number of terms, so that the map as a whole has about that size at the edge of the calibrated range,
times the factor of its group: the terms of one order and one kind of coordinate (shifts, turns, both), which one cause
makes alike, separately for the two kinds of output.

One ball sees a turn w of the plate only as the shift w x R t of its centre, which a shift s imitates: without
kinematics the turns are not determined by one ball, and this model says so by its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.rotations import log_rotation
from tomopose.geometry.transforms import moved
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import RealPoses, Repeatability, left_jacobian
from tomopose.units import Array

COORDINATES = ("x", "y", "z", "wx", "wy", "wz")
OUTPUTS = ("w_x", "w_y", "w_z", "t_x", "t_y", "t_z")
GROUPS = ("shift", "turn", "shift*shift", "shift*turn", "turn*turn")


@dataclass(frozen=True, kw_only=True)
class PoseMap:
    """order: 1 or 2.  t_scale (mm), w_scale (rad): half the calibrated range.  t_sigma (mm), w_sigma (rad): size of
    the errors expected.  factors: of each group's turns, then of each group's shifts (GROUPS of the order), or None."""

    order: int = 2
    t_scale: float = 10.0
    w_scale: float = float(np.radians(5.0))
    t_sigma: float = 0.1
    w_sigma: float = 1e-3
    factors: tuple[float, ...] | None = None
    repeatability: Repeatability = field(default_factory=Repeatability)

    kind = "map"

    def __post_init__(self) -> None:
        if self.order not in (1, 2):
            raise InputError(f"a pose-error map of order {self.order!r} is not offered; 1 and 2 are")
        for name in ("t_scale", "w_scale", "t_sigma", "w_sigma"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"pose map: {name} is {getattr(self, name)}; a positive number is needed")
        factors = np.ones(2 * self.group_count) if self.factors is None else np.asarray(self.factors, dtype=np.float64)
        if factors.shape != (2 * self.group_count,) or not (np.isfinite(factors).all() and (factors > 0).all()):
            raise InputError(f"pose map: factors are {self.factors}; {2 * self.group_count} numbers > 0 are needed")
        object.__setattr__(self, "factors", tuple(factors.tolist()))

    @property
    def group_count(self) -> int:
        """Groups of terms; there are as many for the turns and for the shifts."""
        return 2 if self.order == 1 else len(GROUPS)

    @property
    def groups(self) -> Any:
        """(m,) int: the factor that each coefficient has."""
        one = ["*".join("shift" if i < 3 else "turn" for i in term) for term in self._terms]
        of = np.array([GROUPS.index(name) for name in one])
        return (of[:, None] + np.repeat([0, self.group_count], 3)).ravel()

    @property
    def _terms(self) -> tuple[tuple[int, ...], ...]:
        return tuple(t for k in range(1, self.order + 1) for t in combinations_with_replacement(range(6), k))

    @property
    def names(self) -> tuple[str, ...]:
        terms = ["*".join(COORDINATES[i] for i in term) for term in self._terms]
        return tuple(f"map_{out}[{term}]" for term in terms for out in OUTPUTS)

    @property
    def units(self) -> tuple[str, ...]:
        return ("rad", "rad", "rad", "mm", "mm", "mm") * len(self._terms)

    @property
    def sigma(self) -> Array:
        one = np.repeat([self.w_sigma, self.t_sigma], 3) / np.sqrt(len(self._terms))
        result: Array = np.tile(one, len(self._terms)) * np.asarray(self.factors)[self.groups]
        return result

    def features(self, poses: PoseSequence) -> Array:
        """phi (n, terms)."""
        x = np.concatenate([poses.T_MH.t / self.t_scale, log_rotation(poses.T_MH.R) / self.w_scale], axis=1)
        return np.stack([np.prod(x[:, list(term)], axis=1) for term in self._terms], axis=1)

    def real_poses(self, poses: PoseSequence, p: Array) -> RealPoses:
        """Where the real plate is for commanded `poses`, and its derivative by the coefficients p."""
        p = np.asarray(p, dtype=np.float64)
        phi = self.features(poses)
        if p.shape != (6 * phi.shape[1],):
            raise ShapeError(f"this map has {6 * phi.shape[1]} coefficients; got {p.shape}")
        delta = phi @ p.reshape(-1, 6)
        R, t = moved(poses.T_MH.R, poses.T_MH.t, delta)
        J_out = np.zeros((len(poses), 6, 6))
        J_out[:, :3, :3], J_out[:, 3:, 3:] = left_jacobian(delta[:, :3]), np.eye(3)
        J = np.einsum("nj,nab->najb", phi, J_out).reshape(len(poses), 6, -1)
        return RealPoses(R=R, t=t, J=J)

    def resized(self, sizes: Array) -> PoseMap:
        """The same map with errors expected to be `sizes` (a factor a group) times as large."""
        return replace(self, factors=tuple((np.asarray(self.factors) * sizes).tolist()))

    def to_json(self) -> dict[str, Any]:
        return {
            "order": self.order,
            "t_scale_mm": self.t_scale,
            "w_scale_rad": self.w_scale,
            "t_sigma_mm": self.t_sigma,
            "w_sigma_rad": self.w_sigma,
            "factors": list(self.factors or ()),
            "repeatability": self.repeatability.to_json(),
        }
