"""The cone, its silhouette and the profiles across it, against definitions typed independently."""

from __future__ import annotations

import numpy as np
import pytest
from ball_images import Scene, centre_at, noise_free, window
from scipy.integrate import quad
from scipy.stats import norm

from tomopose import Scanner
from tomopose.detection import detect_image
from tomopose.detection.rim_fit.cone import cone_angle, cone_coordinates, cone_radius
from tomopose.detection.rim_fit.edge_profile import edge_profile
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
def test_profiles_are_convolutions(kappa: float) -> None:
    sigma, radius = 0.8, 30.0
    table, first, step = edge_profile(sigma, kappa, radius, -8.0, 8.0)

    def through(s: float) -> float:
        if s >= 0:
            return 1.0
        return 0.0 if np.isinf(kappa) else float(np.exp(-kappa * np.sqrt(1 - (1 + s / radius) ** 2)))

    for i in (40, 180, 320, 333, 420, 560):
        s = first + i * step

        def convolved(f: object, at: float = s) -> float:
            low, high = at - 7 * sigma, at + 7 * sigma
            cut = [0.0] if low < 0 < high else None
            return quad(lambda x: f(x) * norm.pdf(at - x, scale=sigma), low, high, points=cut, epsabs=1e-11)[0]  # type: ignore[operator]

        # A pixel is a box: beyond its variance, which sigma holds, its fourth cumulant -(c^4 + s^4) / 120, mean 3/4.
        ratio = s / sigma
        box = -0.75 / 120 / 24 * -(ratio**3 - 3 * ratio) * norm.pdf(ratio) / sigma**4
        tolerance = 1e-9 if np.isinf(kappa) else 2e-5
        assert table[i, 0] == pytest.approx(convolved(through) + box, abs=tolerance)
        assert table[i, 3] == pytest.approx(convolved(lambda x: x * through(x)), abs=10 * tolerance)
        assert table[i, 4] == pytest.approx(convolved(lambda x: max(x, 0.0) ** 2 / 2), abs=1e-8)


def test_simulation_and_model_agree_without_noise_and_holder(tilted: Scanner) -> None:
    """Two independent computations of a blurred silhouette: the centre agrees to 0.0002 px, the radius to 0.02 px."""
    for pixel in ((301.3, 850.9), (700.55, 611.25)):
        scene = Scene(scanner=tilted, centre=centre_at(tilted, *pixel, 300.0), mu_tube=0.0)
        box = window(scene)
        ball = detect_image(noise_free(scene, **box), tilted, origin=(box["u"], box["v"]))
        assert np.abs(ball.x_D - scene.x_D).max() < 2e-4
        exact = np.arcsin(scene.radius / np.linalg.norm(scene.centre))
        assert ball.radius == pytest.approx(cone_radius(tilted, scene.x_D, exact), abs=0.02)
