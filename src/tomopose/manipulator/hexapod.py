r"""A hexapod (Stewart platform): inverse kinematics as its controller runs it, forward kinematics as it really is.

Leg k joins base joint b_k (in H) to platform joint p_k (in M).  For a pose (R, t) the controller computes the lengths

    l_k = |R p_k + t - b_k|                                                          (nominal joints)

and the real platform, with joints b_k + db_k, p_k + dp_k and legs l_k (1 + s_k) + dl_k, comes to rest where its own six
constraints hold.  A small motion (w, t) of the plate changes leg k by n_k . (w x R p_k + t), n_k the leg's unit vector,
so that with A the 6x6 matrix of rows ((R p_k x n_k)^T, n_k^T)

    A (w, t) = dl_k + l_k ds_k + n_k . db_k - n_k . R dp_k

which gives both Newton's step of the forward kinematics and the exact Jacobian by the errors.

Two errors that lie before the legs are optional: the axes about which the controller turns may be rotated by exp(c)
against those along which it shifts, and the pivot may be q away from where the controller believes it to be.

Source: the constraint equations of the Stewart-Gough platform, e.g. Merlet, Parallel Robots (Springer 2006), ch. 2, 3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import Any

import numpy as np

from tomopose.errors import InputError, OutOfReachError, ShapeError, TrajectoryError
from tomopose.geometry.rotations import exp_rotation, skew
from tomopose.geometry.transforms import moved
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import RealPoses, Repeatability, left_jacobian
from tomopose.units import Array, float_array
from tomopose.values import value

NEWTON_STEPS = 30
NEWTON_TOLERANCE = 1e-11
"""mm in the legs; rounding of lengths of 250 mm is 1e-13."""
GEOMETRY = tuple(f"geometry_{g}" for g in ("scale", "base_radius", "base_height", "platform_radius", "platform_height"))
"""How a file's geometry may be wrong as a whole: all of it, or radius and height over the pivot of either plate."""
GROUPS = (
    "base_joint",
    "platform_joint",
    "leg_offset",
    "geometry_scale",
    "geometry_base_radius",
    "leg_scale",
    "axes",
    "pivot",
)
SIZED = {
    "base_joint": 0,
    "platform_joint": 0,
    "leg_offset": 0,
    "geometry_scale": -1,
    "geometry_base_radius": -1,
    "leg_scale": 1,
    "axes": 2,
    "pivot": 3,
}
GEOMETRY_COLUMNS = {"geometry_scale": slice(0, 1), "geometry_base_radius": slice(1, 5)}
LARGEST_STROKE = 2.0
SINGULAR_CONDITION = 1e5
"""Condition of A (lengths in units of the platform's radius) above which a pose counts as singular."""


@value
class Hexapod:
    """Nominal hexapod and how far its parts may be off.

    base_joints (6, 3): in H, mm; platform_joints (6, 3): in M, mm; the pivot is the origin of H.
    joint_sigma, leg_sigma:  standard deviation, mm, of each joint coordinate and of each leg's offset.
    scale_sigma, geometry_sigma:  relative, of the file's geometry as a whole and of radius and height over the pivot of
                      either plate, which the controller knows and the file may not; they act only with other errors.
    leg_scale_sigma:  of each leg's relative scale error (pitch of its spindle); 0: not modelled.
    axes_sigma:       rad, of the rotation between turning and shifting axes; 0: not modelled.
    pivot_sigma:      mm, of the pivot; 0: not modelled.  Without axes errors a constant pivot error does nothing.
    leg_limits:       (shortest, longest) leg, mm, or None.
    """

    base_joints: Array
    platform_joints: Array
    joint_sigma: float = 0.1
    leg_sigma: float = 0.1
    scale_sigma: float = 0.05
    geometry_sigma: float = 0.05
    leg_scale_sigma: float = 0.0
    axes_sigma: float = 0.0
    pivot_sigma: float = 0.0
    leg_limits: tuple[float, float] | None = None
    repeatability: Repeatability = field(default_factory=Repeatability)

    def __post_init__(self) -> None:
        for name in ("base_joints", "platform_joints"):
            joints = float_array(getattr(self, name))
            if joints.shape != (6, 3):
                raise ShapeError(f"{name} has shape {joints.shape}; a hexapod has 6 joints of 3 coordinates (6, 3)")
            if not np.isfinite(joints).all():
                raise InputError(f"{name} holds values that are not finite")
            object.__setattr__(self, name, joints)
        for name in (
            "joint_sigma",
            "leg_sigma",
            "scale_sigma",
            "geometry_sigma",
            "leg_scale_sigma",
            "axes_sigma",
            "pivot_sigma",
        ):
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"hexapod: {name} is {value}; a standard deviation >= 0 is needed")

    # -- the errors --------------------------------------------------------------------------------------------------

    kind = "hexapod"

    @cached_property
    def _groups(self) -> tuple[tuple[tuple[str, ...], str, float], ...]:
        """(names, unit, sigma) of each group of errors that is modelled, in the order of p."""
        joints = tuple(f"{k}_{x}" for k in range(1, 7) for x in "xyz")
        legs = tuple(str(k) for k in range(1, 7))
        groups = (
            (tuple(f"base_joint_{j}" for j in joints), "mm", self.joint_sigma),
            (tuple(f"platform_joint_{j}" for j in joints), "mm", self.joint_sigma),
            (tuple(f"leg_offset_{k}" for k in legs), "mm", self.leg_sigma),
            (GEOMETRY[:1], "1", self.scale_sigma),
            (GEOMETRY[1:], "1", self.geometry_sigma),
            (tuple(f"leg_scale_{k}" for k in legs), "1", self.leg_scale_sigma),
            (tuple(f"axes_{x}" for x in "xyz"), "rad", self.axes_sigma),
            (tuple(f"pivot_{x}" for x in "xyz"), "mm", self.pivot_sigma),
        )
        return tuple(g for g in groups if g[2] > 0)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(n for names, _, _ in self._groups for n in names)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(unit for names, unit, _ in self._groups for _ in names)

    @property
    def sigma(self) -> Array:
        return np.array([sigma for names, _, sigma in self._groups for _ in names])

    def _split(self, p: Array) -> dict[str, tuple[slice, Array]]:
        """Group name -> (its place in p, its values)."""
        p = np.asarray(p, dtype=np.float64)
        if p.shape != (len(self.names),):
            raise ShapeError(f"this hexapod has {len(self.names)} errors; got {p.shape}")
        out, start = {}, 0
        for names, _, _ in self._groups:
            place = slice(start, start + len(names))
            out[next(group for group in GROUPS if names[0].startswith(group))] = (place, p[place])
            start = place.stop
        return out

    # -- kinematics --------------------------------------------------------------------------------------------------

    def leg_lengths(self, R: Array, t: Array) -> Array:
        """Nominal legs (n, 6), mm, of poses R (n, 3, 3), t (n, 3): what the controller sends to its drives."""
        return self.legs(R, t)[0]

    def legs(self, R: Array, t: Array) -> tuple[Array, Array]:
        """Nominal legs (n, 6), mm, and A (n, 6, 6), their derivative by the plate's motion (w, t)."""
        return _legs(self.base_joints, self.platform_joints, R, t)

    def forward(self, legs: Array, R_start: Array, t_start: Array) -> tuple[Array, Array]:
        """Nominal poses (R, t) of leg lengths (n, 6), by Newton's method from poses nearby."""
        R, t, _ = _forward(self.base_joints, self.platform_joints, np.asarray(legs), R_start, t_start)
        return R, t

    def real_poses(self, poses: PoseSequence, p: Array) -> RealPoses:
        """Where the real plate is for commanded `poses`, and its derivative by the errors p.

        Raises OutOfReachError for poses that the real platform cannot reach or whose nominal legs leave the limits,
        TrajectoryError for singular poses; both name the indices.
        """
        part = self._split(p)
        R, t = poses.T_MH.R, poses.T_MH.t
        n, none = len(poses), np.zeros(0)
        J_command = np.zeros((n, 6, len(self.names)))
        if "axes" in part or "pivot" in part:
            place_c, c = part.get("axes", (slice(0, 0), np.zeros(3)))
            place_q, q = part.get("pivot", (slice(0, 0), np.zeros(3)))
            R, t, J_c, J_q = _turned_axes(R, t, c, q)
            if "axes" in part:
                J_command[:, :, place_c] = J_c
            if "pivot" in part:
                J_command[:, :, place_q] = J_q
        g = np.zeros(len(GEOMETRY))
        for group, columns in GEOMETRY_COLUMNS.items():
            if group in part:
                g[columns] = part[group][1]
        b, m = self.base_joints * (1 + g[0] + g[[1, 1, 2]]), self.platform_joints * (1 + g[0] + g[[3, 3, 4]])
        legs, A_nominal = _legs(b, m, R, t)
        J_legs = A_nominal @ J_command
        for group, columns in GEOMETRY_COLUMNS.items():
            if group in part:
                J_legs[:, :, part[group][0]] += _legs_by_geometry(
                    self.base_joints, self.platform_joints, A_nominal[:, :, 3:], R
                )[..., columns]
        self._require_reach(legs, A_nominal[:, :, 3:])
        db = part.get("base_joint", (None, none))[1]
        dp = part.get("platform_joint", (None, none))[1]
        b = b + (db.reshape(6, 3) if db.size else 0.0)
        m = m + (dp.reshape(6, 3) if dp.size else 0.0)
        real_legs = legs.copy()
        if "leg_scale" in part:
            real_legs *= 1 + part["leg_scale"][1]
        if "leg_offset" in part:
            real_legs = real_legs + part["leg_offset"][1]
        R, t, A = _forward(b, m, real_legs, R, t)
        return RealPoses(R=R, t=t, J=self._jacobian(part, R, A, legs, J_legs))

    def _jacobian(
        self, part: Mapping[str, tuple[slice, Array]], R: Array, A: Array, legs: Array, J_legs: Array
    ) -> Array:
        """d(w, t) / dp (n, 6, m) = A^-1 dlegs / dp, given how the nominal legs (n, 6) answer, J_legs (n, 6, m)."""
        normal = A[:, :, 3:]
        scale = 1 + part["leg_scale"][1] if "leg_scale" in part else np.ones(6)
        rhs = scale[:, None] * J_legs
        k = np.arange(6)
        if "base_joint" in part:
            view = rhs[:, :, part["base_joint"][0]].reshape(len(R), 6, 6, 3)
            view[:, k, k] += normal
            rhs[:, :, part["base_joint"][0]] = view.reshape(len(R), 6, 18)
        if "platform_joint" in part:
            view = rhs[:, :, part["platform_joint"][0]].reshape(len(R), 6, 6, 3)
            view[:, k, k] -= normal @ R
            rhs[:, :, part["platform_joint"][0]] = view.reshape(len(R), 6, 18)
        for group, columns in GEOMETRY_COLUMNS.items():
            if group in part:
                rhs[:, :, part[group][0]] -= _legs_by_geometry(self.base_joints, self.platform_joints, normal, R)[
                    ..., columns
                ]
        if "leg_offset" in part:
            rhs[:, :, part["leg_offset"][0]] += np.eye(6)
        if "leg_scale" in part:
            rhs[:, :, part["leg_scale"][0]] += legs[:, :, None] * np.eye(6)
        return np.asarray(np.linalg.solve(A, rhs), dtype=np.float64)

    def _require_reach(self, legs: Array, direction: Array) -> None:
        """OutOfReachError where legs leave their limits.

        Without stated limits none may grow beyond twice its length at home or shrink below half of it, since a spindle
        is no longer than its tube, and none may lean over by a right angle from where it points at home.
        """
        leaning = np.flatnonzero(self._leans(direction))
        if leaning.size:
            raise OutOfReachError(
                f"{leaning.size} poses make a leg lean by more than 90 deg from home; the first is pose {leaning[0]}: "
                "this platform cannot take them; check the joints' order, signs and units",
                indices=leaning.tolist(),
            )
        bad = np.flatnonzero(self._beyond_stroke(legs))
        if bad.size:
            home = self._home[0]
            limits = f"half or twice their length at home ({home.min():.1f} to {home.max():.1f} mm)"
            if self.leg_limits is not None:
                limits = "{:g} to {:g} mm".format(*self.leg_limits)
            raise OutOfReachError(
                f"{bad.size} poses need legs of {legs[bad].min():.2f} to {legs[bad].max():.2f} mm, outside {limits}; "
                f"the first is pose {bad[0]}; check the joints' coordinates and the poses' units",
                indices=bad.tolist(),
                limits=self.leg_limits,
            )

    @cached_property
    def _home(self) -> tuple[Array, Array]:
        """Legs (1, 6), mm, and A (1, 6, 6) at zero."""
        return self.legs(np.eye(3)[None], np.zeros((1, 3)))

    def _leans(self, direction: Array) -> np.ndarray:
        """(n,) bool: a leg, directions (n, 6, 3), leans over by a right angle from where it points at home."""
        return np.asarray(np.any(np.einsum("nki,ki->nk", direction, self._home[1][0, :, 3:]) <= 0, axis=1))

    def _beyond_stroke(self, legs: Array) -> np.ndarray:
        """(n,) bool: a leg (n, 6), mm, is shorter or longer than it can be."""
        home = self._home[0][0]
        low, high = self.leg_limits or (home / LARGEST_STROKE, home * LARGEST_STROKE)
        return np.asarray(np.any((legs < low) | (legs > high), axis=1))

    def reaches(self, R: Array, t: Array) -> np.ndarray:
        """(n,) bool: the nominal platform takes the poses R (n, 3, 3), t (n, 3), mm, with its legs in their stroke."""
        legs, A = self.legs(R, t)
        return np.asarray(~(self._leans(A[:, :, 3:]) | self._beyond_stroke(legs)))

    @property
    def groups(self) -> Any:
        """(m,) int: joints and legs 0, spindles 1, axes 2, pivot 3; -1 for the geometry: the file stays the file."""
        return np.array(
            [
                SIZED[group]
                for group, (place, _) in self._split(np.zeros(len(self.names))).items()
                for _ in range(place.stop - place.start)
            ]
        )

    def resized(self, sizes: Array) -> Hexapod:
        """The same hexapod with the standard deviations of its errors multiplied by the factor of their group."""
        factor = dict(enumerate(np.asarray(sizes, dtype=np.float64).tolist()))
        group = {"joint_sigma": 0, "leg_sigma": 0, "leg_scale_sigma": 1, "axes_sigma": 2, "pivot_sigma": 3}
        return replace(self, **{name: factor.get(k, 1.0) * getattr(self, name) for name, k in group.items()})

    def to_json(self) -> dict[str, Any]:
        """The content of hexapod.json."""
        return {
            "base_joints_mm": self.base_joints.tolist(),
            "platform_joints_mm": self.platform_joints.tolist(),
            "joint_sigma_mm": self.joint_sigma,
            "leg_sigma_mm": self.leg_sigma,
            "scale_sigma": self.scale_sigma,
            "geometry_sigma": self.geometry_sigma,
            "leg_scale_sigma": self.leg_scale_sigma,
            "axes_sigma_rad": self.axes_sigma,
            "pivot_sigma_mm": self.pivot_sigma,
            **({} if self.leg_limits is None else {"leg_limits_mm": list(self.leg_limits)}),
            "repeatability": self.repeatability.to_json(),
        }


def _legs(b: Array, p: Array, R: Array, t: Array) -> tuple[Array, Array]:
    """Lengths (n, 6) and A (n, 6, 6): d length / d(w, t)."""
    arm = p @ np.swapaxes(R, -1, -2)
    leg = arm + t[:, None, :] - b
    length = np.linalg.norm(leg, axis=-1)
    normal = leg / length[..., None]
    return length, np.concatenate([np.cross(arm, normal), normal], axis=-1)


def _forward(b: Array, p: Array, legs: Array, R: Array, t: Array) -> tuple[Array, Array, Array]:
    """Poses (R, t) whose legs have these lengths, by Newton's method, and A there."""
    radius = float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))
    scaling = np.repeat([1 / radius, 1.0], 3)
    for count in range(NEWTON_STEPS):
        length, A = _legs(b, p, R, t)
        if count == 0:
            condition = _condition(A * scaling)
            bad = np.flatnonzero(~(condition < SINGULAR_CONDITION))
            if bad.size:
                raise TrajectoryError(
                    f"{bad.size} poses are singular: pose {bad[0]} has condition {condition[bad[0]]:.3g} "
                    f"(limit {SINGULAR_CONDITION:.0e}), the platform is not held there; check the joints' order and "
                    "that the platform is no scaled copy of the base",
                    indices=bad.tolist(),
                )
        error = legs - length
        if np.abs(error).max() < NEWTON_TOLERANCE:
            return R, t, A
        R, t = moved(R, t, np.asarray(np.linalg.solve(A, error[..., None])[..., 0], dtype=np.float64))
    bad = np.flatnonzero(np.abs(error).max(axis=1) >= NEWTON_TOLERANCE)
    raise OutOfReachError(
        f"{bad.size} poses cannot be reached: no plate pose has these legs; pose {bad[0]} is left with "
        f"{np.abs(error[bad[0]]).max():.3g} mm in a leg",
        indices=bad.tolist(),
    )


def _legs_by_geometry(b: Array, p: Array, normal: Array, R: Array) -> Array:
    """d legs / d GEOMETRY (n, 6, 5), with unit vectors normal (n, 6, 3) of the legs."""
    on_base, on_plate = -normal * b, (normal @ R) * p
    parts = [on_base[..., 0] + on_base[..., 1], on_base[..., 2], on_plate[..., 0] + on_plate[..., 1], on_plate[..., 2]]
    return np.stack([sum(parts), *parts], axis=-1)


def _condition(A: Array) -> Array:
    """(n,): |A| |A^-1| in Frobenius' norm, inf where A has no inverse."""
    try:
        inverse = np.linalg.inv(A)
    except np.linalg.LinAlgError:
        singular_values = np.linalg.svd(A, compute_uv=False)
        return np.asarray(singular_values[:, 0] / np.maximum(singular_values[:, -1], 1e-300))
    return np.asarray(np.linalg.norm(A, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2)))


def _turned_axes(R: Array, t: Array, c: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    """The pose C R C^T | t + (1 - C R C^T) q with C = exp(c), and its derivatives (n, 6, 3) by c and q."""
    C = exp_rotation(c)
    R = C @ R @ C.T
    lever = np.eye(3) - R
    J_w = lever @ left_jacobian(c)
    J_c = np.concatenate([J_w, skew(R @ q) @ J_w], axis=1)
    J_q = np.concatenate([np.zeros_like(lever), lever], axis=1)
    return R, t + lever @ q, J_c, J_q
