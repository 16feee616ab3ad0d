"""Rotations: conventions against scipy's own composition, the gimbal case, the logarithm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tomopose.errors import ConventionError, InputError, ShapeError
from tomopose.geometry.rotations import (
    CONVENTIONS,
    R_x,
    R_y,
    R_z,
    angles_from_rotation,
    convention_from_rotation,
    exp_rotation,
    log_rotation,
    rotation_about_axes,
    rotation_angle_between,
    rotation_from_angles,
    rotation_from_convention,
    skew,
)

angle = st.floats(-3.1, 3.1)
RADIAN = 1e-9


@given(angle, angle, angle)
def test_angles_give_the_rotation_back(a, b, c):
    R = rotation_from_angles(np.array([a, b, c]))
    back = rotation_from_angles(angles_from_rotation(R))
    assert rotation_angle_between(R, back) < RADIAN


@pytest.mark.parametrize("b", [np.pi / 2, -np.pi / 2])
@given(a=angle, c=angle)
def test_gimbal_lock_still_gives_the_rotation_back(b, a, c):
    R = rotation_from_angles(np.array([a, b, c]))
    found = angles_from_rotation(R)
    assert np.isfinite(found).all()
    assert rotation_angle_between(R, rotation_from_angles(found)) < 1e-7


def test_wrong_number_of_angles_is_refused():
    with pytest.raises(ShapeError, match="three angles"):
        rotation_from_angles(np.zeros((4, 2)))


# What the makers write, as products of basic rotations typed from their manuals (field conventions table).
PRODUCTS = {
    "pi-hexapod": lambda a, b, c: R_x(a) @ R_y(b) @ R_z(c),
    "symetrie-hexapod": lambda a, b, c: R_z(c) @ R_y(b) @ R_x(a),
    "kuka": lambda a, b, c: R_z(a) @ R_y(b) @ R_x(c),
    "fanuc": lambda a, b, c: R_z(c) @ R_y(b) @ R_x(a),
    "yaskawa": lambda a, b, c: R_z(c) @ R_y(b) @ R_x(a),
    "staubli": lambda a, b, c: R_x(a) @ R_y(b) @ R_z(c),
    "kawasaki": lambda a, b, c: R_z(a) @ R_y(b) @ R_z(c),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_euler_conventions_are_the_makers_products(name, rng):
    values = rng.uniform(-40, 40, (20, 3))
    R = rotation_from_convention(values, name)
    for row, found in zip(np.radians(values), R, strict=True):
        assert_allclose(found, PRODUCTS[name](*row), atol=1e-14)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_every_convention_round_trips(name, rng):
    R = exp_rotation(rng.normal(size=(30, 3)) * 0.7)
    values = convention_from_rotation(R, name)
    assert values.shape == (30, len(CONVENTIONS[name].columns))
    assert rotation_angle_between(R, rotation_from_convention(values, name)).max() < RADIAN


def test_quaternion_order_matters_and_is_declared(rng):
    q = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat()  # x y z w
    R = Rotation.from_quat(q).as_matrix()
    assert_allclose(rotation_from_convention(q[None], "quaternion-xyzw")[0], R, atol=1e-15)
    assert_allclose(rotation_from_convention(q[None, [3, 0, 1, 2]], "abb")[0], R, atol=1e-15)


def test_quaternion_of_wrong_norm_is_refused():
    with pytest.raises(InputError, match=r"row 2: quaternion has norm 2"):
        rotation_from_convention(np.array([[1.0, 0, 0, 0], [2.0, 0, 0, 0]]), "abb")


def test_unknown_convention_lists_the_known_ones():
    with pytest.raises(ConventionError, match="pi-hexapod"):
        rotation_from_convention(np.zeros((1, 3)), "euler")


def test_log_is_the_inverse_of_exp(rng):
    w = rng.uniform(-1.7, 1.7, (50, 3))  # shorter than pi, where the logarithm is unique
    assert_allclose(log_rotation(exp_rotation(w)), w, atol=1e-12)
    assert_allclose(skew(w[0]) @ w[1], np.cross(w[0], w[1]))


def test_rotations_are_compared_by_logarithm_across_the_cut():
    # phi_z near pi lies on the cut of atan2: the angles differ by 2 pi, the rotations by 2e-6 rad.
    R_1, R_2 = R_z(np.pi - 1e-6), R_z(-np.pi + 1e-6)
    assert_allclose(rotation_angle_between(R_1, R_2), 2e-6, rtol=1e-6)


@pytest.mark.parametrize("turn", [0.0, 1e-12, 1e-6, 0.1, 1.0, 2.0, 2.0944, 2.2, 3.0, np.pi - 1e-6, np.pi])
def test_the_logarithm_is_that_of_scipy_at_every_angle(turn):
    axes = np.random.default_rng(5).normal(size=(200, 3))
    w = turn * axes / np.linalg.norm(axes, axis=1)[:, None]
    R = Rotation.from_rotvec(w).as_matrix()
    away = exp_rotation(log_rotation(R)) - R  # half a turn has two logarithms
    assert_allclose(away, 0.0, atol=2e-15)
    if turn < np.pi - 1e-5:
        assert_allclose(log_rotation(R), Rotation.from_matrix(R).as_rotvec(), atol=1e-14)


def test_single_rotations_and_stacks_have_the_same_logarithm():
    R = exp_rotation(np.random.default_rng(6).normal(size=(2, 5, 3)))
    found = log_rotation(R)
    assert found.shape == (2, 5, 3)
    for i, j in np.ndindex(2, 5):
        assert_allclose(log_rotation(R[i, j]), found[i, j], atol=1e-15)


@pytest.mark.parametrize("axes", ["XYZ", "ZYX", "ZYZ", "ZXZ", "xyz", "zyx", "yxz"])
def test_products_about_axes_are_those_of_scipy(axes):
    angles = np.random.default_rng(7).uniform(-3, 3, (50, 3))
    assert_allclose(rotation_about_axes(axes, angles), Rotation.from_euler(axes, angles).as_matrix(), atol=2e-15)
