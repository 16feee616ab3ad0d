"""Finding without hints, refusing what is not the ball, and the flags, each on an image made for it."""

from __future__ import annotations

import numpy as np
import pytest
from ball_images import Scene, frame, noisy, scene_of
from scipy.ndimage import uniform_filter1d

from tomopose.detection import BallImage, detect_image
from tomopose.errors import AmbiguousBallError, BallNotFoundError, BallTruncatedError, DetectionError
from tomopose.units import Array

N = 512
SHAPE = (N - 23, N)


def counts(image: Array, snr: float = 100.0, seed: int = 5, white: float = 30000.0) -> np.ndarray:
    raw = noisy(image, snr, np.random.default_rng(seed), white=white)
    return np.clip(raw, 0, 65535).round().astype(np.uint16)


def ball(radius_px: float = 40.0, u: float = 200.3, v: float = 270.6, **change: object) -> Scene:
    return scene_of(radius_px=radius_px, u=u, v=v, n=N, **change)  # type: ignore[arg-type]


def detected(scene: Scene, image: np.ndarray, **options: object) -> BallImage:
    options = {"ball_diameter": 2 * scene.radius, **options}
    return detect_image(image, scene.scanner, **options)  # type: ignore[arg-type]


def assert_right(found: BallImage, scene: Scene, within: float = 4.5) -> None:
    error = np.linalg.norm(found.x_D - scene.x_D)
    assert error < within * np.sqrt(np.trace(found.covariance))


@pytest.fixture(scope="module")
def plain() -> tuple[Scene, Array]:
    scene = ball()
    return scene, frame(scene)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [8.0, 17.0, 90.0, 180.0])
@pytest.mark.parametrize("inverted", [False, True])
def test_any_size_and_polarity(radius: float, inverted: bool) -> None:
    scene = ball(radius, 262.3, 231.6)
    image = counts(frame(scene))
    found = detected(scene, (40000 - image).astype(np.uint16) if inverted else image)
    assert_right(found, scene)
    assert ("bright ball" in found.flags) == inverted


def test_wrong_nominal_size_is_found_and_flagged(plain: tuple[Scene, Array]) -> None:
    scene, image = plain
    found = detected(scene, counts(image), ball_diameter=4 * scene.radius)
    assert_right(found, scene)
    assert found.flags == ("radius off nominal",)


def clutter(kind: str) -> Array:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    extra = np.ones(SHAPE)
    if kind == "gradient":
        return np.asarray((0.4 + 0.6 * u / N) * (0.7 + 0.3 * v / N))
    if kind == "collimator":
        extra[:, :60] = extra[:40] = 0.02
    if kind == "table and screw":
        extra[:30] = 0.1
        extra[(np.abs(u - 400) < 9) & (v < 150)] *= 0.4
        extra[np.hypot(u - 400, v - 150) < 14] = 0.3
    if kind == "hexagonal nut":
        away = (u - 390, 0.5 * (u - 390) + 0.866 * (v - 120), 0.5 * (u - 390) - 0.866 * (v - 120))
        extra[np.all([np.abs(a) < 36 for a in away], axis=0)] = 0.02
    return extra


@pytest.mark.parametrize("kind", ["gradient", "collimator", "table and screw", "hexagonal nut"])
def test_surroundings_do_not_mislead(plain: tuple[Scene, Array], kind: str) -> None:
    scene, image = plain
    found = detected(scene, counts(image * clutter(kind)))
    assert_right(found, scene)
    assert found.status == "ok"


@pytest.mark.parametrize("kind", ["hexagonal nut", "gradient"])
def test_what_is_no_ball_is_refused(plain: tuple[Scene, Array], kind: str) -> None:
    with pytest.raises(BallNotFoundError):
        detected(plain[0], counts(clutter(kind)))


def test_dead_lines_and_hot_pixels(plain: tuple[Scene, Array]) -> None:
    scene, image = plain
    raw, rng = counts(image), np.random.default_rng(6)
    raw[220:222] = 0
    raw[:, 170] = 0
    raw[:, 350:353] = 65535
    raw.flat[rng.integers(0, raw.size, 800)] = 65535
    found = detected(scene, raw)
    assert_right(found, scene)
    assert "bad pixels on the rim" in found.flags


def test_masked_and_nan_pixels_are_left_out(plain: tuple[Scene, Array]) -> None:
    scene, image = plain
    mask = np.zeros(SHAPE, dtype=bool)
    mask[260:263] = mask[:, 199] = True
    raw = counts(image)
    broken = np.where(mask, np.nan, raw.astype(np.float32))
    by_mask, by_nan = detected(scene, np.where(mask, 0, raw), mask=mask), detected(scene, broken)
    for found in (by_mask, by_nan):
        assert_right(found, scene)
        assert "bad pixels on the rim" in found.flags


def test_two_balls_are_ambiguous_unless_one_is_predicted(plain: tuple[Scene, Array]) -> None:
    scene, image = plain
    raw = counts(image * frame(ball(40.0, 400.3, 120.6)))
    with pytest.raises(AmbiguousBallError, match=r"at \(400, 12.*at \(200, 27"):
        detected(scene, raw)
    assert_right(detected(scene, raw, predicted=scene.x_D + 6), scene)


def test_half_a_rim_is_measured_with_larger_sigma_and_less_is_refused(plain: tuple[Scene, Array]) -> None:
    whole = detected(plain[0], counts(plain[1]))
    scene = ball(u=6.0)
    found = detected(scene, counts(frame(scene)))
    assert_right(found, scene)
    assert found.flags == ("truncated",)
    assert np.trace(found.covariance) > 2 * np.trace(whole.covariance)
    with pytest.raises(BallTruncatedError, match="at least half"):
        detected(scene, counts(frame(ball(u=-12.0))))


def test_saturated_rim_is_refused(plain: tuple[Scene, Array]) -> None:
    with pytest.raises(DetectionError, match="saturated rim"):
        detected(plain[0], counts(plain[1], white=90000.0))
    with pytest.raises(DetectionError, match="saturated rim"):
        detected(plain[0], np.minimum(counts(plain[1]), 25000))


def test_few_photons_are_flagged_and_hardly_any_refused(plain: tuple[Scene, Array]) -> None:
    scene, image = plain
    found = detected(scene, counts(image, snr=10, white=1000.0))
    assert_right(found, scene)
    assert found.flags == ("few photons",)
    with pytest.raises(DetectionError):
        detected(scene, counts(image, snr=0.5, white=100.0))


def test_motion_during_the_exposure(plain: tuple[Scene, Array]) -> None:
    scene, image = plain
    found = detected(scene, counts(uniform_filter1d(image, 3, axis=1)))
    assert_right(found, scene)
    assert found.flags == ("moved",)


def test_eight_bit_export(plain: tuple[Scene, Array]) -> None:
    scene, image = plain
    found = detected(scene, counts(image, white=220.0).astype(np.uint8))
    assert_right(found, scene)
    assert found.flags == ("8-bit",)


@pytest.mark.parametrize(
    "image",
    [np.zeros(SHAPE, np.uint16), np.full(SHAPE, np.nan), np.full(SHAPE, 65535, np.uint16), np.full(SHAPE, np.inf)],
    ids=["black", "nan", "white", "infinite"],
)
def test_empty_images_have_no_ball(plain: tuple[Scene, Array], image: np.ndarray) -> None:
    with pytest.raises(BallNotFoundError):
        detected(plain[0], image)


def test_noise_alone_has_no_ball(plain: tuple[Scene, Array]) -> None:
    for seed in range(6):
        with pytest.raises(DetectionError):
            detected(plain[0], counts(np.ones(SHAPE), seed=seed))
