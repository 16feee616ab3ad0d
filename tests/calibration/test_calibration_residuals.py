"""Eq. (6) of the fast kernel against the plain chain of transforms, and its Jacobian against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tomopose import RigidTransform
from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, projection_blocks
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.rotations import exp_rotation


@pytest.fixture
def case(scanner, T_HT, rng):
    n = 12
    T_MH = RigidTransform(
        R=exp_rotation(rng.normal(0, 0.2, (n, 3))), t=rng.uniform(-9, 9, (n, 3)), source=Frame.M, target=Frame.H
    )
    tilted = replace(scanner, eta=0.02, theta=-0.03, phi=0.04, axis_y=0.6, axis_tilt_x=0.011, axis_tilt_y=-0.017)
    return tilted, T_HT, T_MH, rng.uniform(-20, 20, (n, 3)), rng.uniform(-3, 3, n)


def test_projection_equals_the_chain(case, scanner):
    tilted, T_HT, T_MH, t, alpha = case
    for one in (tilted, scanner):
        blocks = projection_blocks(one, T_HT=T_HT, T_MH=T_MH, t=t, alpha=alpha)
        np.testing.assert_allclose(
            blocks.x_D, project_ball(one, T_HT=T_HT, T_MH=T_MH, t=t, alpha=alpha), rtol=0, atol=1e-9
        )


def test_ball_behind_the_source_is_nan(scanner, T_HT):
    T_MH = RigidTransform(R=np.eye(3)[None], t=[[-900.0, 0, 0]], source=Frame.M, target=Frame.H)
    assert np.isnan(projection_blocks(scanner, T_HT=T_HT, T_MH=T_MH, t=np.zeros(3)).x_D).all()


def _derivative(f, h):
    return (-f(2 * h) + 8 * f(h) - 8 * f(-h) + f(-2 * h)) / (12 * h)


def test_jacobian_equals_finite_differences(case):
    scanner, T_HT, T_MH, t, alpha = case
    blocks = projection_blocks(scanner, T_HT=T_HT, T_MH=T_MH, t=t, alpha=alpha)
    eye = np.eye(3)

    def x(scanner=scanner, T_HT=T_HT, T_MH=T_MH, t=t, scale=1.0):
        return projection_blocks(scanner, T_HT=T_HT, T_MH=T_MH, t=t, alpha=alpha, translation_scale=scale).x_D

    def turned(T, w, *, left=True, shift=0.0):
        E = exp_rotation(w)
        return (
            replace(T, R=E @ T.R, t=T.t @ E.T + shift)
            if left
            else replace(T, R=T.R @ E, t=T.t + T.R @ (np.zeros(3) + shift))
        )

    for i in range(3):
        e = eye[i]
        expected = {
            "J_w_HT": _derivative(lambda h, e=e: x(T_HT=replace(T_HT, R=exp_rotation(h * e) @ T_HT.R)), 1e-3),
            "J_t_HT": _derivative(lambda h, e=e: x(T_HT=replace(T_HT, t=T_HT.t + h * e)), 1e-2),
            "J_t": _derivative(lambda h, e=e: x(t=t + h * e), 1e-2),
        }
        for name, value in expected.items():
            np.testing.assert_allclose(getattr(blocks, name)[:, :, i], value, rtol=1e-7, atol=1e-6, err_msg=name)
        for left, J in ((True, blocks.J_pose_left), (False, blocks.J_pose_right)):
            shift = _derivative(lambda h, e=e, s=left: x(T_MH=turned(T_MH, 0 * e, left=s, shift=h * e)), 1e-2)
            turn = _derivative(lambda h, e=e, s=left: x(T_MH=turned(T_MH, h * e, left=s)), 1e-3)
            np.testing.assert_allclose(J[:, :, i], shift, rtol=1e-7, atol=1e-6)
            np.testing.assert_allclose(J[:, :, 3 + i], turn, rtol=1e-7, atol=1e-5)
    for j, name in enumerate(SCANNER_COLUMNS):
        if name == "translation_scale":
            value = _derivative(lambda h: x(scale=1 + h), 1e-3)
        else:
            step = 1e-3 if abs(getattr(scanner, name)) < 1 else 1e-1
            step = 1e-4 if name in ("p_u", "p_v") else step
            value = _derivative(
                lambda h, name=name: x(scanner=replace(scanner, **{name: getattr(scanner, name) + h})), step
            )
        np.testing.assert_allclose(blocks.J_scanner[:, :, j], value, rtol=1e-6, atol=1e-5, err_msg=name)
