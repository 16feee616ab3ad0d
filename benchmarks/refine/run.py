"""One scan of the benchmark through `tp.refine`: python benchmarks/refine/run.py --object balls --errors white."""

from __future__ import annotations

import argparse
import time

import numpy as np
import objects

import tomopose as tp


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--object", default="balls", choices=list(objects.OBJECTS))
    parser.add_argument("--path", default="seven", choices=["circle", "sine", "seven"])
    parser.add_argument("--errors", default="white", choices=["white", "hexapod", "jump", "none"])
    parser.add_argument("--noise", type=float, default=0.005)
    parser.add_argument("--hardening", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--levels", type=int, nargs="+", default=None)
    a = parser.parse_args()
    images, P, truth, panel = objects.scan(
        a.object, a.path, a.errors, noise=a.noise, hardening=a.hardening, seed=a.seed
    )
    size = {name: getattr(panel, name) for name in ("n_u", "n_v", "p_u", "p_v")}
    matrices = tp.ProjectionMatrices(P=P, pose_id=tuple(f"p{j}" for j in range(len(P))), **size)
    settings = tp.RefineSettings(levels=None if a.levels is None else tuple(a.levels))
    begin = time.time()
    result = tp.refine(
        images, matrices, tp.VoxelGrid.cube(n=72, spacing=0.28), images_are="transmission", settings=settings
    )
    before, after = (objects.error_px(np.asarray(m), truth) for m in (matrices, result.matrices))
    print(f"{before:.4f} px -> {after:.4f} px, {result.verdict}, {time.time() - begin:.0f} s")
    print("\n".join(result.reasons))


if __name__ == "__main__":
    main()
