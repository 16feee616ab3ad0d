"""What the reconstruction alone leaves on the standard's 27 balls: true matrices, circular and 3D scan, SART and FDK.

    python benchmarks/section6/balls.py

Prints errors of distances, scatter of diameters, mean sphericity, and the part of the balls' mean deviation that has
the tilt's seven periods, by latitude.
"""

from __future__ import annotations

import time

import numpy as np

from tomopose.measurement.measure import measure
from tomopose.measurement.probing import sphere_pattern
from tomopose.reconstruction import FDK, PAPER, SART, Correction, reconstruct
from tomopose.simulation.objects.sphere_standard import sphere_centres, sphere_diameters
from tomopose.studies.parts.result import DEFAULT_SEED
from tomopose.studies.section6.blur import blur_of
from tomopose.studies.section6.scan import WHITE, Numbers, Path, Radiographs, grid_of, scan_with
from tomopose.studies.section6.standard import CAP_DEG, POINTS, SEARCH_VOXELS, measure_standard, plan_for
from tomopose.studies.section6.tables import PERIODS, rms, waves
from tomopose.volume import Volume

NUMBERS = Numbers(
    binning={"specimen": 5, "standard": 4},
    views={"specimen": 360, "standard": 500},
    runs={"specimen": (1,), "standard": (1,)},
    edge=0.35,
    samples=2,
    radiographs=False,
)
LATITUDES = ((50, 70), (70, 90), (90, 110), (110, 130))
"""Degrees from the top."""
PATHS: tuple[Path, ...] = ("circular", "3D")
METHODS: dict[str, FDK | SART] = {
    "one sweep of SART": PAPER,
    "FDK, then SART": SART(start=FDK()),
    "FDK along the path": FDK(),
}


def seven_waves(volume: Volume) -> list[float]:
    """Amplitude, um, of the part with seven periods of the mean deviation of all balls, for each of LATITUDES."""
    search = SEARCH_VOXELS * float(volume.grid.spacing[0])
    patterns = [
        sphere_pattern(c, float(d) / 2, POINTS, cap=float(np.radians(CAP_DEG)))
        for c, d in zip(sphere_centres(), sphere_diameters(), strict=True)
    ]
    points, normals = (np.concatenate(x) for x in zip(*patterns, strict=True))
    found = measure(volume, plan_for(search, blur_of(volume, points, normals, search))).features["volume"]
    theta, phi, deviation = [], [], []
    for k in range(len(sphere_centres())):
        ball = found[f"sphere {k + 1:02d}"]
        x = ball.points - ball.point
        r = np.linalg.norm(x, axis=1)
        theta.append(np.degrees(np.arccos(x[:, 2] / r)))
        phi.append(np.arctan2(x[:, 1], x[:, 0]))
        deviation.append(1e3 * (r - r.mean()))
    t, p, d = (np.concatenate(values) for values in (theta, phi, deviation))
    return [float(waves(d[here], p[here])[PERIODS]) for here in ((t >= a) & (t < b) for a, b in LATITUDES)]


def main() -> None:
    for path in PATHS:
        scan = scan_with("standard", path, NUMBERS, DEFAULT_SEED)
        images = Radiographs(scan)
        for name, algorithm in METHODS.items():
            begin = time.process_time()
            volume = reconstruct(
                images,
                scan.truth,
                grid_of("standard", NUMBERS),
                correction=Correction(images_are="counts", white=WHITE),
                algorithm=algorithm,
                engine="cpu",
                consistency="off",
            )
            seconds = time.process_time() - begin
            m = measure_standard(volume)
            print(
                f"{path:8s} {name:18s} distances {rms(m['distance_um']):.2f} um, diameters "
                f"{np.std(m['diameter_um']):.2f} um, sphericity {np.mean(m['form_um']):.1f} um, seven waves "
                f"{', '.join(f'{a:.1f}' for a in seven_waves(volume))} um, {seconds:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
