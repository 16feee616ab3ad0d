"""Detection against the Cramer-Rao bound, third-party images, peers and the disk: one command, one table.

python benchmarks/detection/run.py [--crops 200] [--magnifications 2.7,5.3] [--shared ../shared] [--skip memory]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "detection"))

from ball_images import cramer_rao, frame, noise_free, noisy, standard_scene, window
from scipy.ndimage import gaussian_filter

from tomopose import Scanner
from tomopose.detection import detect, detect_image
from tomopose.errors import DetectionError
from tomopose.io.images import open_images

ROWS: list[tuple[str, str, str]] = []


def say(figure: str, measured: str, goal: str = "") -> None:
    ROWS.append((figure, measured, goal))
    print(f"{figure:58s} | {measured:44s} | {goal}", flush=True)


# Peers: the usual way with each library, on the same crops, ellipse centre corrected to the ball's centre.


def canny_ellipse(image: np.ndarray, scanner: Scanner, origin: tuple[int, int]) -> np.ndarray:
    from skimage.feature import canny
    from skimage.measure import EllipseModel, ransac

    edges = canny(image / np.percentile(image, 95), sigma=1.0, low_threshold=0.2, high_threshold=0.4)
    v, u = np.nonzero(edges)
    points = np.column_stack([u, v]).astype(float)
    near = np.hypot(*(points - np.median(points, axis=0)).T)
    points = points[near > 0.5 * np.median(near)]
    model, _ = ransac(points, EllipseModel, 8, 1.0, max_trials=60, rng=1)
    return corrected(np.asarray(model.center), min(model.axis_lengths), scanner, origin)


def opencv_ellipse(image: np.ndarray, scanner: Scanner, origin: tuple[int, int]) -> np.ndarray:
    import cv2

    eight = np.clip(image * (255.0 / np.percentile(image, 95)), 0, 255).astype(np.uint8)
    _, dark = cv2.threshold(eight, 128, 255, cv2.THRESH_BINARY_INV)
    contours, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    (xc, yc), axes, _ = cv2.fitEllipse(max(contours, key=cv2.contourArea))
    return corrected(np.array([xc, yc]), min(axes) / 2, scanner, origin)


def corrected(centre: np.ndarray, semi_minor: float, scanner: Scanner, origin: tuple[int, int]) -> np.ndarray:
    """m = c / (1 + b^2 / f^2), measured from the piercing point (field of square pixels)."""
    foot = np.array([scanner.u_0, scanner.v_0])
    f = scanner.d_SD / scanner.p_u
    return foot + (centre + origin - foot) / (1 + semi_minor**2 / f**2)


def our_centre(image: np.ndarray, scanner: Scanner, origin: tuple[int, int]) -> np.ndarray:
    return detect_image(image, scanner, origin=origin, ball_diameter=8.0).x_D


def rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def against_the_bound(crops: int, magnifications: list[float]) -> None:
    for magnification in magnifications:
        rng = np.random.default_rng(round(10 * magnification))
        scenes = [standard_scene(magnification, du=a, dv=b, blur=s) for (a, b), s in
                  zip(rng.uniform(-0.5, 0.5, (8, 2)), np.linspace(0.6, 0.8, 8), strict=True)]  # fmt: skip
        boxes = [window(s) for s in scenes]
        clean = [noise_free(s, **b) for s, b in zip(scenes, boxes, strict=True)]
        unit = [np.trace(cramer_rao(s, b, 1.0)) for s, b in zip(scenes, boxes, strict=True)]
        for snr in (25, 50, 100, 200, 400, 800):
            error, squares = [], []
            for k in range(crops):
                i = k % len(scenes)
                ball = detect_image(noisy(clean[i], snr, rng, white=30000.0), scenes[i].scanner,
                                    origin=(boxes[i]["u"], boxes[i]["v"]), ball_diameter=8.0)  # fmt: skip
                d = ball.x_D - scenes[i].x_D
                error.append(d / np.sqrt(unit[i] / snr**2))
                squares.append(d @ np.linalg.solve(ball.covariance, d) / 2)
            goal = {50: "1.25", 100: "1.25", 200: "1.25", 400: "1.6"}.get(snr, "")
            ratio, spread = rms(np.array(error)), np.sqrt(1 / (2 * crops)) / np.sqrt(2)
            name = f"error / bound, M {magnification}, SNR {snr}, {crops} crops"
            say(name, f"{ratio:.2f} +- {ratio * spread:.2f}", goal)
            chance = 1 / np.sqrt(crops)
            say("  variance of the normalised errors", f"{np.mean(squares):.2f} +- {chance:.2f}", "0.9 to 1.1")


def other_images(crops: int) -> None:
    """Noise and balls of other kinds, M 2.7, SNR 100, with eight different holders: whether sigma is honest there."""
    rng = np.random.default_rng(3)
    scenes = [replace(standard_scene(2.7, du=a, dv=b, blur=s), tube_roll=roll, tube_tilt=tilt, tube_top=top)
              for a, b, s, roll, tilt, top in zip(*rng.uniform(-0.5, 0.5, (2, 8)), np.linspace(0.6, 0.8, 8),
              rng.uniform(-0.4, 0.4, 8), rng.uniform(-0.3, 0.3, 8), rng.uniform(-2, 2, 8), strict=True)]  # fmt: skip
    boxes = [{k: n - n % 2 for k, n in window(s).items()} for s in scenes]
    clean = [noise_free(s, **b) for s, b in zip(scenes, boxes, strict=True)]
    thin = [replace(s, mu=0.5) for s in scenes]
    pale = [noise_free(s, **b) for s, b in zip(thin, boxes, strict=True)]

    def scintillator(k: int) -> np.ndarray:
        return clean[k] + gaussian_filter(noisy(clean[k], 100, rng) - clean[k], 0.6)

    def flat_fielded(k: int) -> np.ndarray:
        gain = rng.normal(1.0, 0.02, clean[k].shape)
        flat = gain * rng.normal(1.0, 1 / (100 * np.sqrt(20)), gain.shape)
        return np.asarray(gain * noisy(clean[k], 100, rng) / flat)

    def averaged(k: int) -> np.ndarray:
        return np.mean([noisy(clean[k], 50, rng, white=3000.0).round() for _ in range(4)], axis=0)

    def binned(k: int) -> np.ndarray:
        fine = noisy(clean[k], 50, rng)
        return fine.reshape(fine.shape[0] // 2, 2, fine.shape[1] // 2, 2).mean(axis=(1, 3))

    kinds: dict[str, Callable[[int], np.ndarray]] = {
        "white": lambda k: noisy(clean[k], 100, rng), "scintillator of 0.6 px": scintillator,
        "flat-fielded, 20 flats": flat_fielded, "mean of 4": averaged, "binned 2 x 2": binned,
        "a tenth of the ball out of view": lambda k: noisy(clean[k], 100, rng)[:, 42:],
        "semi-transparent ball": lambda k: noisy(pale[k], 100, rng),
    }  # fmt: skip
    for name, image in kinds.items():
        squares, error = [], []
        for n in range(crops):
            k = n % len(scenes)
            scanner, u, v, x = scenes[k].scanner, boxes[k]["u"], boxes[k]["v"], scenes[k].x_D
            if name.startswith("binned"):
                scanner, u, v, x = scanner.binned(2), u // 2, v // 2, (x - 0.5) / 2
            ball = detect_image(image(k), scanner, origin=(u + (42 if "view" in name else 0), v), ball_diameter=8.0)
            d = ball.x_D - x
            error.append(d)
            squares.append(d @ np.linalg.solve(ball.covariance, d) / 2)
        say(f"{name}, {crops} crops", f"{rms(np.array(error)):.4f} px, variance of the normalised errors "
            f"{np.mean(squares):.2f} +- {1 / np.sqrt(crops):.2f}", "0.9 to 1.1")  # fmt: skip


def blurred(crops: int) -> None:
    """Balls of 10 to 30 px behind a blur of 1.6 to 6 px, total attenuation 4, white noise, against the bound."""
    from test_detection_blur import SCANNER, blurred_ball, bound

    rng = np.random.default_rng(6)
    for snr in (50.0, 200.0):
        ratio, normalised, lost = [], [], 0
        for radius, blur in (
            (10, 1.6),
            (10, 3.0),
            (10, 6.0),
            (15, 2.4),
            (15, 6.0),
            (20, 3.0),
            (20, 6.0),
            (30, 1.6),
            (30, 6.0),
        ):
            u, v = 63.5 + rng.uniform(-4, 4, 2)
            clean, limit = blurred_ball(radius, blur, (u, v), 4.0), bound(radius, blur, (u, v), 4.0, snr)
            for _ in range(max(crops // 9, 1)):
                image = 30000 * (1.0 + clean + rng.normal(0.0, 1 / snr, clean.shape))
                try:
                    ball = detect_image(image, SCANNER, ball_diameter=0.08 * radius)
                except DetectionError:
                    lost += 1
                    continue
                d = ball.x_D - [u, v]
                ratio.append(d @ np.linalg.solve(limit, d) / 2)
                normalised.append(d @ np.linalg.solve(ball.covariance, d) / 2)
        name = f"blurred, radius 10 to 30, blur 1.6 to 6 px, SNR {snr:.0f}"
        say(name, f"{lost} of {lost + len(ratio)} lost, error / bound {np.sqrt(np.mean(ratio)):.2f}", "0 lost, 1.3")
        say(
            "  variance of the normalised errors",
            f"{np.mean(normalised):.2f} +- {1 / np.sqrt(len(ratio)):.2f}",
            "0.9 to 1.1",
        )


def third_party(shared: Path) -> None:
    folder = shared / "data" / "ball-radiographs-gvxr"
    known = json.loads((folder / "scanner.json").read_text())
    scanner = Scanner(d_SD=known["d_SD_mm"], d_SR=known["d_SR_mm"], p_u=known["p_u_mm"], p_v=known["p_v_mm"],
                      u_0=known["u_0_px"], v_0=known["v_0_px"], n_u=known["n_u_px"], n_v=known["n_v_px"])  # fmt: skip
    truth = np.array([[p["u_px"], p["v_px"]] for p in json.loads((folder / "truth.json").read_text())["poses"]])
    images = [np.ascontiguousarray(tifffile.imread(f)[::-1]) for f in sorted((folder / "radiographs").glob("*.tif"))]
    ways: dict[str, Callable[..., np.ndarray]] = {
        "tomopose": our_centre, "scikit-image Canny + EllipseModel": canny_ellipse, "OpenCV fitEllipse": opencv_ellipse,
    }  # fmt: skip
    ours = 0.0
    for name, way in ways.items():
        way(images[0], scanner, (0, 0))
        cpu = time.process_time()
        found = np.array([way(image, scanner, (0, 0)) for image in images])
        cpu = (time.process_time() - cpu) / len(images)
        error = rms(found - truth)
        ours = ours or error
        times = "" if name == "tomopose" else f", {error / ours:.0f} x ours"
        say(f"gvxr, 56 images, {name}", f"{error:.5f} px{times}, {1e3 * cpu:.1f} ms CPU",
            "0.0010 px" if name == "tomopose" else "20 x, slower than ours")  # fmt: skip


def forgotten(folder: Path) -> None:
    """Drops the folder's files from the page cache."""
    for path in folder.iterdir():
        with open(path, "rb+") as stream:
            os.fsync(stream.fileno())
            os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def seconds(work: Callable[[], object], clock: Callable[[], float], forget: Path | None = None) -> float:
    """The shortest of three runs, each without that folder's files in the page cache."""
    times = []
    for _ in range(3):
        if forget is not None:
            forgotten(forget)
        start = clock()
        work()
        times.append(clock() - start)
    return min(times)


def speed(frames: int) -> None:
    scene = standard_scene(5.3)
    clean, rng = frame(scene), np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k in range(frames):
            image = noisy(clean, 200, rng, white=30000.0).round().astype(np.uint16)
            tifffile.imwrite(folder / f"frame_{k:03d}.tif", image)
        images, cpu, clock = open_images(folder, rows="bottom-first"), time.process_time, time.perf_counter
        predicted = np.tile(scene.x_D + 2.0, (frames, 1))
        v, u, half = round(scene.x_D[1]), round(scene.x_D[0]), 183

        def tracked() -> None:
            detect(images, scene.scanner, predicted=predicted, ball_diameter=8.0)

        def regions() -> None:
            for i in range(frames):
                images.region(i, v - half, v + half, u - half, u + half)

        detect(images, scene.scanner, ball_diameter=8.0)
        tracked()
        read = seconds(lambda: [images[i] for i in range(frames)], cpu) / frames
        full = seconds(lambda: detect(images, scene.scanner, ball_diameter=8.0), cpu) / frames
        region, track = seconds(regions, cpu) / frames, seconds(tracked, cpu) / frames
        cold = seconds(regions, clock, folder) / frames
        cold_track = seconds(tracked, clock, folder) / frames
        with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
            detect(
                images, scene.scanner, executor=pool, ball_diameter=8.0
            )  # starts the processes and loads their kernels
            wall = seconds(lambda: detect(images, scene.scanner, executor=pool, ball_diameter=8.0), clock) / frames
    say("2048 x 2048 TIFF: read alone", f"{1e3 * read:.1f} ms CPU a frame")
    say("2048 x 2048 TIFF: read + find + fit", f"{1e3 * full:.1f} ms CPU = {full / read:.1f} x reading; "
        f"2 cores: {2 / full:.0f} a second by CPU time, {1 / wall:.0f} by the clock",
        "100 frames a second or 2.5 x reading")  # fmt: skip
    say("  tracked", f"{1e3 * track:.1f} ms CPU; the region read alone {1e3 * region:.1f}", "1.3 x the region read")
    say("  tracked, from the disk", f"{1e3 * cold_track:.1f} ms by the clock = {cold_track / cold:.1f} x the region "
        f"read alone ({1e3 * cold:.1f})", "1.3 x the region read")  # fmt: skip


def memory(frames_in_all: int) -> None:
    """Resident memory of a process that detects in frames of 4096 x 4096, made one at a time."""
    if "--memory-child" not in sys.argv:
        child = [sys.executable, __file__, "--memory-child", "--memory-frames", str(frames_in_all)]
        out = subprocess.run(child, capture_output=True, text=True, check=True)
        say(f"memory, {frames_in_all} frames of 4096 x 4096, peak of the process", out.stdout.strip(), "below 1 GiB")
        return
    scanner = Scanner(d_SD=1500.0, d_SR=300.0, p_u=0.1, p_v=0.1, u_0=2047.5, v_0=2047.5, n_u=4096, n_v=4096)
    rng, u = np.random.default_rng(1), np.arange(4096.0)
    image = np.empty((4096, 4096), np.uint16)
    for v in range(4096):
        level = np.where(np.hypot(u - 2000.4, v - 1900.7) < 200, 300, 30000)
        image[v] = level + rng.integers(0, 200, 4096)
    after_setup = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10

    def frames() -> Iterator[np.ndarray]:
        for _ in range(frames_in_all):
            yield image.copy()

    seen = detect(frames(), scanner, workers=1, ball_diameter=8.0).seen.sum()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(f"{peak:.0f} MiB ({after_setup:.0f} before the first frame), {seen} seen")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--crops", type=int, default=200, help="simulated crops for each magnification and SNR")
    parser.add_argument("--magnifications", default="2.7,5.3", help="of the simulated crops")
    parser.add_argument("--frames", type=int, default=24, help="frames of the speed figure")
    default = os.environ.get("TOMOPOSE_SHARED", Path(__file__).resolve().parents[3] / "shared")
    parser.add_argument("--shared", type=Path, default=Path(default), help="folder that holds data/")
    parser.add_argument("--skip", default="", help="bound,kinds,blurred,gvxr,speed,memory: those to leave out")
    parser.add_argument("--memory-frames", type=int, default=2000, help="frames of the memory figure")
    parser.add_argument("--memory-child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory_child:
        memory(options.memory_frames)
        return
    print(f"{'figure':58s} | {'measured':44s} | goal")
    skip = options.skip.split(",")
    if "gvxr" not in skip:
        third_party(options.shared)
    if "speed" not in skip:
        speed(options.frames)
    if "bound" not in skip:
        against_the_bound(options.crops, [float(m) for m in options.magnifications.split(",")])
    if "kinds" not in skip:
        other_images(max(options.crops // 8, 40))
    if "blurred" not in skip:
        blurred(options.crops)
    if "memory" not in skip:
        memory(options.memory_frames)


if __name__ == "__main__":
    main()
