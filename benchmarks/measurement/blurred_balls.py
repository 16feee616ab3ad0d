"""27 blurred balls in closed form: errors of centres and radii by surface method, beside the fixed-level meshes of
scikit-image and VTK in the same run, and the time for a large volume.

    python benchmarks/measurement/blurred_balls.py [--size 256] [--seeds 1]    errors, in voxels, over seeds 1, 2, ...
    python benchmarks/measurement/blurred_balls.py --time 512                  seconds and peak memory
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "measurement"))
from blurred_shapes import as_volume, balls_on_a_lattice, balls_volume

from tomopose.measurement.features.fits import fit_sphere
from tomopose.measurement.surface.edges import EdgeSettings
from tomopose.measurement.surface.grey_levels import grey_levels
from tomopose.measurement.surface.surface import surface
from tomopose.volume import VoxelGrid

VOXEL, SIGMA, NOISE = 0.1482, 1.0, 0.05


def scene(size, seed, radius, noisy=True):
    """Centres, and the three volumes: clean, CNR 20, the same with 13 % grey drift and a ramp."""
    rng = np.random.default_rng(seed)
    grid = VoxelGrid.cube(n=size, spacing=VOXEL)
    centres = balls_on_a_lattice(rng, grid, 3, radius)
    radii = np.full(27, radius * VOXEL)
    clean = balls_volume(grid, centres, radii, SIGMA * VOXEL)
    if not noisy:
        return grid, centres, {"clean": clean}
    noise = NOISE * rng.standard_normal(grid.shape)
    drift = balls_volume(grid, centres, radii, SIGMA * VOXEL, 1 + 0.13 * rng.uniform(-1, 1, 27))
    drift += np.linspace(-0.1, 0.1, size)
    return grid, centres, {"clean": clean, "CNR 20": clean + noise, "drift": drift + noise}


def vertex_areas(points, faces):
    """A third of the triangles about each vertex: weights of a fit."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.bincount(faces.ravel(), np.repeat(third, 3), minlength=len(points))
    return np.maximum(area, 1e-3 * area.mean())


def rows(volume, centres, radius, window):
    from scipy.spatial import cKDTree

    def fitted(points, area):
        near = cKDTree(centres).query(points)[1]
        # A noise particle of a raw mesh is kept out by distance, for all methods alike.
        fits = []
        for k in range(len(centres)):
            mine = near == k
            mine[mine] = np.abs(np.linalg.norm(points[mine] - centres[k], axis=1) / VOXEL - radius) < 4
            fits.append(fit_sphere(points[mine], area=area[mine]))
        c = (np.array([f.point for f in fits]) - centres) / VOXEL
        r = np.array([f.radius for f in fits]) / VOXEL - radius
        rms, form, d95, f25 = (
            np.mean([getattr(f, a) for f in fits]) / VOXEL for a in ("rms", "form", "form_95", "form_25")
        )
        return np.sqrt(np.mean(np.sum(c**2, axis=1))), r.mean(), r.std(), rms, form, d95, f25

    from skimage.measure import marching_cubes

    level = grey_levels(volume)[-1].threshold
    vertices, faces, *_ = marching_cubes(volume.values, level)
    points = volume.grid.points(vertices.astype(np.float64))
    yield "scikit-image ISO-50", fitted(points, vertex_areas(points, faces))
    vtk = surface(volume, method="iso-50")
    yield "VTK ISO-50", fitted(vtk.points, vtk.areas)
    for method, correct in (("local-50", False), ("esf", False), ("esf", True)):
        found = surface(volume, method=method, edges=EdgeSettings(window=window), curvature_correction=correct)
        yield f"{method}{' corrected' if correct else ''}", fitted(found.points[found.good], found.areas[found.good])


def bound(radius, window=np.inf):
    """Cramer-Rao bound of a centre, rms in 3-D, voxels: white noise in all voxels within `window` of the rim.

    The grey of a blurred ball of contrast 1 falls as a Gaussian of SIGMA along the radius, so that each coordinate's
    information is 4 pi R^2 / 3 times the integral of that squared, over the noise squared.  Where the levels on both
    sides are known from voxels within the window alone, and as the place vary about the ball, the level midway takes
    (integral of the Gaussian)^2 / (2 window) of it.
    """
    information = 4 * np.pi * radius**2 / 3 * (1 / (2 * np.sqrt(np.pi) * SIGMA) - 1 / (2 * window)) / NOISE**2
    return np.sqrt(3 / information)


def time_large(size, seed):
    """Balls of a radius that gives about one million vertices at 512."""
    grid, _, volumes = scene(size, seed, 0.085 * size, noisy=False)
    rng = np.random.default_rng(seed)
    values = volumes["clean"].astype(np.float32)
    del volumes
    for z in values:
        z += NOISE * rng.standard_normal(z.shape, dtype=np.float32)
    volume = as_volume(values, grid)
    small = as_volume(values[:64, :200, :200].copy(), VoxelGrid(shape=(64, 200, 200), spacing=grid.spacing))
    surface(small)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = time.perf_counter(), time.process_time()
    found = surface(volume)
    print(
        f"{size}^3, {len(found)} vertices: {time.perf_counter() - wall:.1f} s wall, "
        f"{time.process_time() - cpu:.1f} s CPU; peak memory {before / 2**20:.2f} GB before, "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GB after"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--radius", type=float, default=16.9)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--window", type=float)
    parser.add_argument("--time", type=int)
    args = parser.parse_args()
    if args.time:
        time_large(args.time, 1)
        return
    print(
        f"bound of a centre, CNR 20: {bound(args.radius):.5f} with known levels, with levels from the 8 or 4 voxels "
        f"on both sides {bound(args.radius, 8.0):.5f}, {bound(args.radius, 4.0):.5f}"
    )
    print("voxels: centre rms (3-D), radius bias, radius sd, residual rms, full range, D95, 25 patches")
    table = {}
    for seed in range(1, args.seeds + 1):
        grid, centres, volumes = scene(args.size, seed, args.radius)
        for case, values in volumes.items():
            for name, numbers in rows(as_volume(values, grid), centres, args.radius, args.window):
                table.setdefault((case, name), []).append(numbers)
                print(f"{case:8s} {name:22s}" + "".join(f"{x:10.5f}" for x in numbers), flush=True)
    if args.seeds > 1:
        print(f"over {args.seeds} seeds: rms of centre rms and of radius sd, means of the rest")
        for (case, name), numbers in table.items():
            x = np.array(numbers)
            mean = np.mean(x, axis=0)
            mean[[0, 2]] = np.sqrt(np.mean(x[:, [0, 2]] ** 2, axis=0))
            print(f"{case:8s} {name:22s}" + "".join(f"{v:10.5f}" for v in mean))


if __name__ == "__main__":
    main()
