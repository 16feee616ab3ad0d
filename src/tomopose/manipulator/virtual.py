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
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.error_models import ErrorModel, Repeatability, moved
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.poses import PoseSequence
from tomopose.units import Array


def typical_hexapod(
    *, base_radius: float = 160.0, platform_radius: float = 90.0, leg: float = 250.0, pivot_height: float = 200.0,
    half_gap_deg: float = 12.0, joint_sigma: float = 0.1, leg_sigma: float = 0.1,
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
