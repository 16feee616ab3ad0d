"""Fig. 12 with and without `refine`: the hexapod scatters and none of its errors is known; circular and 3D scan.

    python benchmarks/section6/refined.py --out refined                  # specimen 5 x 5 binned, 210 views
    python benchmarks/section6/refined.py --out refined --levels 8 4 2   # the levels that `refine` chooses by itself

The 3D scan begins with the matrices of the paper's rigid calibration, which knows nothing of the virtual hexapod's
errors; the calibration's residual is the prior of each view.  The circular scan begins with the scanner's own, which
are exact, and `refine` is told nothing.  All volumes by filtered back-projection.  What is done is kept in OUT; an
interrupted run continues.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

import tomopose as tp
from tomopose.calibration.result import Calibration
from tomopose.calibration.uncertainty.trajectory import object_points, rms_px
from tomopose.geometry.object_pose import without_object_pose
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.reconstruction.line_integrals import Correction
from tomopose.reconstruction.settings import FDK
from tomopose.studies.parts.result import DEFAULT_SEED
from tomopose.studies.parts.steps import Steps
from tomopose.studies.section6.calibrations import calibrations
from tomopose.studies.section6.scan import MAGNIFICATION, WHITE, Numbers, Path, Radiographs, grid_of, scan_with
from tomopose.studies.section6.specimen import azimuth, cylinder_areas, measure_specimen, reference
from tomopose.studies.section6.tables import PERIODS, deviations_of, largest, rms, waves
from tomopose.studies.section6.volumes import Case, volume_for
from tomopose.units import MICROMETRES_PER_MM

THING, PATHS = "specimen", ("3D", "circular")


@dataclass(frozen=True, kw_only=True)
class Study:
    """numbers: size of the scans; levels: binnings at which views are refined; steps: what is kept."""

    numbers: Numbers
    levels: tuple[int, ...]
    seed: int
    steps: Steps

    @functools.cached_property
    def calibration(self) -> Calibration:
        """Of the paper: 189 poses, rigid, before the scan."""
        return calibrations(
            MAGNIFICATION[THING], 1, radiographs=False, seed=self.seed, steps=Steps(), progress=lambda done, total: None
        )["paper"]

    def rows(self, path: Path) -> dict[str, dict[str, Any]]:
        """What is measured in a path's volumes: with the true matrices, with those at hand, and with these refined."""
        scan = scan_with(THING, path, self.numbers, self.seed)
        images = Radiographs(scan)
        given, sigma_px = scan.truth, None
        if path == "3D":
            given = tp.projection_matrices(self.calibration, scan.poses, binning=scan.binning)
            sigma_px = self.calibration.d_rms / scan.binning

        def measured(name: str, matrices: ProjectionMatrices) -> dict[str, Any]:
            def compute() -> dict[str, Any]:
                case = Case(thing=THING, path=path, method="best", run=1)
                volume = volume_for(case, scan, images, matrices, self.numbers, FDK(), None, None)
                error = rms_px(without_object_pose(matrices.P, scan.truth.P, object_points()))
                error_um = MICROMETRES_PER_MM * error * float(volume.grid.spacing[0])
                return {**measure_specimen(volume, self.numbers.edge), "matrices_um": error_um}

            return self.steps.of(f"{path}, {name}", compute)

        def refined() -> dict[str, Any]:
            begin = time.process_time()
            found = tp.refine(
                images,
                given,
                grid_of(THING, self.numbers),
                correction=Correction(images_are="counts", white=WHITE),
                settings=tp.RefineSettings(levels=self.levels, sigma_px=sigma_px),
                checkpoint=None if self.steps.folder is None else self.steps.folder / f"refine-{path}",
            )
            said = {name: getattr(found, name) for name in ("verdict", "reasons", "chi", "stated_px", "halves_px")}
            return {**said, "P": found.matrices.P, "seconds": time.process_time() - begin}

        rows = {"true matrices": measured("true matrices", scan.truth)} if path == "3D" else {}
        rows["without refine"] = measured("without refine", given)
        name = f"refined at {', '.join(map(str, self.levels))}"
        made = self.steps.of(f"{path}, {name}, matrices", refined)
        print(path, {k: v for k, v in made.items() if k != "P"}, flush=True)
        matrices = ProjectionMatrices(
            P=np.array(made["P"]), n_u=given.n_u, n_v=given.n_v, p_u=given.p_u, p_v=given.p_v, pose_id=given.pose_id
        )
        rows[name] = measured(name, matrices)
        return rows


def figures_of(case: Mapping[str, Any], edge: float) -> dict[str, float]:
    """um, of one volume."""
    mesh = reference(edge)
    cylinder, d = cylinder_areas(mesh), deviations_of(case)
    return {
        "error of the matrices": case["matrices_um"],
        "cylinder areas, rms": rms(d[cylinder]),
        "cylinder areas, largest": largest(d[cylinder]),
        "part with seven periods": float(waves(d[cylinder], azimuth(mesh)[cylinder])[PERIODS]),
        "lengths, rms": rms(list(case["length_um"].values())),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=FilePath, required=True)
    parser.add_argument("--binning", type=int, default=5)
    parser.add_argument("--views", type=int, default=210)
    parser.add_argument("--edge", type=float, default=0.35, help="longest side of a triangle, mm")
    parser.add_argument("--levels", type=int, nargs="+", default=(8, 4), help="of refine, of the binned pixels")
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=PATHS)
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    a = parser.parse_args()
    numbers = Numbers(
        binning={THING: a.binning},
        views={THING: a.views},
        runs={THING: (1,)},
        edge=a.edge,
        samples=2,
        radiographs=False,
    )
    key = {"binning": a.binning, "views": a.views, "edge": a.edge, "seed": a.seed}
    study = Study(numbers=numbers, levels=tuple(a.levels), seed=a.seed, steps=Steps(folder=a.out, key=key))
    begin = time.process_time()
    for path in a.paths:
        for name, case in study.rows(path).items():
            print(path, name, json.dumps(figures_of(case, a.edge)), f"{time.process_time() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
