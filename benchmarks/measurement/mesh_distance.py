"""Half a million points with known distances against a mesh of about 137,000 triangles.

python benchmarks/measurement/mesh/distance.py [--points 500000]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "measurement"))
from test_measurement_comparison import box

from tomopose.geometry.rotations import exp_rotation
from tomopose.measurement.mesh.mesh import Mesh, signed_distances


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=500_000)
    args = parser.parse_args()
    half = np.array([10.0, 8.0, 12.0])
    mesh = box(half, 107)
    rng = np.random.default_rng(1)
    chosen = rng.integers(0, len(mesh.faces), args.points)
    weights = rng.dirichlet([1, 1, 1], args.points)
    normal = mesh.face_normals / np.linalg.norm(mesh.face_normals, axis=1)[:, None]
    x = np.einsum("nk,nkj->nj", weights, mesh.points[mesh.faces[chosen]])
    x += rng.normal(0, 0.02, args.points)[:, None] * normal[chosen]
    q = np.abs(x) - half
    truth = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    # Turned, so that no triangle lies along an axis.
    turn = exp_rotation(np.array([0.3, -0.5, 0.7]))
    turned = Mesh(points=mesh.points @ turn.T, faces=mesh.faces)
    wall, cpu = time.perf_counter(), time.process_time()
    found = signed_distances(x @ turn.T, turned)
    print(
        f"{args.points} points, {len(mesh.faces)} triangles: {time.perf_counter() - wall:.1f} s wall, "
        f"{time.process_time() - cpu:.1f} s CPU, largest error {np.abs(found - truth).max():.1e} mm"
    )


if __name__ == "__main__":
    main()
