"""How often stated 95 % intervals of lengths hold the truth over virtual scans: simulated, reconstructed, measured.

    NUMBA_NUM_THREADS=1 nice -n 10 python benchmarks/measurement/virtual_scans.py [--objects 40] [--runs 6]
                                                                                  [--sets 12] [--draws 20] [--seed 0]

Two balls and a block of aluminium, 96^3 voxels of 0.1 mm, 120 views of the tilted scan of eq. (11), CNR about 15 in
the volume.  Each object lies elsewhere by a part of a voxel and has sizes of its own; its scans differ by noise alone.
The uncertainty is that of `simulated_errors` for the nominal object and of `budget`, as `tomopose measure --simulate`
states it; several sets of draws, so that the luck of one does not count.  Intervals:

    fit         of the single scan, from the scatter of its points
    simulation  corrected by the draws of one set: mean over the sets, lowest and highest
    all draws   corrected by the draws of all sets together
    one another corrected by 5, 10, 20 and 39 scans of other objects in place of draws: the rule alone, for any number
"""

from __future__ import annotations

import argparse

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.measurement.budget import budget
from tomopose.measurement.measure import measure
from tomopose.measurement.plan import plan_from
from tomopose.measurement.uncertainty import Simulated
from tomopose.simulation.detector.detector import expose
from tomopose.simulation.run import signal
from tomopose.simulation.scene.scene import scene_from
from tomopose.uncertainty.virtual_scans import simulated_errors

VOXEL, SIZE, VIEWS = 0.1, 96, 120
BALLS, RADIUS = np.array([[-2.13, 0.21, 1.55], [2.07, -0.34, 1.72]]), 1.2
BLOCK, SIDES = np.array([0.17, -0.12, -1.63]), np.array([4.43, 3.57, 2.71])
GRID = tp.VoxelGrid.cube(n=SIZE, spacing=VOXEL)
SCANNER = {
    "d_SD_mm": 1000.0,
    "d_SR_mm": 200.0,
    "p_u_mm": 0.5,
    "p_v_mm": 0.52,
    "u_0_px": 62.7,
    "v_0_px": 64.2,
    "n_u_px": 128,
    "n_v_px": 126,
}


def random_object(rng):
    """Places and sizes near the nominal ones: balls, block, sides."""
    return (
        BALLS + rng.uniform(-0.05, 0.05, 3) + rng.uniform(-0.02, 0.02, (2, 3)),
        BLOCK + rng.uniform(-0.05, 0.05, 3),
        SIDES + rng.uniform(-0.04, 0.04, 3),
    )


class VirtualPart:
    """A part on the virtual scanner: noiseless images once, volumes with any noise."""

    def __init__(self, balls, block, sides, snr):
        shapes = [{"kind": "sphere", "radius_mm": RADIUS, "t_mm": b.tolist()} for b in balls]
        shapes.append({"kind": "box", "size_mm": sides.tolist(), "t_mm": block.tolist()})
        self.run = tp.simulate(
            scene_from(
                {
                    "schema": "tomopose/scene/1",
                    "seed": 1,
                    "scanner": SCANNER,
                    "source": {"voltage_kV": 120.0, "filters": [{"material": "Cu", "thickness_mm": 2.0}]},
                    "detector": {"snr": snr, "blur_sigma_px": 0.6},
                    "objects": [{"kind": "solid", "material": "Al", "shapes": shapes}],
                    "mount": {"angles_deg": [0, 0, 0]},
                    "poses": {"scan": {"n": VIEWS, "tilt": "triangle"}},
                }
            )
        )
        r, s = self.run, self.run.scanner
        self.clean = [signal(r, k) for k in range(len(r))]
        P = eq5_matrices(s, T_HT=r.T_HT, T_MH=r.T_MH, alpha=r.poses.alpha)
        self.matrices = ProjectionMatrices(
            P=P, n_u=s.n_u, n_v=s.n_v, p_u=s.p_u, p_v=s.p_v, pose_id=r.poses.pose_id, scanner=s
        )
        self.truth = {
            "SD": float(np.linalg.norm(balls[1] - balls[0])),
            **{f"L{a}": float(side) for a, side in zip("xyz", sides, strict=True)},
        }
        self.plan = plan_of(balls, block, sides)

    def results(self, seed):
        """Name -> result of one scan."""
        det = self.run.detector
        images = [
            expose(c, det, self.run.scanner, seed=seed, frame=k) / np.float32(det.white)
            for k, c in enumerate(self.clean)
        ]
        volume = tp.reconstruct(images, self.matrices, GRID, images_are="transmission", consistency="off")
        return {r.name: r for r in measure(volume, self.plan).results}


def plan_of(balls, block, sides):
    features = {
        f"ball {k}": {
            "kind": "sphere",
            "point": b.tolist(),
            "radius_mm": RADIUS,
            "n_points": 800,
            "outliers": 3.0,
        }
        for k, b in enumerate(balls)
    }
    measurands = [
        {
            "name": "SD",
            "kind": "distance",
            "of": ["ball 0", "ball 1"],
            "nominal_mm": float(np.linalg.norm(balls[1] - balls[0])),
        }
    ]
    for a, name in enumerate("xyz"):
        u, v = (np.eye(3)[k] * sides[k] / 2 for k in ((a + 1) % 3, (a + 2) % 3))
        for sign, word in ((1, "+"), (-1, "-")):
            n = sign * np.eye(3)[a]
            features[word + name] = {
                "kind": "plane",
                "point": (block + n * sides / 2).tolist(),
                "direction": n.tolist(),
                "u": u.tolist(),
                "v": v.tolist(),
                "safety_mm": 0.45,
                "n_points": 500,
                "outliers": 3.0,
            }
        measurands.append(
            {"name": f"L{name}", "kind": "distance", "of": ["+" + name, "-" + name], "nominal_mm": float(sides[a])}
        )
    return plan_from(
        {"schema": "tomopose/measurement-plan/1", "unit": "mm", "features": features, "measurands": measurands}
    )


def pooled(sets):
    """All draws of several equally large sets as one simulation."""
    n = sum(s.runs for s in sets)
    means, u = np.array([s.mean for s in sets]), np.array([s.u for s in sets])
    square = sum((s.runs - 1) * s.u**2 + s.runs * (s.mean - means.mean()) ** 2 for s in sets)
    return (
        Simulated(
            mean=float(means.mean()),
            u=float(np.sqrt(square / (n - 1))),
            low=np.nan,
            high=np.nan,
            runs=n,
            stable=False,
            seed=0,
            u_fit=float(np.sqrt(np.mean([s.u_fit**2 for s in sets]))),
            dof_fit=sum(s.dof_fit for s in sets),
        )
        if len(u) > 1
        else sets[0]
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--runs", type=int, default=6)
    parser.add_argument("--sets", type=int, default=12)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="of the first set of draws")
    parser.add_argument("--snr", type=float, default=150.0)
    args = parser.parse_args()
    nominal = VirtualPart(BALLS, BLOCK, SIDES, args.snr)
    sets = [
        simulated_errors(nominal.run, nominal.plan, GRID, draws=args.draws, seed=args.seed + k)
        for k in range(args.sets)
    ]
    rows = {}
    for k in range(args.objects):
        part = VirtualPart(*random_object(np.random.default_rng(np.random.SeedSequence([2, k]))), args.snr)
        for run in range(args.runs):
            for name, found in part.results(1000 * k + run).items():
                rows.setdefault(name, []).append((found, part.truth[name]))
    report(rows, sets)
    one_another(rows, args.objects)


def held(result, truth, simulated=None):
    """Whether the interval of a result, by the fit or by a simulation, holds the truth; and its half width."""
    found = budget(result, simulated=simulated)
    return abs(found.corrected - truth) <= found.U, found.U


def report(rows, sets):
    print(f"{len(rows['SD'])} scans, {len(sets)} sets of {sets[0]['SD'].runs} draws; lengths in micrometres")
    for name, found in rows.items():
        e = np.array([r.value - truth for r, truth in found])
        u = np.sqrt(np.mean([r.u**2 for r, _ in found]))
        each = [np.mean([held(r, truth, s[name])[0] for r, truth in found]) for s in sets]
        whole = pooled([s[name] for s in sets])
        fit, all_draws = (np.array([held(r, truth, s) for r, truth in found]) for s in (None, whole))
        print(
            f"  {name:3s} mean error {1000 * e.mean():+.2f}, scatter {1000 * e.std(ddof=1):.2f}, u of fit "
            f"{1000 * u:.2f}, simulated {1000 * whole.mean:+.2f} +- {1000 * whole.u:.2f} (its fits "
            f"{1000 * whole.u_fit:.2f}); held: fit {100 * fit[:, 0].mean():.1f} %, simulation "
            f"{100 * np.mean(each):.1f} % ({100 * np.min(each):.1f} to {100 * np.max(each):.1f}), all draws "
            f"{100 * all_draws[:, 0].mean():.1f} %, U {1000 * all_draws[:, 1].mean():.2f}",
            flush=True,
        )


def one_another(rows, objects, repeats=20):
    """How often scans of other objects, one each, show the error of a scan: by the rule of `budget`."""
    rng = np.random.default_rng(0)
    for name, found in rows.items():
        e = np.array([r.value - truth for r, truth in found]).reshape(objects, -1)
        shares = []
        for n in (5, 10, 20, objects - 1):
            kept = []
            for k, run in np.ndindex(*e.shape):
                for _ in range(repeats):
                    others = rng.permutation(np.delete(np.arange(objects), k))[:n]
                    d = e[others, rng.integers(0, e.shape[1], n)]
                    drawn = Simulated(
                        mean=float(d.mean()),
                        u=float(d.std(ddof=1)),
                        low=np.nan,
                        high=np.nan,
                        runs=n,
                        stable=False,
                        seed=0,
                    )
                    result, truth = found[k * e.shape[1] + run]
                    kept.append(held(result, truth, drawn)[0])
            shares.append(f"{100 * np.mean(kept):.1f} % by {n}")
        print(f"  {name:3s} held by scans of other objects: {', '.join(shares)}", flush=True)


if __name__ == "__main__":
    main()
