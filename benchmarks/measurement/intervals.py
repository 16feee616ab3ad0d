"""How often the stated 95 % interval of a length holds the truth: seeded volumes in closed form with noise.

    python benchmarks/measurement/intervals.py [--runs 600] [--correlation 0.0]

Three lengths in each volume: centre to centre of two balls (unidirectional), plane to plane of a block (bidirectional),
and the plane to plane length of one volume with voxel noise that is correlated over --correlation voxels.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "measurement"))
from blurred_shapes import as_volume, balls_volume

from tomopose.measurement.measure import measure
from tomopose.measurement.plan import plan_from
from tomopose.volume import VoxelGrid

V = 0.1


def noise_of(rng, shape, sd, correlation):
    white = rng.standard_normal(shape)
    if correlation == 0:
        return sd * white
    smooth = gaussian_filter(white, correlation, mode="wrap")
    return sd * smooth / smooth.std()


def one(rng, sd, correlation):
    """(result, truth) of both lengths in a volume with a block beside two balls, at random sub-voxel places."""
    grid = VoxelGrid(shape=(38, 38, 92), spacing=np.full(3, V))
    shift = rng.uniform(-0.05, 0.05, (3, 3))
    balls = np.array([[-2.7, 0, 0], [2.7, 0, 0]]) + shift[:2]
    values = balls_volume(grid, balls, np.full(2, 0.95), V)
    length = 1.4 + rng.uniform(-0.05, 0.05)
    z, y, x = (grid.origin[2 - a] + V * np.arange(grid.shape[a]) - shift[2, 2 - a] for a in range(3))
    edge = [ndtr((s + h) / V) - ndtr((s - h) / V) for s, h in ((z, length / 2), (y, 1.0), (x, 0.8))]
    values += edge[0][:, None, None] * edge[1][None, :, None] * edge[2][None, None, :]
    volume = as_volume(values + noise_of(rng, grid.shape, sd, correlation), grid)
    side = {"kind": "plane", "u": [0.8, 0, 0], "v": [0, 1.0, 0], "safety_mm": 0.3, "n_points": 250, "outliers": 3.0}
    plan = plan_from(
        {
            "schema": "tomopose/measurement-plan/1",
            "unit": "mm",
            "surface": {"background": 0.0, "material": 1.0},
            "features": {
                **{
                    f"ball {k}": {
                        "kind": "sphere",
                        "point": b.tolist(),
                        "radius_mm": 0.95,
                        "n_points": 600,
                        "outliers": 3.0,
                    }
                    for k, b in enumerate(balls)
                },
                "top": {**side, "point": (shift[2] + [0, 0, length / 2]).tolist(), "direction": [0, 0, 1]},
                "foot": {**side, "point": (shift[2] - [0, 0, length / 2]).tolist(), "direction": [0, 0, -1]},
            },
            "measurands": [
                {"name": "SD", "kind": "distance", "of": ["ball 0", "ball 1"]},
                {"name": "L", "kind": "distance", "of": ["top", "foot"]},
            ],
        }
    )
    found = measure(volume, plan).results
    return list(zip(found, (float(np.linalg.norm(balls[1] - balls[0])), length), strict=True))


def coverage(runs, sd, correlation, seed=0):
    """Name -> (share of intervals that hold the truth, rms error over rms u, mean error in u)."""
    table = {}
    for k in range(runs):
        for result, truth in one(np.random.default_rng(np.random.SeedSequence([seed, k])), sd, correlation):
            table.setdefault(result.name, []).append((result.value - truth, result.u, result.U))
    out = {}
    for name, rows in table.items():
        e, u, U = np.array(rows).T
        out[name] = (
            float(np.mean(np.abs(e) <= U)),
            float(np.sqrt(np.mean(e**2) / np.mean(u**2))),
            float(np.mean(e) / np.sqrt(np.mean(u**2))),
        )
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=600)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--correlation", type=float, default=0.0)
    args = parser.parse_args()
    for name, (share, ratio, bias) in coverage(args.runs, args.noise, args.correlation).items():
        print(
            f"{name}: {100 * share:.1f} % of {args.runs} intervals hold the truth; rms error / u {ratio:.3f}, "
            f"mean error {bias:+.3f} u"
        )


if __name__ == "__main__":
    main()
