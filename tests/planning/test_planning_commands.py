"""Command lists read back as the poses they were written from."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tomopose.errors import ConventionError
from tomopose.geometry.rotations import rotation_angle_between, rotation_from_convention
from tomopose.manipulator.poses import PoseSequence
from tomopose.planning.commands import WRITERS, command_list

NUMBER = r"[-+]?\d+\.\d+"


@pytest.fixture
def poses(rng):
    return PoseSequence.from_table(
        rng.uniform(-10, 10, (7, 3)),
        rng.uniform(-5, 5, (7, 3)),
        alpha=np.radians([0, 0, 90, 90, 90, 0, 0.0]),
        pivot=[1.0, 2.0, 3.0],
        pose_id=[f"p{k}" for k in range(7)],
    )


MOVES = {
    "pi-gcs": (r"^MOV X", "pi-hexapod", 1.0),
    "kuka-krl": (r"^LIN ", "kuka", 1.0),
    "abb-rapid": (r"MoveL", "abb", 1.0),
    "ur-script": (r"movel\(", "ur", 1000.0),
}


@pytest.mark.parametrize("language", WRITERS)
def test_moves_hold_the_poses(poses, language):
    text = command_list(poses, language)
    pattern, convention, to_mm = MOVES[language]
    moves = [line for line in text.splitlines() if re.search(pattern, line)]
    assert len(moves) == len(poses)
    width = 7 if convention == "abb" else 6
    numbers = np.array([[float(v) for v in re.findall(NUMBER, line)][:width] for line in moves])
    np.testing.assert_allclose(numbers[:, :3] * to_mm, poses.T_MH.t, atol=2e-6)
    R = rotation_from_convention(numbers[:, 3:], convention)
    assert rotation_angle_between(R, poses.T_MH.R).max() < 1e-7
    for name in poses.pose_id:
        assert re.search(rf"pose_id {name}$", text, re.MULTILINE)


def test_the_table_is_announced_where_it_turns(poses):
    assert command_list(poses, "kuka-krl").count("table to") == 3
    assert "SPI R 1.000000 S 2.000000 T 3.000000" in command_list(poses, "pi-gcs")


def test_unknown_language(poses):
    with pytest.raises(ConventionError, match="ur-script"):
        command_list(poses, "basic")
