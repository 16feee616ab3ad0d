"""How often stated 95 % intervals of lengths hold the truth over virtual scans: simulated, reconstructed, measured.

    NUMBA_NUM_THREADS=1 nice -n 10 python benchmarks/measurement/virtual_scans.py [--objects 8] [--runs 30] [--draws 20]

Two balls and a block of aluminium, 96^3 voxels of 0.1 mm, 120 views of the tilted scan of eq. (11), CNR about 15 in
the volume.  Each object lies elsewhere by a part of a voxel and has sizes of its own; its scans differ by noise alone.
The virtual CT's own draws are of the nominal object, each placed elsewhere, with noise.  Intervals:

    fit         of the single scan, from the scatter of its points
    simulation  mean error of the draws taken off, u of the draws (JCGM 101), as for one more draw
    combined    the same with the larger of both u
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.stats import t as student

import tomopose as tp
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.measurement.measure import measure
from tomopose.measurement.plan import plan_from
from tomopose.simulation.detector import expose
from tomopose.simulation.run import signal
from tomopose.simulation.scene import scene_from

VOXEL, SIZE, VIEWS = 0.1, 96, 120
BALLS, RADIUS = np.array([[-2.13, 0.21, 1.55], [2.07, -0.34, 1.72]]), 1.2
BLOCK, SIDES = np.array([0.17, -0.12, -1.63]), np.array([4.43, 3.57, 2.71])
SCANNER = {"d_SD_mm": 1000.0, "d_SR_mm": 200.0, "p_u_mm": 0.5, "p_v_mm": 0.52, "u_0_px": 62.7, "v_0_px": 64.2,
           "n_u_px": 128, "n_v_px": 126}


def random_object(rng):
    """Places and sizes near the nominal ones: balls, block, sides."""
    return (BALLS + rng.uniform(-0.05, 0.05, 3) + rng.uniform(-0.02, 0.02, (2, 3)),
            BLOCK + rng.uniform(-0.05, 0.05, 3), SIDES + rng.uniform(-0.04, 0.04, 3))


class VirtualPart:
    """A part on the virtual scanner: noiseless images once, volumes with any noise."""

    def __init__(self, balls, block, sides, snr):
        shapes = [{"kind": "sphere", "radius_mm": RADIUS, "t_mm": b.tolist()} for b in balls]
        shapes.append({"kind": "box", "size_mm": sides.tolist(), "t_mm": block.tolist()})
        self.run = tp.simulate(scene_from({
            "schema": "tomopose/scene/1", "seed": 1, "scanner": SCANNER,
            "source": {"voltage_kV": 120.0, "filters": [{"material": "Cu", "thickness_mm": 2.0}]},
            "detector": {"snr": snr, "blur_sigma_px": 0.6},
            "objects": [{"kind": "solid", "material": "Al", "shapes": shapes}],
            "mount": {"angles_deg": [0, 0, 0]}, "poses": {"scan": {"n": VIEWS, "tilt": "triangle"}},
        }))
        r, s = self.run, self.run.scanner
        self.clean = [signal(r, k) for k in range(len(r))]
        P = eq5_matrices(s, T_HT=r.T_HT, T_MH=r.T_MH, alpha=r.poses.alpha)
        self.matrices = ProjectionMatrices(P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=r.poses.pose_id,
                                           scanner=s)
        self.truth = {"SD": float(np.linalg.norm(balls[1] - balls[0])),
                      **{f"L{a}": float(side) for a, side in zip("xyz", sides, strict=True)}}
        self.plan = plan_of(balls, block, sides)

    def errors(self, seed):
        """Name -> (error, U, u), mm, of one scan."""
        det = self.run.detector
        images = [expose(c, det, self.run.scanner, seed=seed, frame=k) / np.float32(det.white)
                  for k, c in enumerate(self.clean)]
        volume = tp.reconstruct(images, self.matrices, tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL),
                                images_are="transmission", consistency="off")
        found = measure(volume, self.plan).results
        return {r.name: (r.value - self.truth[r.name], r.U, r.u) for r in found}


def plan_of(balls, block, sides):
    features = {f"ball {k}": {"kind": "sphere", "point": b.tolist(), "radius_mm": RADIUS, "n_points": 800}
                for k, b in enumerate(balls)}
    measurands = [{"name": "SD", "kind": "distance", "of": ["ball 0", "ball 1"]}]
    for a, name in enumerate("xyz"):
        u, v = (np.eye(3)[k] * sides[k] / 2 for k in ((a + 1) % 3, (a + 2) % 3))
        for sign, word in ((1, "+"), (-1, "-")):
            n = sign * np.eye(3)[a]
            features[word + name] = {
                "kind": "plane", "point": (block + n * sides / 2).tolist(), "direction": n.tolist(), "u": u.tolist(),
                "v": v.tolist(), "safety_mm": 0.45, "n_points": 500,
            }
        measurands.append({"name": f"L{name}", "kind": "distance", "of": ["+" + name, "-" + name]})
    return plan_from({"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": features,
                      "measurands": measurands})


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=8)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--snr", type=float, default=150.0)
    args = parser.parse_args()
    rows = {}
    draws = {}
    for k in range(args.draws):
        rng = np.random.default_rng(np.random.SeedSequence([1, k]))
        place = rng.uniform(-0.05, 0.05, 3)
        part = VirtualPart(BALLS + place, BLOCK + place, SIDES, args.snr)
        for name, (e, _, _) in part.errors(10_000 + k).items():
            draws.setdefault(name, []).append(e)
    for k in range(args.objects):
        rng = np.random.default_rng(np.random.SeedSequence([2, k]))
        part = VirtualPart(*random_object(rng), args.snr)
        for run in range(args.runs):
            for name, row in part.errors(1000 * k + run).items():
                rows.setdefault(name, []).append((k, *row))
        if len(rows["SD"]) > 1:
            report(rows, draws)


def report(rows, draws):
    print(f"{len(rows['SD'])} scans; lengths in micrometres", flush=True)
    for name, found in rows.items():
        _, e, U, u = np.array(found).T
        sim = np.array(draws[name])
        n = len(sim)
        u_sim = sim.std(ddof=1) * np.sqrt(1 + 1 / n)
        reach = student.ppf(0.975, n - 1)
        held = {"fit": np.abs(e) <= U, "simulation": np.abs(e - sim.mean()) <= reach * u_sim,
                "combined": np.abs(e - sim.mean()) <= np.maximum(U, reach * u_sim)}
        objects = [e[np.array(found)[:, 0] == k].mean() for k in np.unique(np.array(found)[:, 0])]
        print(f"  {name:3s} mean error {1000 * e.mean():+.2f}, scatter {1000 * e.std():.2f}, of objects' means "
              f"{1000 * np.std(objects):.2f}, u of fit {1000 * np.sqrt(np.mean(u**2)):.2f}, simulated "
              f"{1000 * sim.mean():+.2f} +- {1000 * u_sim:.2f}; held: "
              + ", ".join(f"{k} {100 * h.mean():.1f} %" for k, h in held.items()), flush=True)


if __name__ == "__main__":
    main()
