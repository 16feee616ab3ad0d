"""The cone, its silhouette and the profiles across it, against definitions typed independently."""

from __future__ import annotations

import numpy as np
import pytest
from ball_images import Scene, centre_at, noise_free, window
from scipy.integrate import quad
from scipy.special import i0e
from scipy.stats import norm

from tomopose import Scanner
from tomopose.detection import detect_image
from tomopose.detection.rim_model.cone import cone_angle, cone_coordinates, cone_radius
from tomopose.detection.rim_model.edge_profile import edge_profile
from tomopose.geometry.silhouette import silhouette_ellipse


@pytest.fixture
def tilted() -> Scanner:
    return Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203,
                   eta=0.02, theta=0.03, phi=-0.04)  # fmt: skip


def test_silhouette_is_the_quadric_of_the_sphere(tilted: Scanner) -> None:
    """x' (c c' - (c.c - r^2) I) x = 0 for a sphere of centre c, radius r, in S."""
    c, r = np.array(centre_at(tilted, 301.3, 850.9, 320.0)), 4.0
    gamma = np.arcsin(r / np.linalg.norm(c))
    x = tilted.K @ c
    centre, major, minor, angle = silhouette_ellipse(tilted, x[:2] / x[2], gamma)
    turn = np.linspace(0, 2 * np.pi, 50)
    axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rim = centre + (axes @ np.stack([major * np.cos(turn), minor * np.sin(turn)])).T
    ray = np.linalg.solve(tilted.K, np.column_stack([rim, np.ones(50)]).T)
    quadric = np.outer(c, c) - (c @ c - r**2) * np.eye(3)
    value = np.einsum("in,ij,jn->n", ray, quadric, ray) / np.einsum("in,in->n", ray, ray) / (c @ c)
    assert np.abs(value).max() < 1e-12
    assert np.linalg.norm(centre - x[:2] / x[2]) > 0.01


def test_distance_is_zero_on_the_rim_and_its_derivatives_hold(tilted: Scanner) -> None:
    x_D, radius = np.array([301.3, 850.9]), 60.0
    gamma = cone_angle(tilted, x_D, radius)
    assert cone_radius(tilted, x_D, gamma) == pytest.approx(radius, rel=1e-12)
    centre, major, minor, angle = silhouette_ellipse(tilted, x_D, gamma)
    turn = np.linspace(0, 6, 40)
    u = centre[0] + major * np.cos(turn) * np.cos(angle) - minor * np.sin(turn) * np.sin(angle)
    v = centre[1] + major * np.cos(turn) * np.sin(angle) + minor * np.sin(turn) * np.cos(angle)

    def s(x: float, y: float, g: float) -> np.ndarray:
        return np.asarray(cone_coordinates(u, v, np.linalg.inv(tilted.K), tilted.p_u, tilted.p_v, x, y, g))

    rim = s(*x_D, gamma)
    assert np.abs(rim[0]).max() < 1e-8
    assert rim[4] ** 2 + rim[5] ** 2 == pytest.approx(np.ones(40))
    h = 1e-4
    assert (s(x_D[0] + h, x_D[1], gamma) - s(x_D[0] - h, x_D[1], gamma))[0] / (2 * h) == pytest.approx(rim[1], abs=1e-5)
    assert (s(x_D[0], x_D[1] + h, gamma) - s(x_D[0], x_D[1] - h, gamma))[0] / (2 * h) == pytest.approx(rim[2], abs=1e-5)


@pytest.mark.parametrize("kappa", [np.inf, 1.7])
@pytest.mark.parametrize(("sigma", "radius"), [(0.8, 30.0), (2.5, 11.0), (6.0, 10.0)])
def test_profiles_are_convolutions_in_the_plane(kappa: float, sigma: float, radius: float) -> None:
    """Over angles a plane Gaussian has the kernel rho / sigma^2 exp(-(r - rho)^2 / 2 sigma^2) I_0e(r rho / sigma^2)."""
    table, first, step = edge_profile(sigma, kappa, radius, -0.9 * radius, 5 * sigma)

    def through(rho: float) -> float:
        if rho >= radius:
            return 1.0
        return 0.0 if np.isinf(kappa) else float(np.exp(-kappa * np.sqrt(1 - (rho / radius) ** 2)))

    def blurred(r: float) -> float:
        low, high = max(r - 8 * sigma, 0.0), r + 8 * sigma
        cut = [radius] if low < radius < high else None

        def f(rho: float) -> float:
            return through(rho) * rho / sigma**2 * np.exp(-0.5 * ((r - rho) / sigma) ** 2) * i0e(r * rho / sigma**2)

        return float(quad(f, low, high, points=cut, epsabs=1e-10, limit=200)[0])

    for i in range(20, len(table) - 2, len(table) // 9):
        s = first + i * step
        # A pixel is a box: beyond its variance, which sigma holds, its fourth cumulant -(c^4 + s^4) / 120, mean 3/4.
        ratio = s / sigma + sigma / (2 * radius)
        box = 0.75 / 120 / 24 * (ratio**3 - 3 * ratio) * norm.pdf(ratio) / sigma**4
        O = blurred(radius + s) + box
        slope = (blurred(radius + s + 1e-3) - blurred(radius + s - 1e-3)) / 2e-3
        assert table[i, 0] == pytest.approx(O, abs=2e-4)
        assert table[i, 1] == pytest.approx(slope, abs=4e-4)
        assert table[i, 3] == pytest.approx(s * O + sigma**2 * slope, abs=4e-4 * max(radius, sigma**2))


@pytest.mark.parametrize("kappa", [np.inf, 1.7])
def test_derivatives_of_the_profiles(kappa: float) -> None:
    """By radius at a fixed place, and by attenuation, against differences."""
    sigma, radius, h = 3.0, 12.0, 1e-3
    table, first, step = edge_profile(sigma, kappa, radius, -10.0, 12.0)
    s = first + step * np.arange(len(table))

    def level(kappa: float, radius_: float) -> np.ndarray:
        other, start, width = edge_profile(sigma, kappa, radius_, -11.0, 13.0)
        return np.interp(s + radius - radius_, start + width * np.arange(len(other)), other[:, 0])

    inner = slice(3, -3)
    by_radius = (level(kappa, radius + h) - level(kappa, radius - h)) / (2 * h)
    assert -table[inner, 10] == pytest.approx(by_radius[inner], abs=5e-4)
    if np.isfinite(kappa):
        by_kappa = (level(kappa + h, radius) - level(kappa - h, radius)) / (2 * h)
        assert table[inner, 7] == pytest.approx(by_kappa[inner], abs=2e-4)


@pytest.mark.slow
def test_simulation_and_model_agree_without_noise_and_holder(tilted: Scanner) -> None:
    """Two independent computations of a blurred silhouette: the centre agrees to 0.0002 px, the radius to 0.002 px."""
    for pixel in ((301.3, 850.9), (700.55, 611.25)):
        scene = Scene(scanner=tilted, centre=centre_at(tilted, *pixel, 300.0), mu_tube=0.0)
        box = window(scene)
        ball = detect_image(noise_free(scene, **box), tilted, origin=(box["u"], box["v"]), ball_diameter=8.0)
        assert np.abs(ball.x_D - scene.x_D).max() < 2e-4
        exact = np.arcsin(scene.radius / np.linalg.norm(scene.centre))
        assert ball.radius == pytest.approx(cone_radius(tilted, scene.x_D, exact), abs=0.002)
