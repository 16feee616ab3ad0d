"""Photon noise: Poisson by moments, spectrum as asked, and the same numbers whoever draws them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tomopose import Scanner
from tomopose.errors import InputError
from tomopose.simulation.detector.detector import Detector, beam_profile, expose, fixed_pattern, reference_images
from tomopose.simulation.detector.noise import add_normal_noise, add_photon_noise, frame_key

N = 1000
PANEL = Scanner(d_SD=1000.0, d_SR=500.0, p_u=0.2, p_v=0.25, u_0=140.0, v_0=130.0, n_u=301, n_v=257)


@pytest.mark.parametrize("mean", [0.0, 0.3, 5.0, 40.0, 80.0, 1000.0, 40000.0])
def test_variance_is_the_mean(mean):
    out = np.empty((N, N))
    add_photon_noise(np.full((N, N), mean), frame_key(3, 1), 0, N, out)
    assert abs(out.mean() - mean) <= 4 * math.sqrt(mean) / N
    if mean:
        assert out.var() / mean == pytest.approx(1.0, abs=0.01)
        skewness = ((out - mean) ** 3).mean() / mean**1.5
        assert skewness == pytest.approx(1 / math.sqrt(mean), abs=0.02)


def test_pixels_are_independent_and_frames_differ():
    mean, a, b = np.full((401, 403), 900.0), np.empty((401, 403)), np.empty((401, 403))
    add_photon_noise(mean, frame_key(0, 0), 0, 401, a)
    add_photon_noise(mean, frame_key(0, 1), 0, 401, b)
    a, b = (a - 900) / 30, (b - 900) / 30
    limit = 4.5 / math.sqrt(a.size)
    for shift in ((0, 1), (1, 0), (1, 1), (0, 2)):
        assert abs((a * np.roll(a, shift, (0, 1))).mean()) < limit
    assert abs((a * b).mean()) < limit


def test_bands_do_not_change_a_byte():
    T = np.random.default_rng(0).random((257, 301))
    for detector in (
        Detector(),
        Detector(readout_noise=3.0, dark=100.0, gain_spread=0.01, noise_sigma=0.8, falloff=True),
    ):
        one = expose(T, detector, PANEL, seed=5, frame=2)
        assert (one == expose(T, detector, PANEL, seed=5, frame=2, threads=3)).all()
        assert (one != expose(T, detector, PANEL, seed=6, frame=2)).any()


def test_normal_noise_has_its_sigma():
    image = np.zeros((N, N))
    add_normal_noise(image, 2.5, frame_key(1, 1), 0, N)
    assert image.std() == pytest.approx(2.5, rel=0.005)
    assert abs((image**4).mean() / image.var() ** 2 - 3) < 0.05


def test_the_noise_power_spectrum_is_that_of_the_scintillator():
    sigma, n = 0.8, 256
    square = Scanner(d_SD=1000.0, d_SR=500.0, p_u=0.2, p_v=0.2, u_0=127.0, v_0=127.0, n_u=n, n_v=n)
    detector = Detector(snr=100.0, noise_sigma=sigma, white=50000.0)
    power = np.zeros((n, n))
    frames = 60
    for k in range(frames):
        grey = expose(np.ones((n, n)), detector, square, seed=9, frame=k).astype(float)
        power += np.abs(np.fft.fft2(grey - grey.mean())) ** 2 / n**2 / frames
    f = np.fft.fftfreq(n)
    asked = np.exp(-4 * np.pi**2 * sigma**2 * (f[:, None] ** 2 + f[None, :] ** 2))
    asked *= (50000.0 / 100.0) ** 2 / asked.mean()
    radius = np.hypot(f[:, None], f[None, :])
    for low, high in ((0.02, 0.08), (0.08, 0.16), (0.16, 0.24), (0.24, 0.32)):
        ring = (radius >= low) & (radius < high)
        assert power[ring].mean() / asked[ring].mean() == pytest.approx(1.0, abs=0.02)
    assert math.sqrt(power.mean()) == pytest.approx(500.0, rel=0.01)


def test_snr_of_the_empty_beam_is_as_asked():
    grey = expose(np.ones(PANEL.shape), Detector(snr=150.0), PANEL, seed=1, frame=0).astype(float)
    assert grey.mean() / grey.std() == pytest.approx(150.0, rel=0.02)
    photons = Detector(photons=10000.0, averages=4)
    grey = expose(np.ones(PANEL.shape), photons, PANEL, seed=1, frame=0).astype(float)
    assert grey.mean() / grey.std() == pytest.approx(200.0, rel=0.02)


def test_correction_removes_the_fixed_pattern():
    detector = Detector(snr=math.inf, dark=500.0, dark_spread=20.0, gain_spread=0.05, falloff=True, white=40000.0)
    T = np.full(PANEL.shape, 0.37)
    grey = expose(T, detector, PANEL, seed=4, frame=0).astype(float)
    np.testing.assert_allclose(grey, 0.37 * 40000.0, atol=1.5)
    raw = expose(T, Detector(**{**detector.__dict__, "output": "raw"}), PANEL, seed=4, frame=0).astype(float)
    gain, dark, _ = fixed_pattern(detector, PANEL.shape, 4)
    np.testing.assert_allclose(raw, dark + gain * 40000.0 * 0.37 * beam_profile(PANEL, detector), atol=0.51)
    assert reference_images(detector, PANEL, 4)[1].std() > 1000


def test_saturation_depth_and_dead_pixels():
    grey = expose(
        np.linspace(0, 1.4, 301)[None] * np.ones((257, 1)),
        Detector(snr=math.inf, saturation=50000.0),
        PANEL,
        seed=0,
        frame=0,
    )
    assert grey.max() == 50000
    grey = expose(np.ones(PANEL.shape), Detector(white=900.0, bits=10), PANEL, seed=0, frame=0)
    assert grey.max() <= 1023
    dead = expose(np.ones(PANEL.shape), Detector(dead_share=0.01), PANEL, seed=0, frame=0) == 0
    assert 0.007 < dead.mean() < 0.013


@pytest.mark.parametrize(
    "values",
    [
        {"snr": 0.0},
        {"snr": math.nan},
        {"photons": -1.0},
        {"blur_sigma": -0.1},
        {"white": 7e4},
        {"bits": 17},
        {"lag": (0.6, 0.5)},
        {"dead_share": 0.7},
        {"output": "log"},
        {"averages": 0},
        {"cells": 40},
    ],
)
def test_impossible_detectors_are_refused(values):
    with pytest.raises(InputError):
        Detector(**values)
