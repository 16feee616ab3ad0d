"""RigidTransform: the group laws, and chains that do not fit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm

from tomopose import RigidTransform
from tomopose.errors import FrameMismatchError, InputError, ShapeError
from tomopose.geometry.frames import Frame
from tomopose.geometry.rotations import skew

screw = st.lists(st.floats(-3, 3), min_size=6, max_size=6)


def transform(s, source, target):
    return RigidTransform.from_angles(np.array(s[3:]) / 2, np.array(s[:3]) * 10, source=source, target=target)


@given(screw, screw, screw)
def test_group_laws(a, b, c):
    A, B, C = transform(a, Frame.T, Frame.W), transform(b, Frame.H, Frame.T), transform(c, Frame.M, Frame.H)
    assert_allclose(((A @ B) @ C).matrix, (A @ (B @ C)).matrix, atol=1e-12)
    assert_allclose((A @ A.inv).matrix, np.eye(4), atol=1e-13)
    assert_allclose((A @ B).inv.matrix, (B.inv @ A.inv).matrix, atol=1e-12)
    assert_allclose((A @ RigidTransform.identity(Frame.T)).matrix, A.matrix, atol=0)


@given(screw)
def test_log_is_the_screw_whose_exponential_is_the_transform(s):
    T = transform(s, Frame.M, Frame.H)
    rho, w = T.log()[:3], T.log()[3:]
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(w), rho
    assert_allclose(expm(generator), T.matrix, atol=1e-9)


def test_log_of_a_tiny_rotation_keeps_its_digits():
    T = RigidTransform.from_angles([1e-9, 0, 0], [1.0, 2.0, 3.0], source=Frame.M, target=Frame.H)
    assert_allclose(T.log(), [1, 2, 3, 1e-9, 0, 0], atol=1e-8)


def test_frames_must_chain(T_HT):
    with pytest.raises(FrameMismatchError, match=r"T_HT @ T_HT does not chain") as caught:
        T_HT @ T_HT
    assert caught.value.source is Frame.T
    assert caught.value.target is Frame.H
    with pytest.raises(FrameMismatchError, match="T_MH is needed here, T_HT was given"):
        T_HT.require(Frame.M, Frame.H)


def test_sequences_apply_to_each_point(rng):
    R = np.stack([np.eye(3)] * 4)
    T = RigidTransform(R=R, t=rng.normal(size=(4, 3)), source=Frame.M, target=Frame.H)
    x = rng.normal(size=(5, 3))
    assert T.apply(x).shape == (4, 5, 3)
    assert_allclose(T.apply(x)[2, 3], x[3] + T.t[2])
    assert_allclose(T[2].apply(x), T.apply(x)[2])
    assert len(T) == len(list(T)) == 4


def test_values_are_frozen(T_HT):
    with pytest.raises(ValueError, match="read-only"):
        T_HT.t[0] = 1.0


@pytest.mark.parametrize(
    ("R", "t", "error", "message"),
    [
        (np.eye(3) * 2, np.zeros(3), InputError, "not a proper rotation"),
        (np.diag([1, 1, -1.0]), np.zeros(3), InputError, "not a proper rotation"),
        (np.eye(3), np.array([0, np.nan, 0]), InputError, "not finite"),
        (np.eye(4), np.zeros(3), ShapeError, "needs R"),
        (np.stack([np.eye(3)] * 2), np.zeros((3, 3)), ShapeError, "needs R"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(R, t, error, message):
    with pytest.raises(error, match=message):
        RigidTransform(R=R, t=t, source=Frame.H, target=Frame.T)


def test_matrix_round_trip_and_its_last_row(T_HT):
    back = RigidTransform.from_matrix(T_HT.matrix, source=Frame.H, target=Frame.T)
    assert_allclose(back.matrix, T_HT.matrix, atol=0)
    with pytest.raises(InputError, match="last row"):
        RigidTransform.from_matrix(np.ones((4, 4)), source=Frame.H, target=Frame.T)
