r"""Twin robots: one carries the source, the other the detector, the object does not move.

With H the flange of the detector's robot and M its base, in which the ball is fixed, the tables hold inverse poses as
for every moving scanner (see `inverse`).  The focal spot, fixed at `focus` on the flange of the source's robot, is in M
at

    x_k = R_B (R_k focus + t_k) + t_B,

(R_k, t_k) the flange of the source's robot in its own base, (R_B, t_B) that base in M.  How the bases are placed to
each other and where the focal spot sits are known roughly; they are unknowns beside the errors of both machines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.inverse import InverseManipulator
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, RealPoses, Repeatability, left_jacobian
from tomopose.units import Array, float_array
from tomopose.values import value

SETUP = tuple(f"{what}_{c}" for what in ("base_w", "base_t", "focus") for c in "xyz")


def twin_names(detector: ErrorModel | None, source: ErrorModel | None) -> tuple[str, ...]:
    """The errors of twin robots in their order: of the detector's, of the source's, then of their set-up."""
    machines = (("detector", detector), ("source", source))
    return (*(f"{who}_{name}" for who, machine in machines if machine is not None for name in machine.names), *SETUP)


@value
class SourcePlaces:
    """x (n, 3) mm: focal spots in M.  J (n, 3, m): their derivative by the errors.  covariance (n, 3, 3) mm^2: of the
    repeatability of the source's robot."""

    x: Array
    J: Array
    covariance: Array


@dataclass(frozen=True, kw_only=True)
class TwinRobots:
    """detector, source: the robots' error models, or None where a robot is trusted.
    source_poses:  T_MH of the source's flange in its own base, for every pose_id.
    base:          nominal pose of the source robot's base in that of the detector's, mm.  focus (3,): mm, nominal.
    base_t_sigma, base_w_sigma, focus_sigma: how well these are known, mm, rad, mm.
    """

    detector: ErrorModel | None
    source: ErrorModel | None
    source_poses: PoseSequence
    base: RigidTransform
    focus: Any = (0.0, 0.0, 0.0)
    base_t_sigma: float = 20.0
    base_w_sigma: float = 0.02
    focus_sigma: float = 5.0

    kind = "twin"

    def __post_init__(self) -> None:
        focus = float_array(self.focus)
        if focus.shape != (3,) or not np.isfinite(focus).all():
            raise ShapeError(f"focus is {self.focus!r}; a point (x, y, z) on the source's flange in mm is needed")
        object.__setattr__(self, "focus", focus)
        for name in ("base_t_sigma", "base_w_sigma", "focus_sigma"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"twin robots: {name} is {getattr(self, name)}; a standard deviation > 0 is needed")

    def _machines(self) -> tuple[tuple[str, ErrorModel], ...]:
        return tuple((n, m) for n, m in (("detector", self.detector), ("source", self.source)) if m is not None)

    @property
    def names(self) -> tuple[str, ...]:
        return twin_names(self.detector, self.source)

    @property
    def units(self) -> tuple[str, ...]:
        return (*(u for _, machine in self._machines() for u in machine.units), *("rad",) * 3, *("mm",) * 6)

    @property
    def sigma(self) -> Array:
        setup = np.repeat([self.base_w_sigma, self.base_t_sigma, self.focus_sigma], 3)
        return np.concatenate([*(machine.sigma for _, machine in self._machines()), setup])

    @property
    def groups(self) -> Any:
        """The sizes of all errors stay as stated."""
        return np.full(len(self.names), -1)

    @property
    def repeatability(self) -> Repeatability:
        """Of the detector's robot."""
        return Repeatability() if self.detector is None else self.detector.repeatability

    def trusted(self) -> TwinRobots:
        """The same twins without errors of either robot: only their setup is unknown."""
        return replace(self, detector=None, source=None)

    def _split(self, p: Array) -> tuple[Array, Array, Array]:
        p = np.array(p, dtype=np.float64)  # a copy that may be written: rotations refuse others
        if p.shape != (len(self.names),):
            raise ShapeError(f"these twin robots have {len(self.names)} errors; got {p.shape}")
        first = 0 if self.detector is None else len(self.detector.names)
        return p[:first], p[first : len(p) - len(SETUP)], p[len(p) - len(SETUP) :]

    def real_poses(self, poses: PoseSequence, p: Array) -> RealPoses:
        """Of the detector's flange, for a table of its inverse poses."""
        own, _, _ = self._split(p)
        J = np.zeros((len(poses), 6, len(self.names)))
        if self.detector is None:
            return RealPoses(R=poses.T_MH.R, t=poses.T_MH.t, J=J)
        real = InverseManipulator(machine=self.detector).real_poses(poses, own)
        J[:, :, : len(own)] = real.J
        return replace(real, J=J)

    def source_places(self, poses: PoseSequence, p: Array) -> SourcePlaces:
        """Where the focal spot is in M, in the views of `poses`."""
        own, other, setup = self._split(p)
        rows = self.source_poses.select(self.source_poses.index_of(poses.pose_id))
        R, t, J_machine = rows.T_MH.R, rows.T_MH.t, np.zeros((len(rows), 6, 0))
        if self.source is not None:
            real = self.source.real_poses(rows, other)
            R, t, J_machine = real.R, real.t, real.J
        w, shift, focus = setup[:3], setup[3:6], self.focus + setup[6:]
        R_B = exp_rotation(w) @ self.base.R
        arm = R @ focus
        y = (arm + t) @ R_B.T
        by_flange = R_B @ np.concatenate([-skew(arm), np.broadcast_to(np.eye(3), (len(rows), 3, 3))], axis=2)
        J = np.zeros((len(rows), 3, len(self.names)))
        J[:, :, len(own) : len(own) + len(other)] = by_flange @ J_machine
        k = len(own) + len(other)
        J[:, :, k : k + 3] = -skew(y) @ left_jacobian(w)
        J[:, :, k + 3 : k + 6] = np.eye(3)
        J[:, :, k + 6 :] = R_B @ R
        scatter = Repeatability() if self.source is None else self.source.repeatability
        covariance = (by_flange * scatter.variance) @ np.swapaxes(by_flange, 1, 2)
        return SourcePlaces(x=y + self.base.t + shift, J=J, covariance=covariance)

    def resized(self, sizes: Array) -> TwinRobots:
        """The same twins; their sizes stay."""
        return self

    def to_json(self) -> dict[str, Any]:
        """All but the source's pose table, which belongs to a run."""
        return twin_document(self)


class TwinSetup(Protocol):
    """What describes twin robots beside the tables of a run."""

    @property
    def detector(self) -> ErrorModel | None: ...
    @property
    def source(self) -> ErrorModel | None: ...
    @property
    def base(self) -> RigidTransform: ...
    @property
    def focus(self) -> Array: ...
    @property
    def base_t_sigma(self) -> float: ...
    @property
    def base_w_sigma(self) -> float: ...
    @property
    def focus_sigma(self) -> float: ...


def twin_document(twin: TwinSetup) -> dict[str, Any]:
    """The description as JSON knows it."""
    machines = (("detector", twin.detector), ("source", twin.source))
    return {
        **{who: {"kind": machine.kind, **machine.to_json()} for who, machine in machines if machine is not None},
        "base": twin.base.matrix.tolist(),
        "focus_mm": np.asarray(twin.focus).tolist(),
        "base_t_sigma_mm": twin.base_t_sigma,
        "base_w_sigma_rad": twin.base_w_sigma,
        "focus_sigma_mm": twin.focus_sigma,
    }
