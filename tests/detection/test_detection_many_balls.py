"""Several balls in one radiograph: all measured, those that overlap left out, both."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import tomopose as tp
from tomopose.errors import InputError


@pytest.fixture
def scanner() -> tp.Scanner:
    return tp.Scanner(d_SD=1000.0, d_SR=400.0, p_u=0.4, p_v=0.4, u_0=200.3, v_0=150.7, n_u=401, n_v=301)


def drawn(scanner: tp.Scanner, centres: list[tuple[float, float]], radius: float, seed: int = 0) -> np.ndarray:
    """Opaque discs, each pixel the mean of 5 x 5 samples, blurred by 0.7 px, with noise."""
    f = 5
    v, u = np.mgrid[0 : f * scanner.n_v, 0 : f * scanner.n_u]
    u, v = (u + 0.5) / f - 0.5, (v + 0.5) / f - 0.5
    fine = np.ones(u.shape, dtype=np.float32)
    for a, b in centres:
        fine[(u - a) ** 2 + (v - b) ** 2 < radius**2] = 0.05
    fine = gaussian_filter(fine, 0.7 * f)
    image = 40000 * fine.reshape(scanner.n_v, f, scanner.n_u, f).mean(axis=(1, 3))
    return np.round(image + 200 * np.random.default_rng(seed).standard_normal(image.shape)).astype(np.uint16)


def test_every_ball_is_measured_and_overlapping_ones_are_left_out(scanner):
    alone = [(60.2, 60.4), (150.7, 40.1), (330.3, 220.9), (90.6, 230.3), (240.1, 150.2), (350.8, 60.5)]
    pair = [(180.4, 240.0), (201.0, 248.5)]
    (found,) = tp.detect_balls([drawn(scanner, [*alone, *pair], 14.0)], scanner, ball_diameters=[4.5] * 8)
    x = np.array([b.x_D for b in found.balls])
    assert len(x) == len(alone)
    off = np.linalg.norm(x[:, None] - np.array(alone)[None], axis=2)
    assert sorted(off.argmin(axis=1).tolist()) == list(range(len(alone)))
    # the ellipse of a sphere is no circle: off the middle the projected centre is some hundredths inward
    assert off.min(axis=1).max() < 0.1


def test_an_unreadable_image_is_a_fault_of_its_own(scanner):
    image = drawn(scanner, [(100.0, 100.0)], 14.0)
    good, bad = tp.detect_balls([image, image[:50]], scanner, ball_diameters=[4.5])
    assert len(good.balls) == 1
    assert not bad.balls
    assert "401" in bad.fault


def test_images_that_cannot_be_used_at_all_are_refused(scanner):
    with pytest.raises(InputError, match="none of 1 images"):
        tp.detect_balls([np.zeros((50, 50))], scanner, ball_diameters=[4.5])
    with pytest.raises(InputError, match="empty"):
        tp.detect_balls([np.zeros((50, 50))], scanner, ball_diameters=[])


def test_a_blank_image_shows_no_ball(scanner):
    noise = np.random.default_rng(1).normal(40000, 200, (scanner.n_v, scanner.n_u)).astype(np.uint16)
    (found,) = tp.detect_balls([noise], scanner, ball_diameters=[4.5] * 4)
    assert found.balls == ()
    assert found.fault == ""
