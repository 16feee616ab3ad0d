"""Scanner: detector roll and tilts, the table axis, binning and cropping, and what is refused."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tomopose import Scanner
from tomopose.errors import InputError
from tomopose.geometry.projection import project
from tomopose.geometry.rotations import R_x, R_y, R_z
from tomopose.geometry.scanner import PARAMETER_UNITS


def test_tilted_panel_by_intersecting_rays_with_it(scanner, rng):
    """The pixel found by K is where the ray meets the turned panel, found here by solving for the intersection."""
    s = replace(scanner, eta=0.013, theta=-0.02, phi=0.031)
    R = R_x(s.theta) @ R_y(s.phi) @ R_z(s.eta)
    u_axis, v_axis, pivot = R @ [-1, 0, 0], R @ [0, 1, 0], np.array([0, 0, s.d_SD])
    for x_S in rng.uniform([-40, -40, 200], [40, 40, 400], (20, 3)):
        # x_S * k = pivot + a u_axis + b v_axis
        k, a, b = np.linalg.solve(np.column_stack([x_S, -u_axis, -v_axis]), pivot)
        assert k > 0
        assert_allclose(project(s.P_S, x_S[None])[0], [s.u_0 + a / s.p_u, s.v_0 + b / s.p_v], atol=1e-9)


def test_depth_of_a_tilted_panel_is_positive_and_scaled(scanner):
    s = replace(scanner, theta=0.1, phi=-0.2)
    assert_allclose(np.linalg.norm(s.P_S[2, :3]), 1)
    assert s.P_S[2, 2] > 0


def test_roll_turns_the_image_about_the_piercing_point(scanner):
    s = replace(scanner, eta=np.pi / 2, p_v=scanner.p_u)
    x_S = np.array([[0.0, 10.0, 310.0]])  # above the beam: v + without roll
    plain = project(replace(s, eta=0.0).P_S, x_S)[0] - [s.u_0, s.v_0]
    rolled = project(s.P_S, x_S)[0] - [s.u_0, s.v_0]
    assert_allclose(np.linalg.norm(rolled), np.linalg.norm(plain))
    assert_allclose(rolled @ plain, 0, atol=1e-9)


def test_table_turns_about_its_axis(scanner):
    s = replace(scanner, axis_y=1.5, axis_tilt_x=0.01, axis_tilt_y=-0.02)
    direction = R_x(0.01) @ R_y(-0.02) @ [0, 0, 1]
    on_axis = np.array([0, 1.5, 0]) + 7 * direction
    for alpha in (0.4, 2.0, -3.0):
        assert_allclose(s.T_TW(alpha).apply(on_axis), on_axis, atol=1e-12)
    assert_allclose(s.T_TW(0.0).matrix, np.eye(4), atol=1e-15)
    assert_allclose((s.T_TW(0.3).matrix @ s.T_TW(0.5).matrix), s.T_TW(0.8).matrix, atol=1e-12)
    assert_allclose(scanner.T_TW(0.3).R, R_z(0.3))


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_binning_keeps_the_pixel_centre_rule(scanner, factor, rng):
    """A block of pixels and its binned pixel have the same centre on the panel."""
    b = scanner.binned(factor)
    x_S = rng.uniform([-40, -40, 200], [40, 40, 400], (10, 3))
    fine, coarse = project(scanner.P_S, x_S), project(b.P_S, x_S)
    assert_allclose(coarse * factor + (factor - 1) / 2, fine, atol=1e-9)
    assert b.n_u == scanner.n_u // factor
    assert_allclose(b.p_v, scanner.p_v * factor)


def test_binning_scales_the_priors():
    s = Scanner(d_SD=1000, d_SR=300, p_u=0.1, p_v=0.1, u_0=5, v_0=6, n_u=11, n_v=13, sigma={"u_0": 1.0, "d_SR": 0.2})
    assert dict(s.binned(2).sigma) == {"u_0": 0.5, "d_SR": 0.2}


def test_cropped_window_moves_the_piercing_point(scanner, rng):
    c = scanner.cropped(u=100, v=37, n_u=501, n_v=399)
    x_S = rng.uniform([-40, -40, 200], [40, 40, 400], (10, 3))
    assert_allclose(project(c.P_S, x_S) + [100, 37], project(scanner.P_S, x_S), atol=1e-9)


def test_scanner_survives_pickling(scanner):
    s = replace(scanner, sigma={"d_SR": 0.1})
    assert pickle.loads(pickle.dumps(s)) == s


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"d_SR": 1300.0}, "behind the detector"),
        ({"d_SR": 1200.0}, "not smaller than d_SD"),
        ({"d_SD": -1.0}, "d_SD is -1 mm"),
        ({"p_u": 0.0}, "p_u is 0 mm"),
        ({"u_0": float("nan")}, "u_0 is nan"),
        ({"n_u": 10.5}, "n_u is 10.5"),
        ({"n_v": 0}, "n_v is 0"),
        ({"theta": 2.0}, "degrees"),
        ({"image_rows": "upside-down"}, "image_rows"),
        ({"sigma": {"d_XY": 1.0}}, "d_XY"),
        ({"sigma": {"d_SR": -0.1}}, "sigma of d_SR"),
    ],
)
def test_impossible_scanners_are_refused(scanner, change, message):
    with pytest.raises(InputError, match=message):
        replace(scanner, **change)


@pytest.mark.parametrize("factor", [0, -1, 1.5])
def test_impossible_binning_is_refused(scanner, factor):
    with pytest.raises(InputError, match="binning factor"):
        scanner.binned(factor)


def test_a_sigma_of_zero_says_that_a_value_is_exact(scanner):
    stated = replace(scanner, sigma={"d_SR": 0.0, "u_0": 0.3})
    assert dict(stated.sigma) == {"d_SR": 0.0, "u_0": 0.3}
    exact = stated.exact()
    assert exact.sigma["u_0"] == 0.3
    assert all(exact.sigma[name] == 0.0 for name in PARAMETER_UNITS if name != "u_0")
