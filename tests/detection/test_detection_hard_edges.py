"""A drawn disk without any blur, whose rim no edge model fits; and what a refused image leaves behind."""

from __future__ import annotations

import gc
import weakref

import numpy as np

import tomopose as tp
from tomopose.detection.image import detect_image

SCANNER = tp.Scanner(d_SD=1500.0, d_SR=300.0, p_u=0.1, p_v=0.1, u_0=300.3, v_0=250.8, n_u=601, n_v=503)
CENTRE = np.array([290.4, 247.7])


def drawn(radius: float = 200.0) -> np.ndarray:
    v, u = np.mgrid[0:503, 0:601]
    level = np.where(np.hypot(u - CENTRE[0], v - CENTRE[1]) < radius, 300, 30000)
    return (level + np.random.default_rng(1).integers(0, 200, level.shape)).astype(np.uint16)


def test_rim_that_nothing_fits_is_doubted_once():
    found = detect_image(drawn(), SCANNER, ball_diameter=8.0)
    sigma = np.sqrt(np.diag(found.covariance))
    assert (sigma > 0.002).all()
    assert (sigma < 0.05).all()
    assert (np.abs(found.x_D - CENTRE) < 3 * sigma).all()


def test_refused_image_is_freed_at_once():
    kept: list[weakref.ref[np.ndarray]] = []

    def images():
        for k in range(2):
            image = np.random.default_rng(k).integers(20000, 20200, (503, 601)).astype(np.uint16)
            kept.append(weakref.ref(image))
            yield image

    gc.disable()
    try:
        observed = tp.detect(images(), SCANNER, ball_diameter=8.0)
        assert not observed.seen.any()
        assert kept[0]() is None
    finally:
        gc.enable()
