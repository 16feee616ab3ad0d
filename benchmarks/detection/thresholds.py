"""Scans of the tuned thresholds: error / bound and the variance of normalised errors for several values of each.

python benchmarks/detection/thresholds.py [--crops 40] [--only fit.steepest,ring.share]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "detection"))

from ball_images import Scene, cramer_rao, noise_free, noisy, standard_scene, window

from tomopose.detection import DetectionSettings, detect_image

SCANS: dict[str, tuple[object, ...]] = {
    "ring.share": (0.25, 0.35, 0.5),
    "ring.shells": ((5.0, 8.0, 12.0), (7.0, 10.0, 14.0), (9.0, 12.0, 17.0)),
    "ring.widths": (8.0, 10.0, 12.0),
    "fit.steepest": (3.0, 6.0, 12.0),
    "fit.few_bent": (0.03, 0.1, 0.2),
    "fit.bent": (4.0, 10.0, 25.0),
    "noise.smallest": (0.04, 0.06, 0.09),
    "noise.rare": (0.03, 0.1, 0.3),
    "ring_test.remaining": (0.25, 0.5, 1.0),
    "sector_test.trusted": (0.4, 0.6, 0.8),
}


def with_value(name: str, value: object) -> DetectionSettings:
    """The defaults with one threshold changed."""
    group, _, threshold = name.partition(".")
    settings = DetectionSettings()
    return replace(settings, **{group: getattr(settings, group)._replace(**{threshold: value})})


@cache
def scenes_at_hand() -> tuple[list[Scene], list[dict[str, int]], list[np.ndarray], list[np.ndarray]]:
    """Four scenes with the ball at random places within a pixel: their windows, images without noise, and bounds at a
    signal-to-noise ratio of 1; those at others are smaller by its square."""
    rng = np.random.default_rng(27)
    scenes = [standard_scene(2.7, du=a, dv=b) for a, b in rng.uniform(-0.5, 0.5, (4, 2))]
    boxes = [window(s) for s in scenes]
    clean = [noise_free(s, **b) for s, b in zip(scenes, boxes, strict=True)]
    return scenes, boxes, clean, [cramer_rao(s, b, 1.0) for s, b in zip(scenes, boxes, strict=True)]


def figures(settings: DetectionSettings, snr: float, crops: int) -> tuple[float, float]:
    """Error / bound and the variance of normalised errors at magnification 2.7, on the same images for all settings."""
    scenes, boxes, clean, unit_bounds = scenes_at_hand()
    rng = np.random.default_rng(28)
    bounds = [bound / snr**2 for bound in unit_bounds]
    ratio, normalised = [], []
    for k in range(crops):
        i = k % len(scenes)
        ball = detect_image(noisy(clean[i], snr, rng, white=30000.0), scenes[i].scanner, ball_diameter=8.0,
                            origin=(boxes[i]["u"], boxes[i]["v"]), settings=settings)  # fmt: skip
        d = ball.x_D - scenes[i].x_D
        ratio.append(d @ np.linalg.solve(bounds[i], d) / 2)
        normalised.append(d @ np.linalg.solve(ball.covariance, d) / 2)
    return float(np.sqrt(np.mean(ratio))), float(np.mean(normalised))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--crops", type=int, default=40, help="images for each value and SNR")
    parser.add_argument("--only", default="", help="thresholds to scan, of all")
    options = parser.parse_args()
    for name in options.only.split(",") if options.only else SCANS:
        for value in SCANS[name]:
            for snr in (50.0, 800.0):
                ratio, variance = figures(with_value(name, value), snr, options.crops)
                print(f"{name:22s} {value!s:18s} SNR {snr:3.0f} | error / bound {ratio:.2f} | variance {variance:.2f}",
                      flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
