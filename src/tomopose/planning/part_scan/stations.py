"""Where a view may be taken from: table angle and plate pose within the limits, in view, and clear of obstacles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomopose.errors import InputError, OutOfReachError
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, object_motion, project
from tomopose.geometry.rotations import rotation_from_convention
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.poses import PoseSequence
from tomopose.planning.part.keep_out import Obstacle, hits
from tomopose.planning.part.part import Part
from tomopose.planning.part.settings import PartSettings
from tomopose.planning.part_scan.robot_at_work import RobotAtWork
from tomopose.trajectory.feasibility import AXES, TravelLimits, in_view
from tomopose.units import Array

FULL_TURN = 2 * np.pi
LIFTS = 3
"""Heights of the plate among the candidates where it can move by more than a millimetre."""
UPRIGHT = 0.98
"""Cosine of the angle between the plate's z and the table's axis, from which rz counts as a turn about that axis."""
CORNER = np.sqrt(2.0)
"""Both tilt axes together reach farther than each: to the corner of their box."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Machine:
    """What moves the part, and within what.

    limits: x, y, z mm, angles of R_x R_y R_z and table, rad; a table interval of 360 deg or more turns freely.
    pivot:  of the manipulator, as `PoseSequence` has it;  manipulator: whose legs or joints have to stay within their
    stroke.  Of a robot, axes are counted from its working pose, along those of W, and T_HT is that of `RobotAtWork`.
    """

    scanner: Scanner
    T_HT: RigidTransform
    limits: TravelLimits
    obstacles: tuple[Obstacle, ...] = ()
    pivot: Array | None = None
    manipulator: Hexapod | RobotAtWork | None = None

    @property
    def turns_freely(self) -> bool:
        return bool(self.limits.high[6] - self.limits.low[6] >= FULL_TURN * (1 - 1e-9))

    def clipped(self, q: Array) -> Array:
        """Axes (n, 7) drawn to their limits; a free table to the turn that begins at its lower limit."""
        out = np.clip(q, self.limits.low, self.limits.high)
        if self.turns_freely:
            low = self.limits.low[6] if np.isfinite(self.limits.low[6]) else 0.0
            out[:, 6] = low + np.mod(q[:, 6] - low, FULL_TURN)
        return out

    def poses(self, q: Array) -> PoseSequence:
        """Set poses of axes (n, 7): x, y, z mm, angles of R_x R_y R_z rad, table angle rad."""
        found = PoseSequence.from_table(q[:, :3], np.degrees(q[:, 3:6]), alpha=q[:, 6], source="set")
        return PoseSequence(
            T_MH=found.T_MH,
            pose_id=tuple(str(j) for j in range(len(q))),
            alpha=found.alpha,
            pivot=self.pivot,
            convention=found.convention,
            source="set",
        )

    def commanded(self, q: Array) -> PoseSequence:
        """What the controller is told for axes (n, 7): of a robot the poses in its base, with joint values."""
        found = self.poses(q)
        if not isinstance(self.manipulator, RobotAtWork):
            return found
        R, t = found.T_MH.R, found.T_MH.t
        return PoseSequence(
            T_MH=self.manipulator.commanded(R, t),
            pose_id=found.pose_id,
            alpha=found.alpha,
            q=self.manipulator.joint_values(R, t)[0],
            source="set",
        )

    @property
    def home(self) -> RigidTransform | None:
        """T_MH at which points of the part have their coordinates in W; None: the manipulator's zero."""
        return self.manipulator.home if isinstance(self.manipulator, RobotAtWork) else None

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Of each joint of a robot, deg or mm."""
        return self.manipulator.robot.joint_units if isinstance(self.manipulator, RobotAtWork) else ()

    @property
    def spin(self) -> tuple[float, float]:
        """rad: by how much the plate can turn the part about the table's axis where the table cannot: rz."""
        if self.turns_freely or abs(self.T_HT.R[2, 2]) < UPRIGHT:
            return 0.0, 0.0
        rz = np.clip([self.limits.low[5], self.limits.high[5]], -FULL_TURN / 2, FULL_TURN / 2)
        ends = np.sort(np.sign(self.T_HT.R[2, 2]) * rz)
        return float(ends[0]), float(ends[1])

    def matrices(self, q: Array) -> Array:
        """(n, 3, 4): points of the part at home, mm in W, to pixels.  Eq. (5)."""
        poses = self.poses(q)
        return eq5_matrices(self.scanner, T_HT=self.T_HT, T_MH=poses.T_MH, alpha=q[:, 6])


def allowed(machine: Machine, part: Part, q: Array, *, margin: float) -> np.ndarray:
    """(n,) bool: the whole part on the panel, between source and panel, clear of the obstacles, and within stroke."""
    P = machine.matrices(q)
    depth = np.einsum("nj,mj->nm", P[:, 2, :3], part.hull) + P[:, 2, 3:]
    good = (depth > 0).all(axis=1) & (depth < machine.scanner.d_SD).all(axis=1)
    seen = in_view(P, part.hull, n_u=machine.scanner.n_u, n_v=machine.scanner.n_v, margin=margin).all(axis=1)
    good &= seen
    if machine.manipulator is not None:
        index = np.flatnonzero(good)
        T_MH = machine.poses(q[index]).T_MH
        good[index] = machine.manipulator.reaches(T_MH.R, T_MH.t)
    for obstacle in machine.obstacles:
        index = np.flatnonzero(good)
        good[index] &= ~hits(obstacle, part.hull, part.hull_planes, _motions(machine, q[index]))
    return np.asarray(good)


def _motions(machine: Machine, q: Array) -> tuple[RigidTransform, RigidTransform]:
    """(part at home in W -> W, table -> W) of axes (n, 7)."""
    moved = object_motion(machine.scanner, T_HT=machine.T_HT, T_MH=machine.poses(q).T_MH, alpha=q[:, 6])
    return RigidTransform.of_rotations(moved[:, :3, :3], moved[:, :3, 3], Frame.W, Frame.W), machine.scanner.T_TW(
        q[:, 6]
    )


def turns(machine: Machine, step: float) -> Array:
    """(n,) rad: even angles by which the part is turned about the table's axis, by the table and, where that cannot, by
    the plate."""
    low, high = machine.limits.low[6], machine.limits.high[6]
    start = low if np.isfinite(low) else 0.0
    if machine.turns_freely:
        count = max(round(FULL_TURN / step), 1)
        return np.asarray(start + np.arange(count) * FULL_TURN / count)
    low, high = low + machine.spin[0], high + machine.spin[1]
    whole, middle = high - low >= FULL_TURN * (1 - 1e-9), (low + high) / 2
    width = FULL_TURN if whole else high - low
    count = max(round(width / step), 1)
    return np.asarray(middle + np.linspace(-width / 2, width / 2, count + 1)[: count if whole else None])


def shared(machine: Machine, turn: Array) -> tuple[Array, Array]:
    """(table angle, rz) (n,) rad of turns about the table's axis: the table takes what it can."""
    alpha = turn if machine.turns_freely else np.clip(turn, machine.limits.low[6], machine.limits.high[6])
    return alpha, np.sign(machine.T_HT.R[2, 2]) * (turn - alpha)


def tilted(machine: Machine, turn: Array, tilt: Array, lift: Array, centre: Array) -> Array:
    """Axes (n, 7) that turn the part by `turn`, rad, about the table's axis, tilt it about y_W by `tilt`, rad, and lift
    it by `lift`, mm.

    The plate moves so that the part's middle, `centre` (3,) mm in W at home, stays where it is.  Everything is drawn to
    the limits.
    """
    alpha, rz = shared(machine, turn)
    home = machine.scanner.T_TW(0.0) @ machine.T_HT
    T_TW = machine.scanner.T_TW(alpha)
    axis = np.einsum("nij,j->ni", np.swapaxes(T_TW.R @ machine.T_HT.R, 1, 2), [0.0, 1.0, 0.0])
    q = np.zeros((len(alpha), 7))
    q[:, 3:5] = tilt[:, None] * axis[:, :2]
    q[:, 5], q[:, 6] = rz, alpha
    q = machine.clipped(q)
    c = home.inv.apply(centre)
    R = rotation_from_convention(np.degrees(q[:, 3:6]), "pi-hexapod")
    q[:, :3] = c - R @ c + lift[:, None] * (machine.T_HT.R.T @ [0.0, 0.0, 1.0])
    return machine.clipped(q)


def stations(machine: Machine, part: Part, settings: PartSettings) -> Array:
    """Axes (n, 7) of all candidates: turns x tilts about y_W x lifts, within everything that limits them.

    OutOfReachError, naming what blocks, where none is left.
    """
    low, high = machine.limits.low, machine.limits.high
    reach = CORNER * float(np.abs([low[3:5], high[3:5]]).max())
    if not np.isfinite(reach):
        raise InputError("limits: rx_deg and ry_deg need finite travel; without it no tilt is planned")
    steps = int(np.ceil(reach / settings.tilt_step - 1e-9)) if reach > 0 else 0
    tilt = np.linspace(-reach, reach, 2 * steps + 1)
    lift = np.linspace(low[2], high[2], LIFTS) if high[2] - low[2] > 1.0 else np.array([(low[2] + high[2]) / 2])
    grid = np.stack(np.meshgrid(turns(machine, settings.alpha_step), tilt, lift, indexing="ij"), axis=-1).reshape(-1, 3)
    q = tilted(machine, grid[:, 0], grid[:, 1], grid[:, 2], part.centre)
    q = q[np.sort(np.unique(np.round(q, 9), axis=0, return_index=True)[1])]
    good = allowed(machine, part, q, margin=settings.margin)
    if not good.any():
        raise OutOfReachError(_what_blocks(machine, part, q, settings), limits=machine.limits)
    return np.asarray(q[good])


def _what_blocks(machine: Machine, part: Part, q: Array, settings: PartSettings) -> str:
    """Why no candidate is left."""
    scanner, P = machine.scanner, machine.matrices(q)
    x_D = project(P, part.hull)
    size = np.ptp(x_D, axis=1).min(axis=0)
    free = np.array([scanner.n_u, scanner.n_v]) - 2 * settings.margin
    if (size > free).any():
        return (
            f"{part.name} is larger than the view: its image is at least {size[0]:.0f} x {size[1]:.0f} px, the "
            f"panel has {free[0]:.0f} x {free[1]:.0f} px inside the margin; move it nearer to the panel, or turn it"
        )
    seen = in_view(P, part.hull, n_u=scanner.n_u, n_v=scanner.n_v, margin=settings.margin).all(axis=1)
    if machine.manipulator is not None:
        T_MH = machine.poses(q).T_MH
        reached = machine.manipulator.reaches(T_MH.R, T_MH.t)
        if seen.any() and not (seen & reached).any():
            if isinstance(machine.manipulator, RobotAtWork):
                why = machine.manipulator.what_blocks(T_MH.R[seen], T_MH.t[seen])
                return f"no pose that keeps {part.name} in view is within the robot's reach: {why}"
            return (
                f"the hexapod's legs leave their stroke in every pose that keeps {part.name} in view "
                f"({int(reached.sum())} of {len(q)} poses are within it)"
            )
    if seen.any():
        names = ", ".join(o.name for o in machine.obstacles)
        return f"every pose that keeps {part.name} in view hits what must stay clear ({names})"
    low, high = x_D.min(axis=1), x_D.max(axis=1)
    side = 0 if (low[:, 0] < settings.margin).mean() + (high[:, 0] > free[0]).mean() > 1 else 1
    axis = ("y (across the beam)", "z (along the axis)")[side]
    low_mm, high_mm = machine.limits.low[1 + side], machine.limits.high[1 + side]
    return (
        f"no pose within the limits keeps {part.name} in view: it leaves the panel along {axis}, where "
        f"{AXES[1 + side]} may move from {low_mm:.4g} to {high_mm:.4g} mm; widen the limits, or place the part "
        "nearer to the middle"
    )
