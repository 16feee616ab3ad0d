"""Over which thresholds the same objects count as cut by the view: python benchmarks/refine/edges.py"""

from __future__ import annotations

import objects
import run as table

import tomopose as tp
from tomopose.reconstruction.run import line_integrals_of
from tomopose.refinement.joint_fit import measured

CUT = {"rod": ("-v", "+v"), "cut": ("-u", "+u")}


def main() -> None:
    data = {}
    for name in objects.OBJECTS:
        images, P, _, panel = objects.scan(name, "seven", "white", n=32, noise=0.01)
        scan = line_integrals_of(images, table.matrices_of(P, panel), "transmission", None)
        data[name] = measured.measured(scan, tp.VoxelGrid.cube(n=72, spacing=0.32))
    for matter in (0.03, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5):
        right = []
        for crossed in (0.02, 0.05, 0.1, 0.2, 0.4):
            measured.MATTER, measured.CROSSED = matter, crossed
            found = {name: measured.crossed_edges(d) for name, d in data.items()}
            right.append(all(set(found[name]) == set(CUT.get(name, ())) for name in data))
        print(f"MATTER {matter}: right for CROSSED 0.02, 0.05, 0.1, 0.2, 0.4: {right}")


if __name__ == "__main__":
    main()
