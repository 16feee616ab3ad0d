"""The substitute for the paper's detector: exact where it can be, as coarse as whole pixels where it must be."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose import Scanner
from tomopose.errors import BallNotFoundError
from tomopose.simulation.objects.ball import silhouette_centre
from tomopose.studies.parts.ellipse_method import (
    centre_and_axes,
    corrected_centre,
    edge_pixels,
    ellipse_method,
    fit_ellipse,
)

SCANNER = Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.2, p_v=0.25, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)


def test_the_fit_recovers_an_exact_ellipse():
    s = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    turn = 0.3
    x = 0.2 + 1.1 * np.cos(s) * np.cos(turn) - 0.8 * np.sin(s) * np.sin(turn)
    y = -0.1 + 1.1 * np.cos(s) * np.sin(turn) + 0.8 * np.sin(s) * np.cos(turn)
    centre, major, minor = centre_and_axes(fit_ellipse(x, y))
    np.testing.assert_allclose(centre, [0.2, -0.1], atol=1e-12)
    assert major == pytest.approx(1.1, abs=1e-12)
    assert minor == pytest.approx(0.8, abs=1e-12)


def silhouette_points(x_S: np.ndarray, radius: float) -> np.ndarray:
    """Points (n, 2), px, where rays touch the ball: directions at the cone's half-angle about its axis."""
    axis = x_S / np.linalg.norm(x_S)
    a = np.linalg.svd(axis[None])[2][1:]
    gamma = np.arcsin(radius / np.linalg.norm(x_S))
    s = np.linspace(0, 2 * np.pi, 60, endpoint=False)[:, None]
    rays = np.cos(gamma) * axis + np.sin(gamma) * (np.cos(s) * a[0] + np.sin(s) * a[1])
    h = rays @ SCANNER.K.T
    return h[:, :2] / h[:, 2:]


@pytest.mark.parametrize("x_S", [[20.0, -15.0, 300.0], [-25.0, 20.0, 310.0], [1.0, 2.0, 290.0]])
def test_the_centre_is_corrected_exactly(x_S):
    x_S = np.array(x_S)
    points = silhouette_points(x_S, 4.0)
    mm = (points - [SCANNER.u_0, SCANNER.v_0]) * [SCANNER.p_u, SCANNER.p_v]
    scale = np.abs(mm).max()
    centre, _, minor = centre_and_axes(fit_ellipse(*(mm / scale).T))
    ellipse = scale * centre / [SCANNER.p_u, SCANNER.p_v] + [SCANNER.u_0, SCANNER.v_0]
    np.testing.assert_allclose(ellipse, silhouette_centre(SCANNER, x_S, 4.0)[0], atol=1e-6)
    h = SCANNER.K @ x_S
    found = corrected_centre(SCANNER, ellipse, scale * minor)
    np.testing.assert_allclose(found, h[:2] / h[2], atol=1e-6)
    if np.hypot(*x_S[:2]) > 10:  # far off the centre the correction is more than the tolerance by orders
        assert np.linalg.norm(ellipse - found) > 0.01


def disc(u: float, v: float, n_v: int = 131, n_u: int = 151) -> np.ndarray:
    """A blurred ellipse of 10 mm on pixels of 0.2 x 0.25 mm."""
    V, U = np.mgrid[:n_v, :n_u]
    r = np.hypot((U - u) * SCANNER.p_u, (V - v) * SCANNER.p_v)
    return 1000.0 + 30000.0 / (1 + np.exp(-(r - 10.0) / 0.1))


def test_a_disc_is_found_to_a_few_hundredths_of_a_pixel_and_no_better():
    origin = (int(SCANNER.u_0) - 70, int(SCANNER.v_0) - 60)
    off = []
    for du, dv in np.random.default_rng(5).uniform(0, 1, (12, 2)):
        found = ellipse_method(disc(70 + du, 60 + dv), SCANNER, origin=origin)
        off.append(found - [70 + du + origin[0], 60 + dv + origin[1]])
    rms = float(np.sqrt(np.mean(np.sum(np.square(off), axis=1))))
    assert 0.001 < rms < 0.06


def test_edges_are_whole_pixels_on_the_rim():
    u, v = edge_pixels(disc(70.3, 60.6))
    assert np.array_equal(u, np.round(u))
    r = np.hypot((u - 70.3) * SCANNER.p_u, (v - 60.6) * SCANNER.p_v)
    assert np.abs(r - 10.0).max() < 0.25


def test_an_image_without_a_ball_is_refused():
    image = np.full((60, 60), 1000.0)
    image[30, 30] = 0.0
    with pytest.raises(BallNotFoundError, match="edge pixels"):
        ellipse_method(image, SCANNER)
