"""Pose sequences: the commanded poses of the manipulator and those that its encoders report.  T_MH of eqs. (3) and
(6)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from tomopose.errors import InputError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import log_rotation, rotation_from_convention
from tomopose.geometry.transforms import RigidTransform
from tomopose.units import Array, float_array, rows_at
from tomopose.values import Column, Rows, value

PIVOT_TOLERANCE_MM = 1e-6
AT_ZERO = float_array(())
"""The table angles of a sequence for which none are given: 0 for every pose."""


@value
class PoseSequence(Rows):
    """n poses of the manipulator and the table, in acquisition order.

    T_MH:      moved plate -> base, n transforms; the encoder's values where there are any (`source`).
    pose_id:   n different names.
    alpha:     (n,) table angle, rad; 0 where none is given.
    ball_id:   (n,) which ball or ball position was imaged; one unknown t each.
    image:     n file names, or None: images and poses then pair in natural order.
    time_utc:  n ISO 8601 times, or None.
    T_MH_set:  the commanded poses beside the encoder's, or None.
    pivot:     (3,) mm, the controller's pivot point, or None where it is not known.
    convention, source: how the table was written, and whether T_MH is the encoder's or the set pose.
    q:         (n, m) joint values (rad or mm) of a serial robot, or None.
    orientations: (n, 3 or 4) the orientation columns as they were written, in the convention's unit, or None.  They
               serve to test other readings of them; T_MH holds the poses.
    units_confirmed: the user says that unusual magnitudes are right (`# units: confirmed`).
    convention_confirmed: the orientations are what they are meant to be, whatever else fits as well: True for poses
               made in a program, False for a file that does not say so (`# convention: NAME, confirmed`).
    """

    T_MH: RigidTransform
    pose_id: tuple[str, ...]
    alpha: Array = field(default_factory=lambda: AT_ZERO)
    ball_id: Any = None
    image: tuple[str, ...] | None = None
    time_utc: tuple[str, ...] | None = None
    T_MH_set: RigidTransform | None = None
    pivot: Array | None = None
    convention: str = "pi-hexapod"
    source: Literal["encoder", "set"] = "encoder"
    q: Array | None = None
    orientations: Array | None = None
    units_confirmed: bool = False
    convention_confirmed: bool = True

    def __post_init__(self) -> None:
        self.T_MH.require(Frame.M, Frame.H)
        n = len(self.T_MH)
        ids = tuple(str(i) for i in self.pose_id)
        if len(ids) != n:
            raise ShapeError(f"{n} poses but {len(ids)} pose ids")
        twice = [i for i, count in Counter(ids).items() if count > 1]
        if twice:
            raise InputError(f"pose_id {twice[0]!r} appears more than once ({len(twice)} ids repeat); ids must differ")
        object.__setattr__(self, "pose_id", ids)
        still = self.alpha is AT_ZERO or self.alpha is None
        alpha = np.zeros(n) if still else np.asarray(self.alpha, dtype=np.float64)
        ball_id = np.zeros(n, dtype=np.int64) if self.ball_id is None else np.array(self.ball_id, dtype=np.int64)
        for name, array in (("alpha", alpha), ("ball_id", ball_id)):
            if array.shape != (n,):
                raise ShapeError(f"{name} has shape {array.shape}; one value for each of {n} poses is needed")
        if not np.isfinite(alpha).all():
            raise InputError(f"alpha of pose {ids[int(np.flatnonzero(~np.isfinite(alpha))[0])]!r} is not finite")
        ball_id.setflags(write=False)
        object.__setattr__(self, "alpha", float_array(alpha))
        object.__setattr__(self, "ball_id", ball_id)
        for name in ("image", "time_utc"):
            column = getattr(self, name)
            if column is not None:
                if len(column) != n:
                    raise ShapeError(f"{n} poses but {len(column)} entries in {name}")
                object.__setattr__(self, name, tuple(str(c) for c in column))
        if self.T_MH_set is not None and len(self.T_MH_set.require(Frame.M, Frame.H)) != n:
            raise ShapeError(f"{n} poses but {len(self.T_MH_set)} set poses")
        if self.pivot is not None:
            object.__setattr__(self, "pivot", float_array(np.reshape(self.pivot, 3)))
        if self.q is not None:
            q = float_array(self.q)
            if q.ndim != 2 or len(q) != n:
                raise ShapeError(f"q has shape {q.shape}; a row of joint values for each of {n} poses is needed")
            object.__setattr__(self, "q", q)
        if self.orientations is not None:
            written = float_array(self.orientations)
            if written.ndim != 2 or len(written) != n:
                raise ShapeError(f"orientations has shape {written.shape}; one row for each of {n} poses is needed")
            object.__setattr__(self, "orientations", written)

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> Array:
        return np.array(self.T_MH.matrix, dtype=dtype)

    def columns(self) -> dict[str, Column]:
        """The columns of poses.csv by the paper's convention, R = R_x R_y R_z, degrees."""
        angles = np.degrees(self.T_MH.angles)
        columns: dict[str, Column] = {f"{c}_mm": self.T_MH.t[:, k] for k, c in enumerate("xyz")}
        columns |= {f"r{c}_deg": angles[:, k] for k, c in enumerate("xyz")}
        columns |= {"alpha_deg": np.degrees(self.alpha), "ball_id": self.ball_id}
        given = {"image": self.image, "time_utc": self.time_utc}
        return columns | {name: held for name, held in given.items() if held is not None}

    @classmethod
    def from_table(
        cls,
        positions: ArrayLike,
        orientations: ArrayLike,
        *,
        pose_id: Sequence[object] | None = None,
        convention: str = "pi-hexapod",
        **columns: Any,
    ) -> PoseSequence:
        """From positions (n, 3), mm, and a convention's orientation columns (n, 3 or 4), in its unit."""
        positions = np.asarray(positions, dtype=np.float64)
        T_MH = RigidTransform(
            R=rotation_from_convention(np.asarray(orientations), convention),
            t=positions,
            source=Frame.M,
            target=Frame.H,
        )
        ids = range(len(positions)) if pose_id is None else pose_id
        return cls(
            T_MH=T_MH,
            pose_id=tuple(str(i) for i in ids),
            convention=convention,
            orientations=np.asarray(orientations, dtype=np.float64),
            **columns,
        )

    def select(self, index: object) -> PoseSequence:
        """The poses with those indices (or that mask or slice), in that order."""
        i = rows_at(len(self), index)

        def of(column: tuple[str, ...] | None) -> tuple[str, ...] | None:
            return None if column is None else tuple(column[k] for k in i)

        return replace(
            self,
            T_MH=self.T_MH[i],
            pose_id=tuple(self.pose_id[k] for k in i),
            alpha=self.alpha[i],
            ball_id=self.ball_id[i],
            image=of(self.image),
            time_utc=of(self.time_utc),
            T_MH_set=None if self.T_MH_set is None else self.T_MH_set[i],
            q=None if self.q is None else self.q[i],
            orientations=None if self.orientations is None else self.orientations[i],
        )

    def set_poses(self) -> PoseSequence:
        """The same sequence with the commanded poses in place of the encoder's."""
        if self.T_MH_set is None:
            raise InputError("the pose table holds no set poses (columns x_set_mm ...)")
        return replace(self, T_MH=self.T_MH_set, T_MH_set=None, source="set", orientations=None)

    def rotation_vectors(self) -> Array:
        """(n, 3), rad: the logarithm of each pose's rotation."""
        return log_rotation(self.T_MH.R)
