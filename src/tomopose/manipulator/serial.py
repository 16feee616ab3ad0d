r"""Serial robots: chains of joints in Denavit-Hartenberg parameters, with the errors that calibrations of robots know.

    dh:           T_k = Rot_z(theta_k) Trans_z(d_k) Trans_x(a_k) Rot_x(alpha_k)
    modified-dh:  T_k = Rot_x(alpha_k) Trans_x(a_k) Rot_z(theta_k) Trans_z(d_k)      (a, alpha of the link before)

and T_MH = T_1 ... T_m T_tool, theta_k = q_k + offset_k for a turning joint, d_k = d_k + q_k for a sliding one.  For
nearly parallel neighbours a small turn beta about y follows T_k (Hayati), since DH parameters jump there.
The gear of joint k adds e_cos cos q_k + e_sin sin q_k (an eccentric wheel) to its angle.

The controller works with the nominal chain.  What a joint does to the plate is a screw along its z or x axis; the
Jacobian by every parameter is the screw of that parameter, carried into H.

Sources: Denavit & Hartenberg 1955; Craig, Introduction to Robotics (modified form); Hayati & Mirmirani, J. Robotic
Systems 2 (1985) 397; Mooring, Roth & Driels, Fundamentals of Manipulator Calibration (1991).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from tomopose.errors import InputError, OutOfReachError, ShapeError, TrajectoryError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import R_x, R_y, R_z, log_rotation
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import RealPoses, Repeatability
from tomopose.units import Array, float_array

JointKind = Literal["turning", "sliding"]
ERRORS: Mapping[str, str] = {
    "a": "mm",
    "alpha": "rad",
    "d": "mm",
    "theta_offset": "rad",
    "beta": "rad",
    "e_cos": "rad",
    "e_sin": "rad",
}
"""Errors that a joint may have, and their units: length, twist, offset, joint zero, Hayati's turn, gear."""

SIZED = {"a": 0, "d": 0, "alpha": 1, "theta_offset": 1, "beta": 1, "e_cos": 2, "e_sin": 2}

IK_STEPS, IK_ROUNDS = 60, 5
IK_TOLERANCE = 1e-12
"""Relative to the robot's length."""
LEAST_DAMPING, LARGEST_DAMPING = 1e-14, 1e8
SINGULAR_CONDITION = 1e4
TOOL_TOLERANCE = 1e-3
"""mm and rad/1000 mm: largest spread of the tool pose between a table's Cartesian poses and its joint values."""


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One joint and its link: a, d mm; alpha, theta_offset rad; sigma: error name -> standard deviation (mm, rad).

    limits: (lowest, highest) value of the joint, rad or mm, or None where the file does not say.
    """

    a: float
    alpha: float
    d: float
    theta_offset: float = 0.0
    kind: JointKind = "turning"
    sigma: Mapping[str, float] = field(default_factory=dict)
    limits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("a", "alpha", "d", "theta_offset"):
            if not np.isfinite(getattr(self, name)):
                raise InputError(f"joint: {name} is {getattr(self, name)}, not a finite number")
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            raise InputError(f"joint: limits are {self.limits}; (lowest, highest) is needed")
        for name, value in self.sigma.items():
            if name not in ERRORS:
                raise InputError(f"joint: there is no error {name!r}; known are {', '.join(ERRORS)}")
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"joint: sigma of {name} is {value}; a number >= 0 is needed")


@dataclass(frozen=True, kw_only=True)
class SerialRobot:
    """A chain of joints.

    convention: "dh" or "modified-dh".  tool: M -> last joint's frame, a constant.  q_start: joint values from which the
    inverse kinematics of Cartesian logs starts; it decides the branch (elbow up or down).
    """

    joints: tuple[Joint, ...]
    convention: Literal["dh", "modified-dh"] = "dh"
    tool: Any = None
    q_start: Any = None
    repeatability: Repeatability = field(default_factory=Repeatability)

    kind = "serial"

    def __post_init__(self) -> None:
        if self.convention not in ("dh", "modified-dh"):
            raise InputError(f'convention {self.convention!r} is unknown; "dh" and "modified-dh" are known')
        object.__setattr__(self, "joints", tuple(self.joints))
        if not self.joints:
            raise InputError("a serial robot without joints")
        tool = np.eye(4) if self.tool is None else np.asarray(self.tool, dtype=np.float64)
        checked = RigidTransform.from_matrix(tool, source=Frame.M, target=Frame.M)
        object.__setattr__(self, "tool", float_array(checked.matrix))
        q = np.zeros(len(self.joints)) if self.q_start is None else np.asarray(self.q_start, dtype=np.float64)
        if q.shape != (len(self.joints),):
            raise ShapeError(f"q_start has shape {q.shape}; one value for each of {len(self.joints)} joints is needed")
        object.__setattr__(self, "q_start", float_array(q))

    # -- the errors --------------------------------------------------------------------------------------------------

    @cached_property
    def _errors(self) -> tuple[tuple[int, str, float], ...]:
        """(joint, error name, sigma) of each modelled error, in the order of p."""
        return tuple(
            (k, name, float(joint.sigma[name]))
            for k, joint in enumerate(self.joints)
            for name in ERRORS
            if joint.sigma.get(name, 0.0) > 0
        )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"joint_{k + 1}_{name}" for k, name, _ in self._errors)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(ERRORS[name] for _, name, _ in self._errors)

    @property
    def sigma(self) -> Array:
        return np.array([sigma for _, _, sigma in self._errors])

    @property
    def lengths(self) -> Array:
        """(len(p),) mm: the nominal length that each error changes; 0 where it changes an angle."""
        return np.array([getattr(self.joints[k], name) if name in ("a", "d") else 0.0 for k, name, _ in self._errors])

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Of each joint's values in a table: deg or mm."""
        return tuple("deg" if j.kind == "turning" else "mm" for j in self.joints)

    # -- kinematics --------------------------------------------------------------------------------------------------

    def chain(self, q: Array, p: Array | None = None) -> tuple[Array, Array, Array]:
        """T_MH (n, 4, 4) of joint values q (n, m), with its Jacobians J_q (n, 6, m) and J_p (n, 6, len(p)).

        The Jacobians give (w, t): the turn of the plate and the shift of its origin, along H.
        """
        q = np.asarray(q, dtype=np.float64)
        if q.ndim != 2 or q.shape[1] != len(self.joints):
            raise ShapeError(f"joint values have shape {q.shape}; (n, {len(self.joints)}) are needed")
        p = np.zeros(len(self._errors)) if p is None else np.asarray(p, dtype=np.float64)
        if p.shape != (len(self._errors),):
            raise ShapeError(f"this robot has {len(self._errors)} errors; got {p.shape}")
        error: list[dict[str, float]] = [{} for _ in self.joints]
        for (k, name, _), value in zip(self._errors, p, strict=True):
            error[k][name] = float(value)
        n = len(q)
        T = np.broadcast_to(np.eye(4), (n, 4, 4))
        screws: dict[tuple[int, str], tuple[Array, Array, bool]] = {}
        for k, joint in enumerate(self.joints):
            e = error[k]
            q_k = q[:, k]
            turning = joint.kind == "turning"
            angle = joint.theta_offset + e.get("theta_offset", 0.0) + np.zeros(n)
            if turning:
                angle = angle + q_k + e.get("e_cos", 0.0) * np.cos(q_k) + e.get("e_sin", 0.0) * np.sin(q_k)
            shift = joint.d + e.get("d", 0.0) + (np.zeros(n) if turning else q_k)
            a, alpha = joint.a + e.get("a", 0.0), joint.alpha + e.get("alpha", 0.0)
            z = (("theta_offset", _turn(R_z(angle)), 2, True), ("d", _shift(shift, 2), 2, False))
            x = (("a", _shift(a, 0), 0, False), ("alpha", _turn(R_x(alpha)), 0, True))
            order = (*z, *x) if self.convention == "dh" else (*x[::-1], *z)
            for name, step, axis, is_turn in (*order, ("beta", _turn(R_y(e.get("beta", 0.0))), 1, True)):
                # the parameter's axis is the same before and after its own step
                screws[k, name] = T[:, :3, axis], T[:, :3, 3], is_turn
                T = T @ step
        T = T @ self.tool
        return T, self._joint_jacobian(screws, T, q, error), self._error_jacobian(screws, T, q)

    def _joint_jacobian(
        self,
        screws: Mapping[tuple[int, str], tuple[Array, Array, bool]],
        T: Array,
        q: Array,
        error: list[dict[str, float]],
    ) -> Array:
        columns = []
        for k, joint in enumerate(self.joints):
            turning = joint.kind == "turning"
            column = _screw(screws[k, "theta_offset" if turning else "d"], T)
            gear = np.ones(len(q))
            if turning:
                e = error[k]
                gear = 1 - e.get("e_cos", 0.0) * np.sin(q[:, k]) + e.get("e_sin", 0.0) * np.cos(q[:, k])
            columns.append(column * gear[:, None])
        return np.stack(columns, axis=2)

    def _error_jacobian(self, screws: Mapping[tuple[int, str], tuple[Array, Array, bool]], T: Array, q: Array) -> Array:
        columns = []
        for k, name, _ in self._errors:
            if name in ("e_cos", "e_sin"):
                gear = (np.cos if name == "e_cos" else np.sin)(q[:, k])
                columns.append(_screw(screws[k, "theta_offset"], T) * gear[:, None])
            else:
                columns.append(_screw(screws[k, name], T))
        return np.stack(columns, axis=2) if columns else np.zeros((len(T), 6, 0))

    def forward(self, q: Array) -> RigidTransform:
        """Nominal T_MH of joint values q (n, m), rad or mm."""
        T, _, _ = self.chain(q)
        return RigidTransform(R=T[:, :3, :3], t=T[:, :3, 3], source=Frame.M, target=Frame.H)

    def inverse(self, T_MH: RigidTransform, q_start: Array | None = None) -> Array:
        """Joint values (n, m), nominal chain, of poses, by Levenberg-Marquardt for all poses at once.

        All start from q_start (m,) or (n, m); poses that do not arrive start again from the joint values of the nearest
        pose that did.
        Raises OutOfReachError where the chain cannot reach a pose, TrajectoryError where it is singular there.
        """
        start = np.array(self.q_start if q_start is None else q_start, dtype=np.float64)
        q = np.broadcast_to(start, (len(T_MH), len(self.joints))).copy()
        q, left, J = self._approach(T_MH, q)
        arrived = left < IK_TOLERANCE
        for _ in range(IK_ROUNDS):
            if arrived.all() or not arrived.any():
                break
            lost = np.flatnonzero(~arrived)
            known = np.flatnonzero(arrived)
            far = np.linalg.norm(T_MH.t[lost][:, None] - T_MH.t[known], axis=2)
            turn = np.linalg.norm(T_MH.R[lost][:, None] - T_MH.R[known], axis=(2, 3))
            nearest = known[np.argmin(far + self._length * turn, axis=1)]
            q[lost], left[lost], J[lost] = self._approach(T_MH[lost], q[nearest])
            arrived = left < IK_TOLERANCE
        if not arrived.all():
            bad = np.flatnonzero(~arrived)
            raise OutOfReachError(
                f"the robot cannot reach {bad.size} poses; pose {bad[0]} is missed by "
                f"{left[bad[0]] * self._length:.3g} mm at best; check robot.json, its tool and q_start_deg, and that "
                "poses are given in the robot's base",
                indices=bad.tolist(),
            )
        condition = np.linalg.cond(J)
        bad = np.flatnonzero(condition > SINGULAR_CONDITION)
        if bad.size:
            raise TrajectoryError(
                f"{bad.size} poses are singular for this robot: pose {bad[0]} has condition {condition[bad[0]]:.3g} "
                f"(limit {SINGULAR_CONDITION:.0e}), its joint values are not determined; log joint values (q1_deg ...)",
                indices=bad.tolist(),
            )
        return q

    def approached(self, T_MH: RigidTransform, q: Array) -> tuple[Array, np.ndarray]:
        """(joint values (n, m), from q (n, m) on, (n,) bool: whether they reach the poses and are not singular)."""
        q, left, J = self._approach(T_MH, np.array(q, dtype=np.float64))
        return q, (left < IK_TOLERANCE) & (np.linalg.cond(J) <= SINGULAR_CONDITION)

    @property
    def _length(self) -> float:
        """mm: the sum of the links, which turns angles into lengths."""
        return max(1.0, float(np.sum([abs(j.a) + abs(j.d) for j in self.joints])))

    def _approach(self, T_MH: RigidTransform, q: Array) -> tuple[Array, Array, Array]:
        """(q, miss (n,) relative to the robot's length, J there, its turns weighted with that length)."""
        weight = np.repeat([self._length, 1.0], 3) / self._length
        unit = np.eye(q.shape[1])
        largest = np.where([j.kind == "turning" for j in self.joints], 0.5, np.inf)

        def at(q: Array) -> tuple[Array, Array]:
            T, J, _ = self.chain(q)
            w = log_rotation(T_MH.R @ np.swapaxes(T[:, :3, :3], 1, 2))
            return np.concatenate([w, T_MH.t - T[:, :3, 3]], axis=1) * weight, J * weight[:, None]

        miss, J = at(q)
        damping = np.full(len(q), 1e-3)
        for _ in range(IK_STEPS):
            left = np.abs(miss).max(axis=1)
            if (left < IK_TOLERANCE).all() or (damping > LARGEST_DAMPING).all():
                break
            A = np.swapaxes(J, 1, 2) @ J
            level = np.einsum("nii->n", A) / A.shape[1]
            step = np.linalg.solve(
                A + (damping * level)[:, None, None] * unit, np.swapaxes(J, 1, 2) @ miss[:, :, None]
            )[..., 0]
            trial = q + np.clip(step, -largest, largest)
            miss_new, J_new = at(trial)
            better = np.sum(miss_new**2, axis=1) < np.sum(miss**2, axis=1)
            q, miss = np.where(better[:, None], trial, q), np.where(better[:, None], miss_new, miss)
            J = np.where(better[:, None, None], J_new, J)
            damping = np.maximum(np.where(better, damping / 100, damping * 10), LEAST_DAMPING)
        return q, np.abs(miss).max(axis=1), J

    def joint_values(self, poses: PoseSequence) -> tuple[Array, Array]:
        """(q (n, m), tool (4, 4)): logged joint values where there are any, else by the nominal inverse.

        With logged joint values the table's Cartesian poses must differ from the nominal chain by one constant tool.
        """
        if poses.q is None:
            return self.inverse(poses.T_MH), np.eye(4)
        q = poses.q
        T, _, _ = self.chain(q)
        extra = np.linalg.inv(T) @ poses.T_MH.matrix
        spread = extra - extra[0]
        worst = np.maximum(np.abs(spread[:, :3, :3]).max(axis=(1, 2)) * 1000.0, np.abs(spread[:, :3, 3]).max(axis=1))
        if worst.max() > TOOL_TOLERANCE:
            k = int(np.argmax(worst))
            raise InputError(
                f"pose {poses.pose_id[k]!r}: the table's Cartesian pose and its joint values do not belong together "
                f"with robot.json; the tool between them moves by {worst[k]:.3g} mm. Check the DH convention, the "
                "joint zeros and that Cartesian poses are given in the robot's base"
            )
        return q, extra[0]

    def real_poses(self, poses: PoseSequence, p: Array) -> RealPoses:
        """Where the real flange is for commanded `poses`, and its derivative by the errors p."""
        q, extra = self.joint_values(poses)
        T, _, J = self.chain(q, p)
        arm = np.einsum("nij,j->ni", T[:, :3, :3], extra[:3, 3])
        J = J.copy()
        J[:, 3:] += np.cross(J[:, :3], arm[:, :, None], axis=1)
        T = T @ extra
        return RealPoses(R=T[:, :3, :3], t=T[:, :3, 3], J=J)

    @property
    def groups(self) -> Any:
        """(m,) int: lengths 0, angles 1, gears 2."""
        return np.array([SIZED[name] for _, name, _ in self._errors])

    def resized(self, sizes: Array) -> SerialRobot:
        """The same robot with the standard deviations of its errors multiplied by the factor of their group."""
        factor = dict(enumerate(np.asarray(sizes, dtype=np.float64).tolist()))
        joints = tuple(
            replace(j, sigma={k: factor.get(SIZED[k], 1.0) * v for k, v in j.sigma.items()}) for j in self.joints
        )
        return replace(self, joints=joints)

    def to_json(self) -> dict[str, Any]:
        """The content of robot.json."""
        return {
            "convention": self.convention,
            "joints": [
                {
                    "a_mm": j.a,
                    "alpha_deg": float(np.degrees(j.alpha)),
                    "d_mm": j.d,
                    "theta_offset_deg": float(np.degrees(j.theta_offset)),
                    "kind": j.kind,
                    "sigma": dict(_written(name, ERRORS[name], value) for name, value in j.sigma.items()),
                    **({} if j.limits is None else {f"limits_{u}": [in_unit(x, u) for x in j.limits]}),
                }
                for j, u in zip(self.joints, self.joint_units, strict=True)
            ],
            "tool": np.asarray(self.tool).tolist(),
            "q_start_deg": np.where(
                [j.kind == "turning" for j in self.joints], np.degrees(self.q_start), self.q_start
            ).tolist(),
            "repeatability": self.repeatability.to_json(),
        }


def poses_from_joints(robot: SerialRobot, q: Array, **columns: Any) -> PoseSequence:
    """The nominal poses of joint values q (n, m): for logs that hold joint values alone."""
    T_MH = robot.forward(q)
    pose_id = columns.pop("pose_id", tuple(str(k) for k in range(len(T_MH))))
    return PoseSequence(T_MH=T_MH, q=q, pose_id=tuple(pose_id), **columns)


def in_unit(value: float, unit: str) -> float:
    """A joint's value, mm or rad, as people read it: in mm, or in deg."""
    return float(value) if unit == "mm" else float(np.degrees(value))


def _written(name: str, unit: str, value: float) -> tuple[str, float]:
    """A number of robot.json, its key with the unit: deg for rad."""
    return f"{name}_{'mm' if unit == 'mm' else 'deg'}", in_unit(value, unit)


def _turn(R: Array) -> Array:
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., 3, 3] = R, 1.0
    return T


def _shift(value: Array | float, axis: int) -> Array:
    value = np.asarray(value, dtype=np.float64)
    T = np.zeros((*value.shape, 4, 4))
    T[..., range(4), range(4)] = 1.0
    T[..., axis, 3] = value
    return T


def _screw(screw: tuple[Array, Array, bool], T: Array) -> Array:
    """(n, 6): (w, t) of the plate's origin when the parameter of that axis changes by 1."""
    axis, origin, is_turn = screw
    if not is_turn:
        return np.concatenate([np.zeros_like(axis), axis], axis=1)
    return np.concatenate([axis, np.cross(axis, T[:, :3, 3] - origin)], axis=1)
