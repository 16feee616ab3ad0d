"""Reference features other than least squares: largest error against known solutions, and time for a large cloud.

python benchmarks/measurement/zones.py [--sets 60] [--points 500000]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "measurement"))
from known_zones import known_set
from test_measurement_zones import CASES, errors, least_squares

from tomopose.measurement.features.fits import fit_cone, fit_cylinder, fit_plane, fit_sphere
from tomopose.measurement.probing import cylinder_pattern, plane_pattern, sphere_pattern
from tomopose.measurement.zones.reference_features import associated


def accuracy(sets):
    for kind, criterion in CASES:
        worst = 0.0
        for seed in range(sets):
            known = known_set(kind, criterion, seed)
            found = associated(least_squares(kind, known), criterion)
            worst = max(worst, *(abs(e) for e in errors(kind, found, known).values()))
        print(f"{kind:9s} {criterion:22s} largest error of {sets} sets {worst:.1e} mm or rad")


def times(n):
    axis = [0.2, -0.3, 1.0]
    clouds = {
        "plane": (plane_pattern([1, 2, 3], axis, [2, 0, -0.4], [0, 1, 0.3], n), fit_plane),
        "sphere": (sphere_pattern([1, 2, 3], 2.5, n), fit_sphere),
        "cylinder": (cylinder_pattern([1, 2, 3], axis, 1.5, 4, n), lambda x: fit_cylinder(x, direction=axis)),
        "cone": (cylinder_pattern([1, 2, 3], axis, 2.5, 4, n, half_angle=0.4), lambda x: fit_cone(x, direction=axis)),
    }
    rng = np.random.default_rng(0)
    for kind, ((x, normals), fit) in clouds.items():
        points = x + 0.01 * rng.standard_normal((len(x), 1)) * normals
        begun = time.process_time()
        feature = fit(points)
        fitted = time.process_time() - begun
        for criterion in [c for k, c in CASES if k == kind]:
            begun = time.process_time()
            found = associated(feature, criterion)
            print(
                f"{kind:9s} {criterion:22s} {len(x)} points: {time.process_time() - begun:.1f} s of processor time "
                f"(least squares {fitted:.1f} s), {len(found.contacts)} contacts"
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=60)
    parser.add_argument("--points", type=int, default=500_000)
    args = parser.parse_args()
    accuracy(args.sets)
    times(args.points)


if __name__ == "__main__":
    main()
