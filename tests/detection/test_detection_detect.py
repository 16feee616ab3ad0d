"""Whole runs: rows in order, one bad image refused by itself, the same bytes everywhere, resumption."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ball_images import frame, noisy, scene_of

from tomopose import Scanner
from tomopose.detection import detect, detect_image
from tomopose.errors import InputError, ShapeError
from tomopose.io.images import open_images, write_tiff
from tomopose.kept import StartsAnewWarning
from tomopose.observations import BallObservations

N = 256


class Stack:
    """A lazy sequence as readers give it."""

    def __init__(self, images: list[np.ndarray]) -> None:
        self.images, self.names, self.mask = images, tuple(f"pose_{i}.tif" for i in range(len(images))), None
        self.pixels_read = 0

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, i: int) -> np.ndarray:
        return self.images[i]

    def region(self, i: int, v0: int, v1: int, u0: int, u1: int) -> np.ndarray:
        self.pixels_read += (v1 - v0) * (u1 - u0)
        return self.images[i][v0:v1, u0:u1]


@pytest.fixture(scope="module")
def run() -> tuple[Scanner, list[np.ndarray], np.ndarray]:
    images, truth = [], []
    rng = np.random.default_rng(8)
    for u, v in ((90.3, 80.2), (150.7, 90.1), (120.2, 140.9), (160.5, 150.5), (95.1, 150.2), (130.4, 120.3)):
        scene = scene_of(radius_px=25.0, u=u, v=v, n=N)
        images.append(noisy(frame(scene), 100, rng, white=30000).round().astype(np.uint16))
        truth.append(scene.x_D)
    return scene.scanner, images, np.array(truth)


def same(a: BallObservations, b: BallObservations) -> bool:
    return (
        a.x_D.tobytes() == b.x_D.tobytes()
        and a.covariance.tobytes() == b.covariance.tobytes()
        and (a.status == b.status)
    )


@pytest.mark.slow
def test_rows_and_progress(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, truth = run
    calls: list[tuple[int, int]] = []
    seen = detect(
        images, scanner, pose_id=list("abcdef"), progress=lambda d, t: calls.append((d, t)), ball_diameter=8.0
    )
    assert seen.pose_id == tuple("abcdef")
    assert seen.status == ("ok",) * 6
    assert np.abs(seen.x_D - truth).max() < 0.02
    assert calls == [(k, 6) for k in range(1, 7)]


@pytest.mark.slow
def test_the_same_bytes_whatever_does_the_work(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    distributed = pytest.importorskip("distributed")
    scanner, images, _ = run
    here = detect(images, scanner, ball_diameter=8.0)
    assert same(here, detect((i for i in images), scanner, workers=2, ball_diameter=8.0))
    assert same(here, detect(Stack(images), scanner, workers=2, ball_diameter=8.0))
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        assert same(here, detect(Stack(images), scanner, executor=client, ball_diameter=8.0))


def test_predicted_positions_read_regions_only(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, truth = run
    stack = Stack(images)
    seen = detect(stack, scanner, predicted=truth + 3.0, ball_diameter=8.0)
    assert seen.seen.all()
    assert stack.pixels_read < 0.75 * 6 * images[0].size
    assert np.abs(seen.x_D - truth).max() < 0.02
    astray = detect(stack, scanner, predicted=np.tile([-500.0, 900.0], (6, 1)), ball_diameter=8.0)
    assert not astray.seen.any()
    assert all(s.startswith("not found: the predicted position") for s in astray.status or ())


def test_cropped_images(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, truth = run
    seen = detect([i[20:230, 10:240] for i in images], scanner, origin=(10, 20), ball_diameter=8.0)
    assert np.abs(seen.x_D - truth).max() < 0.02


def test_one_bad_image_is_one_bad_row(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, _ = run
    bad = [*images[:2], np.zeros_like(images[0]), images[3], images[0].byteswap(), images[4]]
    seen = detect(bad, scanner, ball_diameter=8.0)
    assert seen.seen.tolist() == [True, True, False, True, False, True]
    assert np.isnan(seen.x_D[2]).all()
    assert [r.split(":")[0] for r in np.array(seen.status)[~seen.seen]] == ["not found", "bad image"]
    assert "bytes are exchanged" in (seen.status or ())[4]
    with pytest.raises(InputError, match="2 of 7 images are unusable; the first, 4: each pixel's two bytes"):
        detect([*bad, images[1].byteswap()], scanner, ball_diameter=8.0)


def test_images_of_one_run_have_one_form(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, _ = run
    with pytest.raises(ShapeError, match=r"image 1 has shape \(233, 256, 3\).*colour"):
        detect([images[0], np.stack([images[0]] * 3, axis=-1), images[1]], scanner, ball_diameter=8.0)
    with pytest.raises(ShapeError, match=r"image 2 has shape \(100, 256\)"):
        detect([*images[:2], images[2][:100]], scanner, ball_diameter=8.0)
    with pytest.raises(InputError, match=r"image 1 .* of complex128, the first .* of uint16"):
        detect([images[0], images[1].astype(complex)], scanner, ball_diameter=8.0)
    crops = [images[0][20:230, 10:240], images[1][20:220, 10:250]]
    assert detect(crops, scanner, origin=[(10, 20), (10, 20)], ball_diameter=8.0).seen.all()  # type: ignore[arg-type]


def test_a_fault_of_all_images_is_an_error(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, _ = run
    half = [i[: N - 24 : 2, ::2][: scanner.n_v // 2, : scanner.n_u // 2] for i in images]
    with pytest.raises(ShapeError, match=r"scanner.binned\(2\)"):
        detect(half, scanner, ball_diameter=8.0)
    with pytest.raises(ShapeError, match="at least 16"):
        detect([i[:9, :9] for i in images], scanner, origin=(5, 5), ball_diameter=8.0)
    with pytest.raises(InputError, match="6 images but 2 pose ids"):
        detect(images, scanner, pose_id=[1, 2], ball_diameter=8.0)
    with pytest.raises(InputError, match="ball_diameter"):
        detect(images, scanner, ball_diameter=-1.0)
    with pytest.raises(ShapeError, match="beyond the detector"):
        detect_image(images[0], scanner, origin=(40, 40), ball_diameter=8.0)


@pytest.mark.slow
def test_lag_of_the_previous_pose_is_corrected(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    """3 % of the previous image: measured where its rim lies clear of the ball, and known from there elsewhere.

    There the ghost's rim crosses the ball's and moves its centre by 0.02 px, eight standard deviations, unless it is
    taken away.
    """
    scanner = run[0]
    corrected, as_it_is = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        places = ((70.3, 70.2), (120.3, 120.2), (131.2, 126.1))
        scenes = [scene_of(radius_px=25.0, u=u, v=v, n=N) for u, v in places]
        images = [noisy(frame(scenes[0]), 200, rng, white=30000)]
        for scene in scenes[1:]:
            images.append(noisy(frame(scene), 200, rng, white=30000) + 0.03 * (images[-1] - 30000.0))
        found = detect(images, scanner, ball_diameter=8.0)
        for status in (found.status or ())[1:]:
            assert status.startswith("lag")
            assert float(status.split()[1]) == pytest.approx(3.0, abs=0.5)
        plain = detect_image(images[2], scanner, ball_diameter=8.0).x_D
        for x_D, out in ((found.x_D[2], corrected), (plain, as_it_is)):
            error = x_D - scenes[2].x_D
            out.append(error @ np.linalg.solve(found.covariance[2], error) / 2)
    assert np.mean(corrected) < 2.5
    assert np.mean(as_it_is) > 10 * np.mean(corrected)


def test_two_balls_in_one_image(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    """Identified by size, or by prediction where they are alike; each row is one image and one ball."""
    scanner = run[0]
    large = scene_of(radius_px=25.0, u=90.3, v=80.2, n=N, mu_tube=0.0)
    for radius, by_size in ((15.0, True), (25.0, False)):
        small = scene_of(radius_px=25.0, u=170.7, v=150.1, n=N, mu_tube=0.0)
        small = replace(small, radius=small.radius * radius / 25.0)
        image = noisy(frame(large, extra=frame(small)), 100, np.random.default_rng(4), white=30000)
        sizes = {0: 2 * large.radius, 7: 2 * small.radius}
        truth = np.array([large.x_D, small.x_D])
        with_places = detect([image] * 2, scanner, ball_diameter=sizes, ball_id=[0, 7], predicted=truth + 3.0)
        assert np.abs(with_places.x_D - truth).max() < 0.02
        assert list(with_places.ball_id) == [0, 7]
        without = detect([image] * 2, scanner, ball_diameter=sizes, ball_id=[0, 7])
        if by_size:
            assert np.abs(without.x_D - truth).max() < 0.02
        else:
            assert not without.seen.any()
            assert all("give predicted positions" in s for s in without.status or ())
    with pytest.raises(InputError, match="ball 3 has no diameter"):
        detect([image], scanner, ball_diameter=sizes, ball_id=[3])
    with pytest.raises(InputError, match="no ball_id"):
        detect([image], scanner, ball_diameter=sizes)


def test_arguments_of_another_type_are_refused_by_name(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, _ = run
    with pytest.raises(InputError, match=r"scanner must be a Scanner; a str was given: read_scanner"):
        detect(images, "scanner.json", ball_diameter=8.0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="ball_diameter must be a number of mm; a str was given"):
        detect_image(images[0], scanner, ball_diameter="8")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="ball_diameter"):
        detect(images, scanner)  # type: ignore[call-arg]


def test_a_shape_of_another_size_is_not_the_ball(run: tuple[Scanner, list[np.ndarray], np.ndarray]) -> None:
    scanner, images, _ = run
    other = scene_of(radius_px=25.0, u=120.0, v=110.0, n=N, radius=4.0 * 0.5, mu_tube=0.0)
    screw = noisy(frame(other), 100, np.random.default_rng(2), white=30000).round().astype(np.uint16)
    seen = detect([*images, screw], scanner, ball_diameter=8.0)
    assert seen.seen.tolist() == [True] * 6 + [False]
    assert "the ball in the other images" in (seen.status or ())[6]


def test_an_interrupted_run_continues_from_its_journal(
    run: tuple[Scanner, list[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    scanner, images, _ = run
    journal = tmp_path / "new" / "detect.jsonl"

    def broken() -> Iterator[np.ndarray]:
        yield from images[:3]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        detect(broken(), scanner, journal=journal, ball_diameter=8.0)
    assert len(journal.read_text().splitlines()) == 4
    with open(journal, "a") as stream:
        stream.write('{"name": "3", "key": "cut sho')
    marked = journal.read_text().replace('"flags": []', '"flags": ["few photons"]', 1)
    journal.write_text(marked)
    changed = [images[0], images[5], *images[2:]]
    seen = detect(changed, scanner, journal=journal, ball_diameter=8.0)
    assert (seen.status or ())[:2] == ("few photons", "ok")
    assert same(seen.select(range(1, 6)), detect(changed, scanner, ball_diameter=8.0).select(range(1, 6)))


def test_one_changed_row_of_an_image_is_measured_again(
    run: tuple[Scanner, list[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    """Every pixel is part of an image's key, not a sample of its rows."""
    scanner, images, _ = run
    journal = tmp_path / "detect.jsonl"
    detect(images[:2], scanner, journal=journal, ball_diameter=8.0)
    changed = images[0].copy()
    changed[81, 60:70] -= 900
    seen = detect([changed, images[1]], scanner, journal=journal, ball_diameter=8.0)
    assert same(seen, detect([changed, images[1]], scanner, ball_diameter=8.0))


def test_other_settings_begin_a_journal_anew(run: tuple[Scanner, list[np.ndarray], np.ndarray], tmp_path: Path) -> None:
    scanner, images, _ = run
    journal = tmp_path / "detect.jsonl"
    detect(images[:2], scanner, journal=journal, ball_diameter=8.0)
    journal.write_text(journal.read_text().replace('"flags": []', '"flags": ["few photons"]'))
    with pytest.warns(StartsAnewWarning, match=r"journal.*balls"):
        seen = detect(images[:2], scanner, journal=journal, ball_diameter=8.1)
    assert seen.status == ("ok", "ok")


def test_the_next_image_is_asked_for_before_the_present_one_is_measured(
    run: tuple[Scanner, list[np.ndarray], np.ndarray],
) -> None:
    scanner, images, truth = run
    events: list[tuple[str, int]] = []

    class Asked(Stack):
        def fetch(self, i: int, v0: int, v1: int) -> None:
            events.append(("fetch", i))
            at = truth[i, 1]
            assert 0 <= v0 < at - 25
            assert at + 25 < v1 <= images[i].shape[0]

        def region(self, i: int, v0: int, v1: int, u0: int, u1: int) -> np.ndarray:
            events.append(("region", i))
            return super().region(i, v0, v1, u0, u1)

    detect(Asked(images), scanner, predicted=truth, ball_diameter=8.0)
    order = [events.index(("fetch", i)) for i in range(1, 6)]
    assert order == sorted(order)
    assert all(events.index(("fetch", i)) < events.index(("region", i - 1)) for i in range(1, 6))


def test_files_that_are_asked_for_beforehand_read_the_same(
    run: tuple[Scanner, list[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    scanner, images, truth = run
    for i, image in enumerate(images):
        write_tiff(tmp_path / f"pose_{i}.tif", image)
    asked = detect(open_images(tmp_path, rows="top-first"), scanner, predicted=truth, ball_diameter=8.0)
    assert same(asked, detect(images, scanner, predicted=truth, ball_diameter=8.0))
