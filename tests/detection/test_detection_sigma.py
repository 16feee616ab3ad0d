"""What the covariance is made of: correlated noise, edges at the rim, and what is mere chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_images import Scene, noise_free, noisy, standard_scene, window
from scipy.ndimage import gaussian_filter

from tomopose.detection import detect_image
from tomopose.detection.rim_fit.noise import correlation, excess_variance, sandwich
from tomopose.detection.rim_fit.sector_test import kept_weight, model_change
from tomopose.detection.settings import DEFAULT, NoiseSettings
from tomopose.units import Array

SIZE = 60
PARTS, RARE = DEFAULT.sector_test.parts, DEFAULT.noise.rare
V, U = np.mgrid[:SIZE, :SIZE].reshape(2, -1).astype(float)


def scintillator(seed: int, blur: float = 0.6) -> Array:
    """White noise of unit variance after a blur, scaled back to unit variance."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(SIZE, SIZE)), blur, mode="wrap")
    return np.asarray(noise / noise.std())


def test_white_noise_has_no_correlation() -> None:
    for seed in range(20):
        rho = correlation(U, V, np.random.default_rng(seed).normal(size=U.size), NoiseSettings())
        assert np.count_nonzero(rho) == 1
        assert rho.sum() == 1.0


def test_correlation_of_a_scintillator() -> None:
    """Noise blurred by g: the variance of a large sum over that of as many independent pixels is 1 / sum g^2."""
    g = np.zeros((21, 21))
    g[10, 10] = 1.0
    truth = 1.0 / float((gaussian_filter(g, 0.6) ** 2).sum())
    found = [correlation(U, V, scintillator(seed).ravel(), NoiseSettings()).sum() for seed in range(10)]
    assert np.mean(found) == pytest.approx(truth, rel=0.06)
    assert np.ptp(found) < 0.5 * truth


def test_sandwich_is_the_variance_of_weighted_sums() -> None:
    rng = np.random.default_rng(2)
    influence = np.stack([np.cos(U / 7.0), np.sin(V / 9.0)], axis=1) * rng.uniform(0.5, 1.5, U.size)[:, None]
    influence[(U < 8) | (V < 8) | (U > SIZE - 9) | (V > SIZE - 9)] = 0.0
    rho = correlation(U, V, scintillator(0).ravel(), NoiseSettings())
    sums = np.array([influence.T @ scintillator(seed).ravel() for seed in range(1, 1000)])
    found = sandwich(U, V, influence, rho)
    assert np.diag(found) == pytest.approx(sums.var(axis=0), rel=0.15)
    white = influence.T @ influence
    sharpened = np.zeros((11, 11))
    sharpened[5, 5], sharpened[5, 6], sharpened[5, 4] = 1.0, -0.6, -0.6
    assert sandwich(U, V, influence, sharpened) == pytest.approx(white, rel=1e-9)


def test_what_chance_may_do_does_not_count() -> None:
    assert excess_variance(0.9, 100.0, RARE) == 1.0
    assert excess_variance(1.1, 100.0, RARE) < 1.01
    assert excess_variance(3.0, 100.0, RARE) == pytest.approx(3.0, rel=1e-6)
    squares = np.random.default_rng(3).chisquare(200.0, 4000) / 200.0
    assert np.mean([excess_variance(x, 200.0, RARE) for x in squares]) < 1.005


def shares(*, offset: float = 0.0, scale: float = 1.0, noise: float = 1.0) -> Array:
    """What 12 sectors of 22 x 9 px keep of their weight: white residuals, except for an offset in the fifth."""
    s, along = np.meshgrid(np.arange(0.5, 22.0), np.arange(12 * 9.0), indexing="ij")
    left = (along // 9).astype(np.int64).ravel()
    residual = scale * np.random.default_rng(4).normal(size=left.size) + offset * (left == 5)
    part = (along % 9 / 9).ravel()
    cells = (DEFAULT.sector_test.cell, PARTS, RARE)
    return np.asarray(kept_weight(s.ravel(), left, part, residual, 12, cells, 2.5, noise))


def test_a_sector_that_misfits_loses_its_weight() -> None:
    assert shares().min() > 0.8
    spoilt = shares(offset=1.5)
    assert spoilt[5] == pytest.approx(1 / (1 + 1.5**2 * 3 * 9 / PARTS), rel=0.3)
    assert np.delete(spoilt, 5).min() > 0.8
    assert shares(scale=2.0, noise=4.0).min() > 0.8


def test_changes_of_the_model() -> None:
    rng = np.random.default_rng(5)
    k, left = 4, np.array([0, 1, 3, 3])
    jacobian, step = rng.normal(size=(14, 4)), rng.normal(size=8 + 3 * k)
    expected = [
        jacobian[:8, i] @ step[:8]
        + jacobian[8:11, i] @ step[8 + 3 * node : 11 + 3 * node]
        + jacobian[11:, i] @ step[8 + 3 * ((node + 1) % k) : 11 + 3 * ((node + 1) % k)]
        for i, node in enumerate(left)
    ]
    assert model_change(jacobian, left, step, k) == pytest.approx(np.array(expected))


@pytest.fixture(scope="module")
def tilted() -> tuple[Scene, dict[str, int], Array]:
    """A tube whose end runs aslant past the ball: no smooth background."""
    scene = replace(standard_scene(2.7), tube_roll=-0.3, tube_tilt=0.25, tube_top=1.5)
    box = window(scene)
    return scene, box, noise_free(scene, **box)


def test_sigma_is_honest_where_no_smooth_background_fits(tilted: tuple[Scene, dict[str, int], Array]) -> None:
    """At SNR 800 the holder's edges, not noise, make most of the error."""
    scene, box, clean = tilted
    rng = np.random.default_rng(6)
    squares = []
    for _ in range(40):
        ball = detect_image(
            noisy(clean, 800, rng, white=30000.0), scene.scanner, origin=(box["u"], box["v"]), ball_diameter=8.0
        )
        d = ball.x_D - scene.x_D
        squares.append(d @ np.linalg.solve(ball.covariance, d) / 2)
    assert 0.3 < np.mean(squares) < 1.6


def test_a_holders_edge_is_no_correlated_noise(tilted: tuple[Scene, dict[str, int], Array]) -> None:
    scene, box, clean = tilted
    rng = np.random.default_rng(7)
    images = [noisy(clean, 200, rng, white=30000.0) for _ in range(10)]
    found = [detect_image(image, scene.scanner, origin=(box["u"], box["v"]), ball_diameter=8.0) for image in images]
    assert sum(ball.correlated for ball in found) <= 1
