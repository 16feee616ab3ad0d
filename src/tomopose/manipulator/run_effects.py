r"""What happened during one run and is not part of the machine's geometry: drift with its warmth, lag of its drives.

    (w, s) = sum_i c_i P_i(tau)  -  sum_c lag_c sign_c e_c  -  sum_d lag_d sign_d J_d

tau in [-1, 1] is the place of the pose in the run, P_i Legendre's polynomials (the constant belongs to T_HT); the lag
of a worn guide (coordinate c) or drive (leg or joint d, which moves the plate by J_d) follows the direction from which
a pose was approached.  These numbers are estimated beside the errors so that they do not bend them.  Of another run the
drift says only how far it may go; the lags belong to the machine and follow a scan's own moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander

from tomopose.geometry.rotations import exp_rotation, log_rotation
from tomopose.geometry.transforms import moved
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, RealPoses, Repeatability, left_jacobian
from tomopose.manipulator.serial import SerialRobot
from tomopose.units import Array

COORDINATES = ("w_x", "w_y", "w_z", "t_x", "t_y", "t_z")
DRIFT_ORDER = 3
STILL_MM, STILL_RAD = 1e-4, 1e-6
"""A coordinate that moved less keeps the flank that its drive was on."""


@dataclass(frozen=True, kw_only=True)
class WithRunEffects:
    """A machine with the effects of one run.

    tau: pose id -> place in the run.  lags: pose id -> (6, k), the plate's motion by a unit lag of guides and drives.
    t_sigma (mm), w_sigma (rad): size of drift and lags.  lag_units: (k,) "mm" or "rad".
    factors: on the size of the drift's turns and shifts, of the lags in rad and in mm.
    """

    machine: ErrorModel
    tau: Mapping[str, float]
    lags: Mapping[str, Array]
    lag_units: tuple[str, ...]
    t_sigma: float = 0.005
    w_sigma: float = 20e-6
    factors: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)

    @property
    def kind(self) -> str:
        return self.machine.kind

    @property
    def names(self) -> tuple[str, ...]:
        drift = tuple(f"drift_{i}_{c}" for i in range(1, DRIFT_ORDER + 1) for c in COORDINATES)
        lags = (*COORDINATES, *(f"drive_{k}" for k in range(1, len(self.lag_units) - 5)))
        return (*self.machine.names, *drift, *(f"lag_{c}" for c in lags))

    @property
    def units(self) -> tuple[str, ...]:
        return (*self.machine.units, *(("rad",) * 3 + ("mm",) * 3) * DRIFT_ORDER, *self.lag_units)

    @property
    def sigma(self) -> Array:
        group = self.groups[len(self.machine.names) :]
        size = np.tile([self.w_sigma, self.t_sigma], 2) * self.factors
        return np.concatenate([self.machine.sigma, size[group]])

    @property
    def repeatability(self) -> Repeatability:
        return self.machine.repeatability

    def real_poses(self, poses: PoseSequence, p: Array) -> RealPoses:
        """Poses of the real plate in this run, and their derivative by errors and effects."""
        m = len(self.machine.names)
        real = self.machine.real_poses(poses, p[:m])
        J_effects = self._effects(poses)
        delta = J_effects @ p[m:]
        R, t = moved(real.R, real.t, delta)
        J_effects[:, :3] = left_jacobian(delta[:, :3]) @ J_effects[:, :3]
        J_machine = real.J.copy()
        J_machine[:, :3] = exp_rotation(delta[:, :3]) @ real.J[:, :3]
        return RealPoses(R=R, t=t, J=np.concatenate([J_machine, J_effects], axis=2))

    def _effects(self, poses: PoseSequence) -> Array:
        """(n, 6, k): the plate's motion (w, t) by each effect."""
        phi = legvander(np.array([self.tau[i] for i in poses.pose_id]), DRIFT_ORDER)[:, 1:]
        drift = phi[:, None, :, None] * np.eye(6)[None, :, None, :]
        lags = np.array([self.lags[i] for i in poses.pose_id])
        return np.concatenate([drift.reshape(len(poses), 6, -1), lags], axis=2)

    @property
    def drift(self) -> slice:
        """Where the drift is in p; the lags follow it."""
        m = len(self.machine.names)
        return slice(m, m + DRIFT_ORDER * len(COORDINATES))

    def drift_variance(self, poses: PoseSequence, p: Array, covariance: Array) -> Array:
        """(6,) rad^2, mm^2: the expected square by which the drift moved the plate in this run, about its mean.

        covariance (m, m) of p: what is not known of the drift counts too.
        """
        J = self._effects(poses)[:, :, : DRIFT_ORDER * len(COORDINATES)]
        J = J - J.mean(axis=0)
        second = np.outer(p[self.drift], p[self.drift]) + covariance[self.drift, self.drift]
        return np.asarray(np.einsum("nia,ab,nib->i", J, second, J) / len(poses))

    @property
    def groups(self) -> Any:
        """The machine keeps its sizes; drift and lags take theirs from the run, turns and shifts apart."""
        drift = np.tile(np.repeat([0, 1], 3), DRIFT_ORDER)
        lags = np.where(np.array(self.lag_units) == "mm", 3, 2)
        return np.concatenate([np.full(len(self.machine.names), -1), drift, lags])

    def resized(self, sizes: Array) -> WithRunEffects:
        f = np.asarray(self.factors) * sizes
        return replace(self, factors=(float(f[0]), float(f[1]), float(f[2]), float(f[3])))

    def to_json(self) -> dict[str, Any]:
        return self.machine.to_json()


def with_run_effects(machine: ErrorModel, poses: PoseSequence) -> WithRunEffects:
    """The machine with the effects of the run that `poses` (all its poses, in acquisition order) are."""
    n = len(poses)
    x = np.concatenate([log_rotation(poses.T_MH.R), poses.T_MH.t], axis=1)
    guides = last_direction(x, np.repeat([STILL_RAD, STILL_MM], 3))[:, None, :] * np.eye(6)
    drives: Array = np.zeros((n, 6, 0))
    drive_units: tuple[str, ...] = ()
    if isinstance(machine, Hexapod):
        legs, A = machine.legs(poses.T_MH.R, poses.T_MH.t)
        drives, drive_units = np.linalg.inv(A) * last_direction(legs, STILL_MM)[:, None, :], ("mm",) * 6
    elif isinstance(machine, SerialRobot):
        q, _ = machine.joint_values(poses)
        units = tuple("rad" if j.kind == "turning" else "mm" for j in machine.joints)
        still = np.where(np.array(units) == "rad", STILL_RAD, STILL_MM)
        drives, drive_units = machine.chain(q)[1] * last_direction(q, still)[:, None, :], units
    lags = -np.concatenate([guides, drives], axis=2)
    tau = np.linspace(-1.0, 1.0, n)
    return WithRunEffects(
        machine=machine,
        tau=dict(zip(poses.pose_id, tau.tolist(), strict=True)),
        lags=dict(zip(poses.pose_id, lags, strict=True)),
        lag_units=(*("rad",) * 3, *("mm",) * 3, *drive_units),
    )


def last_direction(x: Array, still: Array | float) -> Array:
    """(n, k) of -1, 0, 1: the direction in which each column of x (n, k) moved last; 0 before its first move."""
    step = np.diff(x, axis=0, prepend=x[:1])
    direction = np.where(np.abs(step) > still, np.sign(step), 0.0)
    for k in range(1, len(x)):
        direction[k] = np.where(direction[k] == 0, direction[k - 1], direction[k])
    return direction
