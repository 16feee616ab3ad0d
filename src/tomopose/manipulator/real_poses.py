"""What every error model of a manipulator can do: from the controller's pose to the pose of the real plate.

A model holds the nominal machine and the standard deviations of its errors; the errors themselves are a vector
p (m,), zero for a perfect machine, so that identified errors are data and no model ever changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array
from tomopose.values import value


@dataclass(frozen=True, kw_only=True)
class Repeatability:
    """Scatter of the real plate about the pose that its errors give it, 1 sigma of each coordinate.

    t_mm: of the plate's origin, mm; w_rad: of its rotation vector, rad.  The defaults are the limits that the maker of
    the paper's hexapod states (sec. 2), taken as one standard deviation.
    """

    t_mm: float = 0.0005
    w_rad: float = 12e-6

    def __post_init__(self) -> None:
        if not (np.isfinite([self.t_mm, self.w_rad]).all() and self.t_mm >= 0 and self.w_rad >= 0):
            raise InputError(f"repeatability is {self.t_mm!r} mm and {self.w_rad!r} rad; two numbers >= 0 are needed")

    @property
    def variance(self) -> Array:
        """(6,): of (w, t), rad^2 and mm^2."""
        return np.repeat([self.w_rad**2, self.t_mm**2], 3)

    def to_json(self) -> dict[str, float]:
        return {"t_mm": self.t_mm, "w_rad": self.w_rad}


@value
class RealPoses:
    """n poses of the real plate and how they answer to the errors.

    R (n, 3, 3), t (n, 3) mm: real T_MH.  J (n, 6, m): derivative of (w, t) by the errors p, where the plate turns by
    exp(w) from the left and its origin moves by t, both in H.
    """

    R: Array
    t: Array
    J: Array

    @property
    def T_MH(self) -> RigidTransform:
        return RigidTransform(R=self.R, t=self.t, source=Frame.M, target=Frame.H)


class ErrorModel(Protocol):
    """kind: "hexapod", "serial", "map"; names, units, sigma (m,): of the errors; groups (m,) int: errors that one cause
    makes, whose size the data may correct together, -1 where it stays; repeatability: of the plate."""

    @property
    def kind(self) -> str: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def units(self) -> tuple[str, ...]: ...
    @property
    def sigma(self) -> Array: ...
    @property
    def groups(self) -> Any: ...
    @property
    def repeatability(self) -> Repeatability: ...

    def real_poses(self, poses: PoseSequence, p: Array) -> RealPoses:
        """Where the real plate is when `poses` are commanded and the machine has the errors p."""
        ...

    def resized(self, sizes: Array) -> ErrorModel:
        """The same machine with the standard deviations of its errors multiplied by the factor of their group."""
        ...

    def to_json(self) -> dict[str, Any]: ...


def left_jacobian(w: Array) -> Array:
    """J_l (..., 3, 3) of SO(3): exp(w + dw) = exp(J_l dw) exp(w) to first order."""
    w = np.asarray(w, dtype=np.float64)
    theta2 = np.sum(w * w, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta < 1e-4
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 0.5 - theta2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - theta2 / 120, (safe - np.sin(safe)) / safe**3)
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    W -= np.swapaxes(W, -1, -2)
    result: Array = np.eye(3) + a * W + b * (W @ W)
    return result
