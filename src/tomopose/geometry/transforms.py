"""Eq. (1): rigid transforms that know the frames they join."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import FrameMismatchError, InputError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import angles_from_rotation, exp_rotation, log_rotation, rotation_from_angles, skew
from tomopose.units import Array, float_array
from tomopose.values import value

ORTHONORMAL_TOLERANCE = 1e-6


def _away_from_rotation(R: Array) -> tuple[float, float]:
    """(largest element of R R^T - 1, smallest determinant) of R (3, 3) or (n, 3, 3)."""
    if R.ndim > 2:
        return float(np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max()), float(np.linalg.det(R).min())
    # one rotation in plain numbers: a tenth of the time
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    lengths = (a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1)
    angles = (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)
    return max(map(abs, (*lengths, *angles))), a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)


def moved(R: Array, t: Array, delta: Array) -> tuple[Array, Array]:
    """The poses (R, t) after the motions delta (..., 6) = (w, t), rad and mm, along the axes of their target frame."""
    return exp_rotation(delta[..., :3]) @ R, t + delta[..., 3:]


@value
class RigidTransform:
    """x_target = R x_source + t.  Eq. (1).  One transform, or a sequence of them along a leading axis.

    R: (3, 3) or (n, 3, 3), proper rotations;  t: (3,) or (n, 3), mm;  source, target: the frames it joins.
    """

    R: Array
    t: Array
    source: Frame
    target: Frame

    def __post_init__(self) -> None:
        R, t = float_array(self.R), float_array(self.t)
        if R.shape[-2:] != (3, 3) or t.shape[-1:] != (3,) or R.shape[:-2] != t.shape[:-1] or R.ndim > 3:
            raise ShapeError(f"a transform needs R (n, 3, 3) and t (n, 3); got R {R.shape} and t {t.shape}")
        if not (np.isfinite(R).all() and np.isfinite(t).all()):
            raise InputError(f"T_{self.source.name}{self.target.name} holds values that are not finite")
        if R.size:
            error, least = _away_from_rotation(R)
            if error > ORTHONORMAL_TOLERANCE or least < 0:
                raise InputError(
                    f"R of T_{self.source.name}{self.target.name} is not a proper rotation "
                    f"(R R^T differs from 1 by {error:.2g}, smallest determinant {least:.3g})"
                )
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "t", t)

    @classmethod
    def of_rotations(cls, R: Array, t: Array, source: Frame, target: Frame) -> RigidTransform:
        """Of R that are rotations by the way they were made (products, turns about axes), and are not tested."""
        made = object.__new__(cls)
        for name, held in (("R", float_array(R)), ("t", float_array(t)), ("source", source), ("target", target)):
            object.__setattr__(made, name, held)
        return made

    # -- construction ------------------------------------------------------------------------------------------------

    @classmethod
    def identity(cls, frame: Frame, target: Frame | None = None) -> RigidTransform:
        return cls(R=np.eye(3), t=np.zeros(3), source=frame, target=target or frame)

    @classmethod
    def from_angles(cls, angles: ArrayLike, t: ArrayLike, *, source: Frame, target: Frame) -> RigidTransform:
        """From the paper's angles (rad) of R = R_x R_y R_z and t (mm)."""
        return cls(
            R=rotation_from_angles(np.asarray(angles)), t=np.asarray(t, dtype=np.float64), source=source, target=target
        )

    @classmethod
    def from_matrix(cls, matrix: ArrayLike, *, source: Frame, target: Frame) -> RigidTransform:
        """From homogeneous (4, 4) or (n, 4, 4) matrices, mm."""
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape[-2:] != (4, 4):
            raise ShapeError(f"a homogeneous transform is (4, 4); got {m.shape}")
        if not np.array_equal(m[..., 3, :], np.broadcast_to([0.0, 0.0, 0.0, 1.0], m[..., 3, :].shape)):
            raise InputError("the last row of a homogeneous transform is (0, 0, 0, 1)")
        return cls(R=m[..., :3, :3], t=m[..., :3, 3], source=source, target=target)

    # -- views -------------------------------------------------------------------------------------------------------

    @property
    def matrix(self) -> Array:
        """Homogeneous matrices, (4, 4) or (n, 4, 4)."""
        m = np.zeros((*self.R.shape[:-2], 4, 4))
        m[..., :3, :3], m[..., :3, 3], m[..., 3, 3] = self.R, self.t, 1.0
        return m

    @property
    def angles(self) -> Array:
        """(a, b, c), rad, of R = R_x(a) R_y(b) R_z(c): to print, never to subtract."""
        return angles_from_rotation(self.R)

    @property
    def inv(self) -> RigidTransform:
        R_inv = np.swapaxes(self.R, -1, -2)
        return self.of_rotations(R_inv, -(R_inv @ self.t[..., None])[..., 0], self.target, self.source)

    def log(self) -> Array:
        """The six coordinates (..., 6) of the screw that makes this transform: (rho, w), mm and rad; exp gives it back.

        w is the rotation vector and t = V(w) rho, V the left Jacobian of SO(3).
        """
        w = log_rotation(self.R)
        theta = np.linalg.norm(w, axis=-1)[..., None, None]
        W = skew(w)
        small = theta < 1e-4
        safe = np.where(small, 1.0, theta)
        # (1 - (theta/2) cot(theta/2)) / theta^2, by its series where theta is small
        c = np.where(small, 1 / 12 + theta**2 / 720, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
        V_inv = np.eye(3) - W / 2 + c * (W @ W)
        return np.concatenate([(V_inv @ self.t[..., None])[..., 0], w], axis=-1)

    def apply(self, x: ArrayLike) -> Array:
        """Points (..., 3) in source to target.  A sequence of n transforms and points (m, 3) gives (n, m, 3)."""
        x = np.asarray(x, dtype=np.float64)
        if self.R.ndim == 2:
            return x @ self.R.T + self.t
        if x.ndim == 1:
            result: Array = self.R @ x + self.t
            return result
        found: Array = np.einsum("nij,mj->nmi", self.R, x) + self.t[:, None, :]
        return found

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> Array:
        return np.array(self.matrix, dtype=dtype)

    # -- group -------------------------------------------------------------------------------------------------------

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        if not isinstance(other, RigidTransform):
            return NotImplemented
        if self.source is not other.target:
            raise FrameMismatchError(
                f"T_{self.source.name}{self.target.name} @ T_{other.source.name}{other.target.name} does not chain: "
                f"the right one ends in {other.target.name}, the left one begins in {self.source.name}",
                source=other.target,
                target=self.source,
            )
        t = (self.R @ other.t[..., None])[..., 0] + self.t
        return self.of_rotations(self.R @ other.R, t, other.source, self.target)

    def require(self, source: Frame, target: Frame) -> RigidTransform:
        """This transform, if it joins those frames; FrameMismatchError otherwise."""
        if self.source is not source or self.target is not target:
            raise FrameMismatchError(
                f"a transform T_{source.name}{target.name} is needed here, T_{self.source.name}{self.target.name} was "
                "given",
                source=self.source,
                target=self.target,
            )
        return self

    # -- sequence ----------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        if self.R.ndim == 2:
            raise TypeError("a single transform has no length")
        return int(self.R.shape[0])

    def __getitem__(self, index: int | slice | Sequence[int] | np.ndarray) -> RigidTransform:
        R, t = self.R[index], self.t[index]
        if R.ndim not in (2, 3) or R.shape[-2:] != (3, 3):
            raise ShapeError(f"an index into a sequence of transforms selects whole ones; got R {R.shape}")
        return self.of_rotations(R, t, self.source, self.target)

    def __iter__(self) -> Iterator[RigidTransform]:
        return (self[k] for k in range(len(self)))
