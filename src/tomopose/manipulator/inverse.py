r"""The other arrangement: the manipulator carries source and detector, the object does not move (C-arm, gantry).

The chain of eq. (6) then runs through the *inverse* pose.  With H the manipulator's base, in which the ball is fixed,
and M the moved plate, which carries the scanner,

    x_D = P_S T_WS T_MT T_MH^-1 (t; 1),     t the ball in H,  T_MT the mount of the scanner on the plate,

which is eq. (6) with T_MH^-1 in the place of T_MH, T_MT in that of T_HT and a ball in H in that of a ball in M.  So the
same estimator serves: `inverse_poses` turns a pose table, `InverseManipulator` an error model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import skew
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, RealPoses, Repeatability
from tomopose.units import Array
from tomopose.values import require_types


def _inverse(T: RigidTransform) -> RigidTransform:
    inv = T.inv
    return RigidTransform(R=inv.R, t=inv.t, source=Frame.M, target=Frame.H)


@require_types
def inverse_poses(poses: PoseSequence) -> PoseSequence:
    """The table for the chain above: T_MH^-1 is in the place of T_MH.  Twice gives the table back.

    M then names what does not move with the ball, H what moves with the scanner.
    """
    return replace(
        poses,
        T_MH=_inverse(poses.T_MH),
        T_MH_set=None if poses.T_MH_set is None else _inverse(poses.T_MH_set),
    )


@dataclass(frozen=True, kw_only=True)
class InverseManipulator:
    """A machine's error model for tables of inverse poses."""

    machine: ErrorModel

    kind = "inverse"

    @property
    def names(self) -> tuple[str, ...]:
        return self.machine.names

    @property
    def units(self) -> tuple[str, ...]:
        return self.machine.units

    @property
    def sigma(self) -> Array:
        return self.machine.sigma

    @property
    def repeatability(self) -> Repeatability:
        """That of the machine: of turns about and shifts of its plate, which is H here."""
        return self.machine.repeatability

    def real_poses(self, poses: PoseSequence, p: Array) -> RealPoses:
        """Inverse of the real plate's poses.

        With exp(w) R, t + s the plate's small motion, the inverse turns by -R^T w and shifts by R^T (w x t - s).
        """
        real = self.machine.real_poses(inverse_poses(poses), p)
        R_T = np.swapaxes(real.R, 1, 2)
        w, s = real.J[:, :3], real.J[:, 3:]
        J = np.concatenate([-R_T @ w, R_T @ (-skew(real.t) @ w - s)], axis=1)
        return RealPoses(R=R_T, t=-(R_T @ real.t[:, :, None])[..., 0], J=J)

    @property
    def groups(self) -> Any:
        return self.machine.groups

    def resized(self, sizes: Array) -> InverseManipulator:
        return InverseManipulator(machine=self.machine.resized(sizes))

    def to_json(self) -> dict[str, Any]:
        return {"kind": self.machine.kind, "machine": self.machine.to_json()}
