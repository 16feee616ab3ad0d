"""Every kind of bad radiograph: measured rightly with a word about it, or refused with the reason.

One image of one ball, spoilt in one way in each test.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from ball_images import Scene, centre_at, frame, noisy, scene_of
from scipy.ndimage import gaussian_filter

import tomopose as tp
from tomopose.detection import BallImage, detect, detect_image
from tomopose.errors import (
    AmbiguousBallError,
    BallNotFoundError,
    BallTruncatedError,
    DetectionError,
    FileError,
    InputError,
    ShapeError,
)
from tomopose.units import Array

N = 320
SHAPE = (N - 23, N)
WHITE = 30000.0


def counts(image: Array, snr: float = 100.0, white: float = WHITE, seed: int = 3) -> np.ndarray:
    raw = noisy(image, snr, np.random.default_rng(seed), white=white)
    return np.clip(raw, 0, 65535).round().astype(np.uint16)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(radius_px=40.0, u=150.3, v=160.6, n=N)


@pytest.fixture(scope="module")
def clean(scene: Scene) -> Array:
    return frame(scene)


@pytest.fixture(scope="module")
def good(clean: Array) -> np.ndarray:
    return counts(clean)


def found_in(image: np.ndarray, scene: Scene, **options: object) -> BallImage:
    return detect_image(image, scene.scanner, **{"ball_diameter": 2 * scene.radius, **options})  # type: ignore[arg-type]


def assert_right(found: BallImage, scene: Scene, within: float = 4.0) -> None:
    d = found.x_D - scene.x_D
    assert d @ np.linalg.solve(found.covariance, d) < within**2


def files(folder: Path, images: list[np.ndarray]) -> list[Path]:
    """Files in TIFF's order of rows, top first."""
    paths = [folder / f"pose_{i}.tif" for i in range(len(images))]
    for path, image in zip(paths, images, strict=True):
        tifffile.imwrite(path, image[::-1])
    return paths


def test_truncated_file(scene: Scene, good: np.ndarray, tmp_path: Path) -> None:
    """A file that is cut short is named on opening; one that shrinks afterwards is one bad row, two are too many."""
    paths = files(tmp_path, [good] * 3)
    images = tp.open_images(tmp_path, scene.scanner)
    paths[1].write_bytes(paths[1].read_bytes()[:4000])
    observations = detect(images, scene.scanner, ball_diameter=2 * scene.radius)
    assert observations.seen.tolist() == [True, False, True]
    assert (observations.status or ())[1].startswith("bad image: ")
    assert "pose_1.tif" in (observations.status or ())[1]
    paths[2].write_bytes(b"")
    with pytest.raises(InputError, match=r"2 of 3 images are unusable; the first, pose_1\.tif"):
        detect(images, scene.scanner, ball_diameter=2 * scene.radius)
    with pytest.raises(FileError, match=r"pose_1\.tif"):
        tp.open_images(tmp_path, scene.scanner)


def test_eight_bit_export_is_flagged_with_a_larger_sigma(scene: Scene, clean: Array) -> None:
    sixteen = found_in(counts(clean, snr=600.0), scene)
    eight = found_in(counts(clean, snr=600.0, white=240.0).astype(np.uint8), scene)
    assert_right(eight, scene)
    assert eight.flags == ("8-bit",)
    assert np.trace(eight.covariance) > 1.2 * np.trace(sixteen.covariance)


def test_lossy_compression_is_refused(scene: Scene, good: np.ndarray, tmp_path: Path) -> None:
    pytest.importorskip("imagecodecs")
    tifffile.imwrite(tmp_path / "a.tif", (good >> 8).astype(np.uint8), compression="jpeg")
    with pytest.raises(InputError, match=r"a\.tif"):
        tp.open_images(tmp_path, scene.scanner)


def test_colour_image_is_refused(scene: Scene, good: np.ndarray) -> None:
    with pytest.raises(ShapeError, match="colour"):
        found_in(np.stack([good] * 3, axis=-1), scene)


def test_mixed_shapes_and_types(scene: Scene, good: np.ndarray, tmp_path: Path) -> None:
    """The first that differs is named."""
    with pytest.raises(ShapeError, match=r"image 1 has shape \(200, 320\).*the first \(0\) \(297, 320\)"):
        detect([good, good[:200], good], scene.scanner, ball_diameter=2 * scene.radius)
    files(tmp_path, [good, good.astype(np.float32)])
    with pytest.raises(InputError, match=r"pose_1\.tif"):
        tp.open_images(tmp_path, scene.scanner)


def test_exchanged_bytes_are_no_ball(scene: Scene, good: np.ndarray) -> None:
    with pytest.raises(DetectionError):
        found_in(good.byteswap(), scene)
    with pytest.raises(InputError, match="bytes are exchanged"):
        detect([good.byteswap()] * 2, scene.scanner, ball_diameter=2 * scene.radius)


def test_inverted_contrast(scene: Scene, good: np.ndarray) -> None:
    found = found_in((60000 - good.astype(np.int64)).astype(np.uint16), scene)
    assert_right(found, scene)
    assert found.flags == ("bright ball",)


def test_no_flat_field(scene: Scene, clean: Array) -> None:
    """Heel effect, vignetting and a gain of each pixel that was not corrected: the background is fitted locally."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] / N
    gain = (0.6 + 0.4 * u) * (1.0 - 0.3 * (v - 0.4) ** 2) * np.random.default_rng(8).normal(1.0, 0.01, SHAPE)
    found = found_in(counts(clean * gain), scene)
    assert_right(found, scene)
    assert found.status == "ok"


@pytest.mark.slow
def test_pixels_without_a_flat_field(scene: Scene, good: np.ndarray) -> None:
    """Where the flat image is no brighter than the dark one, transmission does not exist: left out, or refused."""
    transmission = good / np.float32(WHITE)
    few = transmission.copy()
    few[170:174, 105:118] = np.nan
    found = found_in(few, scene)
    assert_right(found, scene)
    assert found.flags == ("bad pixels on the rim",)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rim = np.abs(np.hypot(u - scene.x_D[0], v - scene.x_D[1]) - 40.0) < 5.0
    with pytest.raises(DetectionError):
        found_in(np.where(rim & (u > 125), np.nan, transmission), scene)


def test_images_are_not_corrected_twice(scene: Scene, good: np.ndarray, tmp_path: Path) -> None:
    files(tmp_path, [good / np.float32(WHITE)])
    flat = np.full(SHAPE, WHITE)
    with pytest.raises(InputError, match="corrected"):
        detect(
            tp.open_images(tmp_path, scene.scanner, flat=flat, dark=np.zeros(SHAPE)), scene.scanner, ball_diameter=8.0
        )


def test_saturated_and_starved_images(scene: Scene, clean: Array) -> None:
    with pytest.raises(DetectionError, match="saturated rim"):
        found_in(counts(clean, white=80000.0), scene)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    partly = found_in(counts(clean * (1.0 + 1.6 / (1.0 + np.exp(-(v - u - 52.0) / 6.0)))), scene)
    assert np.linalg.norm(partly.x_D - scene.x_D) < 0.05
    assert "saturated" in partly.flags
    starved = found_in(counts(clean, snr=10.0, white=1000.0), scene)
    assert_right(starved, scene)
    assert starved.flags == ("few photons",)


@pytest.mark.parametrize("line", ["across", "tangent", "column", "hot"])
def test_dead_lines_that_no_mask_names(scene: Scene, clean: Array, line: str) -> None:
    """Found by their residuals outside the rim and left out as a whole, on the rim too."""
    errors = []
    for seed in range(6):
        raw = counts(clean, seed=seed)
        if line == "across":
            raw[170:172] = 0
        elif line == "tangent":
            raw[199:201] = 0
        elif line == "column":
            raw[:, 112] = 100
        else:
            raw[:, 112] = 65535
        found = found_in(raw, scene)
        d = found.x_D - scene.x_D
        errors.append(d @ np.linalg.solve(found.covariance, d) / 2)
        assert "bad pixels on the rim" in found.flags
    assert np.mean(errors) < 2.5


def test_ghost_of_the_previous_pose(scene: Scene, clean: Array) -> None:
    before = scene_of(radius_px=40.0, u=215.2, v=130.4, n=N)
    images = [counts(frame(before)), counts(clean + 0.02 * (frame(before) - 1.0), seed=4)]
    observations = detect(images, scene.scanner, ball_diameter=2 * scene.radius)
    flag = (observations.status or ())[1].split("; ")[-1]
    assert flag.startswith("lag ")
    assert float(flag.split()[1]) == pytest.approx(2.0, abs=0.5)
    assert np.linalg.norm(observations.x_D[1] - scene.x_D) < 0.1


def test_ball_that_the_border_cuts() -> None:
    cut = scene_of(radius_px=40.0, u=6.3, v=160.6, n=N)
    found = found_in(counts(frame(cut)), cut)
    assert_right(found, cut)
    assert found.flags == ("truncated",)
    more = scene_of(radius_px=40.0, u=-9.3, v=160.6, n=N)
    with pytest.raises(BallTruncatedError, match="at least half"):
        found_in(counts(frame(more)), more)


def test_ball_out_of_view(scene: Scene) -> None:
    """Without a prediction nothing is found; with one the message names the place."""
    empty = counts(np.ones(SHAPE))
    with pytest.raises(BallNotFoundError):
        found_in(empty, scene)
    with pytest.raises(BallNotFoundError, match=r"predicted position \(-200.0, 100.0\) is out of view"):
        found_in(empty, scene, predicted=(-200.0, 100.0))


def test_two_balls(scene: Scene, clean: Array) -> None:
    other = scene_of(radius_px=40.0, u=255.3, v=80.6, n=N)
    both = counts(clean * frame(other))
    with pytest.raises(AmbiguousBallError, match=r"\(150, 161\).*\(255, 81\)|\(255, 81\).*\(150, 161\)"):
        found_in(both, scene)
    assert_right(found_in(both, scene, predicted=scene.x_D + 4.0), scene)


def test_glue_inside_the_ring(scene: Scene, clean: Array) -> None:
    """A lump of glue with an edge of its own sits at the rim: it may widen sigma, not move the centre by more."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    lump = gaussian_filter((np.hypot(u - 186.0, v - 178.0) < 13.0).astype(float), 0.7)
    plain = found_in(counts(clean), scene)
    errors = []
    flags: list[str] = []
    for seed in range(6):
        found = found_in(counts(clean * np.exp(-0.25 * lump), seed=seed), scene)
        flags += found.flags
        d = found.x_D - scene.x_D
        errors.append(d @ np.linalg.solve(found.covariance, d) / 2)
    assert flags.count("edge at the rim") >= 4
    assert np.trace(found.covariance) > np.trace(plain.covariance)
    assert np.linalg.norm(d) < 0.02
    assert np.mean(errors) < 4.0


def test_diameter_off_nominal(scene: Scene, good: np.ndarray) -> None:
    found = found_in(good, scene, ball_diameter=3 * scene.radius)
    assert_right(found, scene)
    assert found.flags == ("radius off nominal",)


def test_diameter_that_no_image_of_a_run_shows(scene: Scene, clean: Array) -> None:
    """By more than 2 % beyond what the run's own magnifications explain: a word; by more than 20 %: an error."""
    images = [counts(clean, seed=seed) for seed in range(5)]
    right = detect(images, scene.scanner, ball_diameter=2 * scene.radius)
    assert set(right.status or ()) == {"ok"}
    assert right.ball_diameter == 2 * scene.radius
    larger = detect(images, scene.scanner, ball_diameter=2.06 * scene.radius)
    assert set(larger.status or ()) == {"radius off nominal"}
    with pytest.raises(InputError, match="d_SD, d_SR, a pixel pitch or the diameter is wrong"):
        detect(images, scene.scanner, ball_diameter=2.6 * scene.radius)


def test_ball_that_slips_is_measured_where_it_is(scene: Scene) -> None:
    """A slip is no fault of an image: each is right for itself, and the step is in the run for calibration."""
    moved = scene_of(radius_px=40.0, u=152.8, v=160.6, n=N)
    images = [counts(frame(s), seed=k) for k, s in enumerate((scene, scene, moved, moved))]
    observations = detect(images, scene.scanner, ball_diameter=2 * scene.radius)
    assert observations.status == ("ok",) * 4
    step = observations.x_D[2:].mean(axis=0) - observations.x_D[:2].mean(axis=0)
    assert step == pytest.approx(moved.x_D - scene.x_D, abs=0.01)


def test_the_ellipse_centre_is_not_taken_for_the_balls() -> None:
    """Far off the axis at high magnification the two differ by more than a hundred standard deviations."""
    scene = scene_of(radius_px=110.0, u=150.3, v=150.6, n=N, blur=0.6)
    scanner = replace(scene.scanner, u_0=900.0, v_0=-300.0)
    centre = centre_at(scanner, 150.3, 150.6, abs(scene.centre[2]))
    off_axis = replace(scene, scanner=scanner, mu_tube=0.0, centre=centre)
    found = found_in(counts(frame(off_axis), snr=200.0), off_axis)
    assert_right(found, off_axis)
    assert np.linalg.norm(found.x_ellipse - found.x_D) > 100 * np.sqrt(np.trace(found.covariance))


def test_binning_that_the_scanner_does_not_know(scene: Scene, good: np.ndarray) -> None:
    binned = good[:296].reshape(148, 2, 160, 2).mean(axis=(1, 3))
    with pytest.raises(ShapeError, match=r"160 x 148 px.*scanner.binned\(2\)"):
        found_in(binned, scene)
    half = scene.scanner.binned(2)
    found = detect_image(binned, half, ball_diameter=2 * scene.radius)
    d = found.x_D - (scene.x_D - 0.5) / 2
    assert d @ np.linalg.solve(found.covariance, d) < 16.0


def test_cropped_image_without_its_place(scene: Scene, good: np.ndarray) -> None:
    part = good[60:260, 40:300]
    with pytest.raises(ShapeError, match=r"origin=\(u, v\)"):
        found_in(part, scene)
    assert_right(found_in(part, scene, origin=(40, 60)), scene)


def test_exchanged_pixel_pitches() -> None:
    """On a panel whose pixels are not square the silhouette is no circle of the declared pitches: named in a run."""
    scene = scene_of(radius_px=40.0, u=150.3, v=160.6, n=N, pitch=(0.2, 0.26))
    image = counts(frame(scene))
    assert_right(found_in(image, scene), scene)
    exchanged = replace(scene.scanner, p_u=0.26, p_v=0.2)
    with pytest.raises(DetectionError):
        detect_image(image, exchanged, ball_diameter=2 * scene.radius)
    with pytest.raises(InputError, match=r"p_u = 0\.26 mm and p_v = 0\.2 mm are exchanged"):
        detect([image], exchanged, ball_diameter=2 * scene.radius)


def test_an_error_of_our_own_inside_the_fit_is_never_called_a_bad_image(
    scene: Scene, good: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*args: object, **options: object) -> BallImage:
        raise ValueError("operands could not be broadcast together with shapes (3,) (4,)")

    monkeypatch.setattr("tomopose.detection.run.rows.detect_image", broken)
    with pytest.raises(ValueError, match="broadcast") as caught:
        detect([good, good], scene.scanner, ball_diameter=8.0)
    assert not isinstance(caught.value, InputError)


def test_an_image_that_cannot_be_read_is_a_bad_image(scene: Scene, good: np.ndarray) -> None:
    """Rows of different lengths are no array."""
    found = detect([good, [[1, 2], [3]]], scene.scanner, ball_diameter=8.0)
    assert found.seen.tolist() == [True, False]
    assert found.status[1].startswith("bad image: ")
