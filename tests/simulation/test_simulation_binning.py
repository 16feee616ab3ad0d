"""Binning: charges of detector pixels summed before they are digitised, in signal, noise and faults."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tomopose import Scanner
from tomopose.errors import InputError
from tomopose.simulation.detector.detector import Detector, blocks, expose, fixed_pattern
from tomopose.simulation.run import transmission
from tomopose.simulation.scene.build import simulate
from tomopose.simulation.scene.scene import scene_from

FINE = Scanner(d_SD=800.0, d_SR=200.0, p_u=0.4, p_v=0.5, u_0=60.3, v_0=57.1, n_u=122, n_v=118)
SCENE = {
    "schema": "tomopose/scene/1",
    "seed": 1,
    "scanner": {
        "d_SD_mm": 800.0,
        "d_SR_mm": 200.0,
        "p_u_mm": 0.4,
        "p_v_mm": 0.5,
        "u_0_px": 60.3,
        "v_0_px": 57.1,
        "n_u_px": 122,
        "n_v_px": 118,
    },
    "source": {"voltage_kV": 120.0},
    "detector": {"blur_sigma_px": 0.8, "cells": 3},
    "objects": [{"kind": "ball", "diameter_mm": 4.0}],
    "poses": {"scan": {"n": 3}},
}


def scene(binning, **detector):
    return scene_from(
        {**SCENE, "scanner": {**SCENE["scanner"], "binning": binning}, "detector": {**SCENE["detector"], **detector}}
    )


@pytest.mark.slow
def test_the_binned_image_is_the_mean_of_the_detector_s_pixels():
    fine, binned = simulate(scene(1)), simulate(scene(2))
    assert binned.scanner == fine.scanner.binned(2)
    assert (binned.detector.binning, binned.detector.blur_sigma) == (2, 0.4)
    a, b = blocks(transmission(fine, 1), 2) / 4, transmission(binned, 1)
    assert b.min() < 0.05
    assert np.abs(b - a).max() < 1.5e-3
    assert np.sqrt(((b - a) ** 2).mean()) < 5e-5


def test_the_variance_of_summed_quanta_is_their_mean_times_the_gain():
    small = FINE.binned(2)
    one, four = Detector(photons=2500.0, white=40000.0), Detector(photons=2500.0, white=40000.0, binning=2)
    assert four.snr == pytest.approx(2 * one.snr)
    for detector, panel in ((one, FINE), (four, small)):
        grey = np.stack([expose(np.full(panel.shape, 0.6), detector, panel, seed=2, frame=k) for k in range(12)])
        gain = 40000.0 / (2500.0 * detector.binning**2)
        assert grey.mean() == pytest.approx(24000.0, rel=1e-3)
        assert grey.var() / (gain * grey.mean()) == pytest.approx(1.0, abs=0.02)


def test_spread_light_correlates_before_it_is_summed():
    small = FINE.binned(2)
    fine, binned = Detector(photons=1e4, noise_sigma=0.8), Detector(photons=1e4, noise_sigma=0.8, binning=2)
    a = np.stack([expose(np.ones(FINE.shape), fine, FINE, seed=4, frame=k).astype(float) for k in range(20)])
    b = np.stack([expose(np.ones(small.shape), binned, small, seed=4, frame=k).astype(float) for k in range(20)])
    assert b.mean() / b.std() == pytest.approx(binned.snr, rel=0.02)
    summed = np.stack([blocks(x, 2) / 4 for x in a])
    assert b.std() == pytest.approx(summed.std(), rel=0.02)

    def neighbours(x):
        x = x - x.mean()
        return (x[:, :, 1:] * x[:, :, :-1]).mean() / x.var()

    assert neighbours(b) == pytest.approx(neighbours(summed), abs=0.01)
    assert neighbours(b) > 0.1


def test_patterns_average_and_a_dead_pixel_takes_its_share():
    small = FINE.binned(2)
    gain, dark, dead = fixed_pattern(Detector(gain_spread=0.04, dark=50.0, dark_spread=6.0, binning=2), small.shape, 3)
    assert gain.shape == small.shape
    assert gain.std() == pytest.approx(0.02, rel=0.05)
    assert dark.std() == pytest.approx(3.0, rel=0.05)
    assert not dead.any()
    gain, _, _ = fixed_pattern(Detector(dead_share=0.02, binning=2), small.shape, 3)
    assert set(np.unique(gain)) <= {0.0, 0.25, 0.5, 0.75, 1.0}
    assert gain.mean() == pytest.approx(0.98, abs=0.005)


def test_a_binned_pixel_is_read_out_once():
    detector = Detector(snr=math.inf, readout_noise=20.0, binning=2)
    grey = expose(np.full(FINE.shape, 0.5), detector, FINE, seed=5, frame=0).astype(float)
    assert grey.std() == pytest.approx(20.0, rel=0.03)


def test_no_half_binning():
    with pytest.raises(InputError, match="binning"):
        replace(Detector(), binning=0)
