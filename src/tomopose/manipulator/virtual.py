"""Virtual manipulators: machines with known errors, to test what identification finds.

`real_motion` runs a pose table on a machine with errors p and adds what no geometry model holds: backlash of the
drives, growth with the motors' warmth, scatter from pose to pose; `encoder_readout` gives what the encoders say.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tomopose.errors import InputError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import exp_rotation
from tomopose.geometry.transforms import RigidTransform, moved
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.poses import PoseSequence
from tomopose.manipulator.real_poses import ErrorModel, Repeatability
from tomopose.manipulator.run_effects import last_direction
from tomopose.manipulator.serial import Joint, SerialRobot
from tomopose.units import Array


def typical_hexapod(
    *,
    base_radius: float = 160.0,
    platform_radius: float = 90.0,
    leg: float = 250.0,
    pivot_height: float = 200.0,
    half_gap_deg: float = 5.0,
    joint_sigma: float = 0.1,
    leg_sigma: float = 0.1,
) -> Hexapod:
    """A hexapod of the size of the paper's: joints in three pairs, lengths in mm, the pivot above the platform.

    half_gap_deg: half the angle between the two joints of a pair, on both plates.
    """
    gap = np.radians(half_gap_deg)
    middle = np.repeat(np.radians([0.0, 120.0, 240.0]), 2)
    side = np.tile([-1.0, 1.0], 3)
    on_base = middle + side * gap
    on_platform = middle + side * (np.pi / 3 - gap)
    b = base_radius * np.column_stack([np.cos(on_base), np.sin(on_base)])
    p = platform_radius * np.column_stack([np.cos(on_platform), np.sin(on_platform)])
    height = leg**2 - np.sum((b[0] - p[0]) ** 2)
    if height <= 0:
        raise InputError(f"legs of {leg:g} mm are too short to join these plates")
    z_platform = -pivot_height
    z_base = z_platform - np.sqrt(height)
    return Hexapod(
        base_joints=np.column_stack([b, np.full(6, z_base)]),
        platform_joints=np.column_stack([p, np.full(6, z_platform)]),
        joint_sigma=joint_sigma,
        leg_sigma=leg_sigma,
    )


def typical_robot(
    *,
    length_sigma: float = 0.2,
    angle_sigma: float = np.radians(0.02),
    eccentricity_sigma: float = 0.0,
) -> SerialRobot:
    """A 6R robot of about 0.9 m reach with a spherical wrist (DH), the plate 100 mm in front of it.

    length_sigma (mm) of a and d, angle_sigma (rad) of alpha and joint zeros, eccentricity_sigma (rad) of the gears.
    """
    sigma = {"a": length_sigma, "d": length_sigma, "alpha": angle_sigma, "theta_offset": angle_sigma}
    if eccentricity_sigma:
        sigma |= {"e_cos": eccentricity_sigma, "e_sin": eccentricity_sigma}
    a = (75.0, 365.0, 90.0, 0.0, 0.0, 0.0)
    d = (335.0, 0.0, 0.0, 405.0, 0.0, 100.0)
    alpha = np.radians([-90.0, 0.0, -90.0, 90.0, -90.0, 0.0])
    zero = np.radians([0.0, -90.0, 0.0, 0.0, 0.0, 180.0])
    joints = tuple(
        Joint(a=a[k], alpha=float(alpha[k]), d=d[k], theta_offset=float(zero[k]), sigma=sigma) for k in range(6)
    )
    return SerialRobot(joints=joints, q_start=np.radians([5.0, 10.0, 20.0, 10.0, 40.0, 10.0]))


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """What no geometry model holds.

    backlash_mm:  play of guides: the plate's origin lags by half of it behind its last move, per axis.
    leg_backlash_mm: play of a hexapod's legs, likewise.
    growth_mm:    shift (3,) of the plate reached when the machine is warm; growth_rad: the turn (3,) likewise.
    time_constant: poses after which 63 % of the growth is reached.
    scatter:      repeatability from pose to pose.
    """

    backlash_mm: float = 0.0
    leg_backlash_mm: float = 0.0
    growth_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    growth_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_constant: float = 60.0
    scatter: Repeatability = field(default_factory=Repeatability)


def lag_of_backlash(x: Array, play: float) -> Array:
    """(n, k), mm: how far axes lag behind commanded positions x (n, k), in order, with that play.

    The drive pushes one flank: after a move in + an axis is play/2 short, after a move in - play/2 beyond; an axis
    that does not move keeps its flank, and all begin on that of a move in +.
    """
    return -0.5 * play * last_direction(np.concatenate([x[:1] - 1.0, x]), 0.0)[1:]


def real_motion(
    machine: ErrorModel,
    poses: PoseSequence,
    p: Array,
    *,
    disturbance: Disturbance | None = None,
    rng: np.random.Generator | None = None,
) -> PoseSequence:
    """Where the real plate is in each pose of the table: the truth of a virtual experiment.

    rng: needed where the disturbance scatters; without a disturbance the motion is exact.
    """
    real = machine.real_poses(poses, p)
    R, t = real.R, real.t
    if disturbance is not None:
        n = len(poses)
        warm = 1 - np.exp(-np.arange(n) / disturbance.time_constant)
        delta = np.zeros((n, 6))
        delta[:, :3] = warm[:, None] * np.asarray(disturbance.growth_rad)
        delta[:, 3:] = warm[:, None] * np.asarray(disturbance.growth_mm)
        delta[:, 3:] += lag_of_backlash(poses.T_MH.t, disturbance.backlash_mm)
        if isinstance(machine, Hexapod) and disturbance.leg_backlash_mm:
            legs, A = machine.legs(poses.T_MH.R, poses.T_MH.t)
            delta += np.linalg.solve(A, lag_of_backlash(legs, disturbance.leg_backlash_mm)[:, :, None])[..., 0]
        if disturbance.scatter.variance.any():
            if rng is None:
                raise InputError("a machine that scatters needs a random generator (rng)")
            delta += rng.standard_normal((n, 6)) * np.sqrt(disturbance.scatter.variance)
        R, t = moved(R, t, delta)
    return replace(poses, T_MH=RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H))


def encoder_readout(poses: PoseSequence, *, settling: Repeatability, rng: np.random.Generator) -> PoseSequence:
    """A pose table with encoder poses beside the set poses: the drives stop within `settling` of what was set.

    The encoders see where the drives stopped, not what the machine's geometry makes of it.
    """
    delta = rng.standard_normal((len(poses), 6)) * np.sqrt(settling.variance)
    w, shift = delta[:, :3], delta[:, 3:]
    encoder = RigidTransform(R=exp_rotation(w) @ poses.T_MH.R, t=poses.T_MH.t + shift, source=Frame.M, target=Frame.H)
    return replace(poses, T_MH=encoder, T_MH_set=poses.T_MH, source="encoder")
